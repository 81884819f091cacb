"""Clusters of body points: most points are in the air, and one test per cluster skips all of its points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_LARGEST = 8
"""Largest number of points per cluster."""
_MARGIN = 1.001, 1e-3
"""Factor and offset [m] on each radius, to allow for rounding of rotations and coordinates."""


@dataclass(frozen=True)
class PointClusters:
    """Bounding spheres of neighbouring points."""

    order: Tensor
    """Point indices, sorted by cluster ``[N]``."""
    edges: Tensor
    """Index in ``order`` of the first point of each cluster, then the end ``[C + 1]`` int32."""
    centres: Tensor
    """Centres of the spheres in the base frame [m], ``[C, 3]``."""
    radii: Tensor
    """Radii of the spheres [m], ``[C]``."""

    def ceiling(self, height: Tensor, resolution: float) -> Tensor:
        """Highest ground ``[B, rows, columns]`` [m] within reach of any cluster whose centre is nearest to each node.

        The reach adds the largest radius, one cell from a point to the corners of its cell, and half a cell from the
        centre to its nearest node. Clamping coordinates off the map never increases these distances.
        """
        reach = int(np.ceil(float(self.radii.max()) / resolution + 1.5))
        width = 2 * reach + 1
        across = functional.max_pool2d(height.detach()[:, None], (1, width), 1, (0, reach))
        return functional.max_pool2d(across, (width, 1), 1, (reach, 0))[:, 0]


def point_clusters(points: Tensor) -> PointClusters:
    """Clusters of points ``[N, 3]`` [m], with their precision and device."""
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
    """Split point indices along the widest axis until each part is small enough."""
    if len(chosen) <= _LARGEST:
        return [chosen]
    extent = np.ptp(points[chosen], axis=0)
    ranked = chosen[np.argsort(points[chosen, int(extent.argmax())], kind="stable")]
    half = len(ranked) // 2
    return [*_halved(points, ranked[:half]), *_halved(points, ranked[half:])]
