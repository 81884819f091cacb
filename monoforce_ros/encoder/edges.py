"""Edges: steps in a predicted height map, restored from the slopes that uncertainty makes of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

_REACH = 0.3
"""How far to each side an edge may be off where images tell of it [m]: its blur is twice as wide."""
_SLOPE, _STEP = 0.25, 0.3
"""Differences in height within the reach: up to the first, a slope of 23°, nothing changes; from the second on it is an
edge [m]."""
_GAIN = 6.0
"""By how much more sharply heights change between the two sides of an edge."""


def restore_edges(heights: Tensor, resolution: float) -> Tensor:
    """Heights ``[B, rows, columns]`` [m] with steps where they rise too steeply to be ground that was only blurred.

    Where a wall stands an image tells to a few decimetres. The middle of all the places where it may stand is a slope
    that a robot can climb, and none of them is. So what lies between a low and a high side nearby goes to the nearer
    of them, the more sharply the higher the difference (contrast enhancement between local extremes: Kramer and
    Bruckner, "Iterations of a non-linear transformation for enhancement of digital images", 1975). Gentler ground and
    the middle of long slopes stay as they are, and no height leaves the range of its surroundings.

    Args:
        heights: predicted.
        resolution: edge of a cell [m].
    """
    high, low = _extremes(heights, max(1, round(_REACH / resolution)))
    difference = high - low
    gain = 1.0 + (_GAIN - 1.0) * ((difference - _SLOPE) / (_STEP - _SLOPE)).clamp(0.0, 1.0)
    share = (heights - low) / difference.clamp_min(1e-6)
    sharper = low + difference * (0.5 + gain * (share - 0.5)).clamp(0.0, 1.0)
    return torch.where(gain > 1.0, sharper, heights)


def _extremes(heights: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Highest and lowest cell in a disc of so many cells around each; a square sees further along its diagonals."""
    both = torch.stack([heights, -heights])
    highest, rows = both, heights.shape[1]
    for half in range(reach + 1):
        # A little wider than the reach: the disc would else end in single cells.
        away = [row for row in range(reach + 1) if math.floor(math.sqrt((reach + 0.4) ** 2 - row**2)) == half]
        if not away:
            continue
        widest = functional.max_pool2d(both, (1, 2 * half + 1), 1, (0, half)) if half else both
        padded = functional.pad(widest, (0, 0, reach, reach), value=-math.inf)
        for row in {sign * row for row in away for sign in (-1, 1)}:
            highest = torch.maximum(highest, padded[:, :, reach + row : reach + row + rows])
    return highest[0], -highest[1]
