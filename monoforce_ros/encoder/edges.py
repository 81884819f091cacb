"""Edges: restores steps that uncertainty has blurred into slopes in a predicted height map."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

_REACH = 0.3
"""Uncertainty of an edge's position in an image, to each side [m]; the blur is twice as wide."""
_SLOPE, _STEP = 0.25, 0.3
"""Height differences within the reach [m]: below the first, a slope of 23°, heights are kept; above the second they are
an edge; in between the two are blended."""
_GAIN = 6.0
"""Factor by which an edge is steepened."""


def restore_edges(heights: Tensor, resolution: float) -> Tensor:
    """Heights ``[B, rows, columns]`` [m] in which slopes too steep for ground are steps.

    The position of a wall is uncertain by a few decimetres in an image. The mean over its possible positions is a
    slope that a robot can climb, although none of these walls can be climbed. Cells between a low and a high
    neighbourhood therefore move towards the nearer of the two, the more the larger the height difference (contrast
    enhancement between local extremes: Kramer and Bruckner, "Iterations of a non-linear transformation for enhancement
    of digital images", 1975). Gentler ground and the middle of long slopes are unchanged; no height leaves the range
    of its neighbourhood.

    Args:
        heights: predicted.
        resolution: resolution of the map [m].
    """
    high, low = _extremes(heights, max(1, round(_REACH / resolution)))
    difference = high - low
    gain = 1.0 + (_GAIN - 1.0) * ((difference - _SLOPE) / (_STEP - _SLOPE)).clamp(0.0, 1.0)
    share = (heights - low) / difference.clamp_min(1e-6)
    sharper = low + difference * (0.5 + gain * (share - 0.5)).clamp(0.0, 1.0)
    return torch.where(gain > 1.0, sharper, heights)


def _extremes(heights: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Maximum and minimum over a disc of radius ``reach`` [cells] around each cell; unlike a square it is isotropic."""
    both = torch.stack([heights, -heights])
    highest, rows = both, heights.shape[1]
    for half in range(reach + 1):
        # Slightly larger than the reach, so that the disc has no single protruding cells.
        away = [row for row in range(reach + 1) if math.floor(math.sqrt((reach + 0.4) ** 2 - row**2)) == half]
        if not away:
            continue
        widest = functional.max_pool2d(both, (1, 2 * half + 1), 1, (0, half)) if half else both
        padded = functional.pad(widest, (0, 0, reach, reach), value=-math.inf)
        for row in {sign * row for row in away for sign in (-1, 1)}:
            highest = torch.maximum(highest, padded[:, :, reach + row : reach + row + rows])
    return highest[0], -highest[1]
