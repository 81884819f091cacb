"""Clusters of body points: most of a robot is in the air, and a look at each cluster tells which part may not be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_LARGEST = 8
"""Points of a cluster."""
_MARGIN = 1.001, 1e-3
"""On each radius, as a factor and added [m]: rotations and coordinates are rounded."""


@dataclass(frozen=True)
class PointClusters:
    """Spheres about neighbouring points."""

    order: Tensor
    """The points' indices, cluster after cluster ``[N]``."""
    edges: Tensor
    """Of each cluster the first place in the order, and the end ``[C + 1]`` int32."""
    centres: Tensor
    """In the base frame [m], ``[C, 3]``."""
    radii: Tensor
    """[m], ``[C]``."""

    def ceiling(self, height: Tensor, resolution: float) -> Tensor:
        """Highest ground ``[B, rows, columns]`` [m] that any cluster whose centre is nearest to a node may touch.

        A point is at most the radius from its centre, a corner of its cell one cell further, and the node that is
        nearest to the centre half a cell from it. Coordinates off the map are clamped, which brings none further apart.
        """
        reach = int(np.ceil(float(self.radii.max()) / resolution + 1.5))
        width = 2 * reach + 1
        across = functional.max_pool2d(height.detach()[:, None], (1, width), 1, (0, reach))
        return functional.max_pool2d(across, (width, 1), 1, (reach, 0))[:, 0]


def point_clusters(points: Tensor) -> PointClusters:
    """Clusters of points ``[N, 3]`` [m], in their precision and on their device."""
    found = _clusters(points.detach().cpu().double().numpy().tobytes())
    return PointClusters(
        *(t.to(points.device) for t in found[:2]), *(t.to(points.device, points.dtype) for t in found[2:])
    )


@lru_cache(maxsize=32)
def _clusters(data: bytes) -> tuple[Tensor, ...]:
    points = np.frombuffer(data).reshape(-1, 3)
    parts = _halved(points, np.arange(len(points)))
    order = np.concatenate(parts)
    middles = np.array([(points[part].min(axis=0) + points[part].max(axis=0)) / 2 for part in parts])
    radii = [np.linalg.norm(points[part] - middle, axis=1).max() for part, middle in zip(parts, middles, strict=True)]
    edges = np.concatenate([[0], np.cumsum([len(part) for part in parts])])
    return (
        torch.from_numpy(order),
        torch.from_numpy(edges.astype(np.int32)),
        torch.from_numpy(middles),
        torch.from_numpy(np.array(radii) * _MARGIN[0] + _MARGIN[1]),
    )


def _halved(points: np.ndarray, chosen: np.ndarray) -> list[np.ndarray]:
    """Indices split along their widest direction until few enough remain."""
    if len(chosen) <= _LARGEST:
        return [chosen]
    extent = np.ptp(points[chosen], axis=0)
    ranked = chosen[np.argsort(points[chosen, int(extent.argmax())], kind="stable")]
    half = len(ranked) // 2
    return [*_halved(points, ranked[:half]), *_halved(points, ranked[half:])]
