"""Clusters of body points: most points are in the air, and one test per cluster skips all of its points.

Clusters are grouped, so that a finely sampled hull in the air costs a few tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.terrain import Grid

_LARGEST = 8
"""Largest number of points per cluster."""
_LARGEST_GROUP = 64
"""Largest number of points per group."""
_MARGIN = 1.001, 1e-3
"""Factor and offset [m] on each box, to allow for rounding of rotations and coordinates."""


@dataclass(frozen=True)
class Boxes:
    """Boxes with edges along the base axes around parts of a body; each part is a range."""

    edges: Tensor
    """Index of the first member of each box, then the end ``[K + 1]`` int32."""
    centres: Tensor
    """Centres in the base frame [m], ``[K, 3]``."""
    halves: Tensor
    """Half of the edge lengths [m], ``[K, 3]``."""

    @property
    def radii(self) -> Tensor:
        """Radii of spheres around the boxes [m], ``[K]``."""
        return self.halves.norm(dim=1)

    def near(self, ceiling: Tensor, grid: Grid, centre: Tensor, rotation: Tensor, origin: Tensor) -> Tensor:
        """Which boxes the ground may touch in any of several poses of a body, ``[K]`` bool.

        Args:
            ceiling: :meth:`ceiling` of the map or maps, ``[1 or B, rows, columns]`` [m].
            grid: its grid.
            centre: position of ``origin`` in each pose, ``[B, 3]`` [m].
            rotation: terrain ← base, ``[B, 3, 3]``.
            origin: a point of the body in the base frame, ``[B, 3]`` [m].
        """
        middles = centre[:, None] + (self.centres - origin[:, None]) @ rotation.transpose(1, 2)
        depths = (self.halves * rotation[:, None, 2].abs()).sum(-1)
        nodes = []
        for axis, cells in ((1, grid.rows), (0, grid.columns)):
            raw = torch.nan_to_num((middles[..., axis] - grid.origin[axis]) / grid.resolution)
            nodes.append((raw.clamp(0, cells - 1) + 0.5).long())
        pages = torch.arange(len(ceiling), device=ceiling.device)[:, None]
        return (ceiling[pages, nodes[0], nodes[1]] > middles[..., 2] - depths).any(0)

    def ceiling(self, height: Tensor, resolution: float) -> Tensor:
        """Highest ground ``[B, rows, columns]`` [m] within reach of any box whose centre is nearest to each node.

        The reach adds the largest radius, one cell from a point to the corners of its cell, and half a cell from the
        centre to its nearest node. Clamping coordinates off the map never increases these distances.
        """
        reach = int(np.ceil(float(self.radii.max()) / resolution + 1.5))
        return _within_reach(_within_reach(height.detach(), reach, 2), reach, 1)


@dataclass(frozen=True)
class PointClusters:
    """Neighbouring points in boxes, and neighbouring boxes in larger ones."""

    order: Tensor
    """Point indices, sorted by cluster ``[N]``."""
    clusters: Boxes
    """Boxes around ranges of ``order``."""
    groups: Boxes
    """Boxes around ranges of ``clusters``."""


def _within_reach(values: Tensor, reach: int, axis: int) -> Tensor:
    """Largest of the values up to ``reach`` nodes away along an axis of ``[B, rows, columns]``.

    Windows double until they are as wide as asked for: five times as fast as pooling over maps of 128 cells.
    """
    beside = [reach, reach] if axis == 2 else [0, 0, reach, reach]
    largest, width = functional.pad(values, beside, value=-torch.inf), 1
    while width < 2 * reach + 1:
        shift = min(width, 2 * reach + 1 - width)
        count = largest.shape[axis] - shift
        largest = torch.maximum(largest.narrow(axis, 0, count), largest.narrow(axis, shift, count))
        width += shift
    return largest


def joined(parts: Sequence[Boxes]) -> Boxes:
    """Boxes of several bodies, one body after the other."""
    counts = torch.cat([torch.diff(boxes.edges) for boxes in parts])
    return Boxes(
        edges=torch.cat([counts.new_zeros(1), counts.cumsum(0)]).to(torch.int32),
        centres=torch.cat([boxes.centres for boxes in parts]),
        halves=torch.cat([boxes.halves for boxes in parts]),
    )


def point_clusters(points: Tensor) -> PointClusters:
    """Clusters of points ``[N, 3]`` [m], with their precision and device."""
    order, *boxes = _clusters(points.detach().cpu().double().numpy().tobytes())
    found = [
        Boxes(edges.to(points.device), *(t.to(points.device, points.dtype) for t in places)) for edges, *places in boxes
    ]
    return PointClusters(order.to(points.device), *found)


@lru_cache(maxsize=32)
def _clusters(data: bytes) -> tuple[Any, ...]:
    points = np.frombuffer(data).reshape(-1, 3)
    groups = _halved(points, np.arange(len(points)), _LARGEST_GROUP)
    parts = [_halved(points, group, _LARGEST) for group in groups]
    clusters = [cluster for part in parts for cluster in part]
    return (
        torch.from_numpy(np.concatenate(clusters)),
        _boxes(points, clusters, [len(cluster) for cluster in clusters]),
        _boxes(points, groups, [len(part) for part in parts]),
    )


def _boxes(points: np.ndarray, parts: list[np.ndarray], counts: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    low = np.array([points[part].min(axis=0) for part in parts])
    high = np.array([points[part].max(axis=0) for part in parts])
    edges = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    halves = (high - low) / 2 * _MARGIN[0] + _MARGIN[1]
    return torch.from_numpy(edges), torch.from_numpy((low + high) / 2), torch.from_numpy(halves)


def _halved(points: np.ndarray, chosen: np.ndarray, largest: int) -> list[np.ndarray]:
    """Split point indices along the widest axis until each part is small enough."""
    if len(chosen) <= largest:
        return [chosen]
    extent = np.ptp(points[chosen], axis=0)
    ranked = chosen[np.argsort(points[chosen, int(extent.argmax())], kind="stable")]
    half = len(ranked) // 2
    return [*_halved(points, ranked[:half], largest), *_halved(points, ranked[half:], largest)]
