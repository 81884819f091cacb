"""Terrain lookup: heights, normals and materials under body points (paper III-C)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.terrain import Grid, TerrainMap


@dataclass(frozen=True)
class Ground:
    """What the terrain is at each of a batch of points."""

    height: Tensor
    """``[B, N]`` [m]."""
    normal: Tensor
    """Unit normal, ``[B, N, 3]``, z positive."""
    stiffness: Tensor
    """``[B, N]`` [N/m³]."""
    damping: Tensor
    """``[B, N]`` [N s/m³]."""
    friction: Tensor
    """``[B, N]``."""
    drag: Tensor
    """Drag of vegetation per area, ``[B, N]`` [N s/m³]."""


class TerrainLookup:
    """Reads a terrain map at points. The maps are packed once, when the lookup is made.

    Beyond the outermost cell centres the border is continued: the grid coordinate is clamped, never a flat index, and
    the slope across the border is zero there.
    """

    def __init__(self, terrain: TerrainMap, kind: str, batch: int, drag: Tensor | None = None):
        drag = torch.zeros_like(terrain.height) if drag is None else drag
        listed = torch.broadcast_tensors(terrain.height, terrain.stiffness, terrain.damping, terrain.friction, drag)
        channels = torch.stack(listed, dim=-3)
        if channels.ndim == 3:
            channels = channels[None]
        if channels.shape[0] not in (1, batch):
            raise ValueError(f"terrain: got a batch of {channels.shape[0]} maps, expected 1 or {batch}")
        self._channels = channels.flatten(-2)
        self._batch = batch
        self._grid: Grid = terrain.grid
        self._kind = kind
        self._origin = torch.tensor(terrain.grid.origin, dtype=channels.dtype, device=channels.device)
        self._limit = torch.tensor(
            [terrain.grid.columns - 1, terrain.grid.rows - 1], dtype=channels.dtype, device=channels.device
        )

    def __call__(self, points: Tensor) -> Ground:
        """Ground below points ``[B, N, ≥ 2]`` [m]."""
        return self._bilinear(points) if self._kind == "bilinear" else self._constant(points)

    def inside(self, points: Tensor) -> Tensor:
        """Whether points ``[..., ≥ 2]`` lie within half a cell of the map's cells."""
        index = (points[..., :2] - self._origin) / self._grid.resolution
        return ((index >= -0.5) & (index <= self._limit + 0.5)).all(dim=-1)

    def _gather(self, flat: Tensor) -> Tensor:
        """Channels ``[B, 5, M]`` at flat indices ``[B, M]``."""
        channels = self._channels
        if channels.shape[0] == 1:
            return channels[0][:, flat].transpose(0, 1)
        return channels.gather(2, flat[:, None, :].expand(-1, channels.shape[1], -1))

    def _bilinear(self, points: Tensor) -> Ground:
        raw = (points[..., :2] - self._origin) / self._grid.resolution
        coordinate = torch.minimum(raw.clamp_min(0.0), self._limit)
        # The last cell centre belongs to the square before it, so that its neighbour exists.
        corner = torch.minimum(coordinate.detach().floor(), self._limit - 1.0)
        fraction = coordinate - corner
        column, row = corner.long().unbind(-1)
        first = row * self._grid.columns + column
        count = first.shape[1]
        values = self._gather(
            torch.cat([first, first + 1, first + self._grid.columns, first + self._grid.columns + 1], dim=1)
        ).unflatten(2, (4, count))
        here, right, above, diagonal = values.unbind(2)
        u, w = fraction[..., 0][:, None], fraction[..., 1][:, None]
        bottom = here + u * (right - here)
        top = above + u * (diagonal - above)
        value = bottom + w * (top - bottom)
        # Where the coordinate was clamped the height no longer depends on it.
        free = (raw.detach() == coordinate.detach()).to(values.dtype)
        slope_x = ((1 - w) * (right - here) + w * (diagonal - above))[:, 0] / self._grid.resolution * free[..., 0]
        slope_y = (top - bottom)[:, 0] / self._grid.resolution * free[..., 1]
        return self._ground(value, slope_x, slope_y)

    def _constant(self, points: Tensor) -> Ground:
        coordinate = (points[..., :2].detach() - self._origin) / self._grid.resolution
        index = torch.minimum(coordinate.clamp_min(0.0), self._limit).round().long()
        column, row = index.unbind(-1)
        value = self._gather(row * self._grid.columns + column)
        flat = torch.zeros_like(value[:, 0])
        return self._ground(value, flat, flat)

    @staticmethod
    def _ground(value: Tensor, slope_x: Tensor, slope_y: Tensor) -> Ground:
        upward = torch.rsqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        normal = torch.stack([-slope_x * upward, -slope_y * upward, upward], dim=-1)
        height, stiffness, damping, friction, drag = value.unbind(1)
        return Ground(height, normal, stiffness, damping, friction, drag)
