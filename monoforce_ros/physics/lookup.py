"""Terrain lookup: heights, normals and materials under body points (paper III-C)."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.terrain import Grid, TerrainMap


@dataclass(frozen=True)
class Ground:
    """Terrain properties at a batch of points."""

    height: Tensor
    """``[B, N]`` [m]."""
    normal: Tensor
    """Unit normal, ``[B, 3, N]``, z positive."""
    stiffness: Tensor
    """``[B, N]`` [N/m³]."""
    damping: Tensor
    """``[B, N]`` [N s/m³]."""
    friction: Tensor
    """``[B, N]``."""
    vegetation: Tensor
    """Height of the vegetation above the ground, ``[B, N]`` [m]."""


class TerrainLookup:
    """Reads a terrain map at points. The constructor packs the maps once.

    Beyond the outermost cell centres the border values continue: grid coordinates (never flat indices) are clamped, and
    the slope across the border is zero.
    """

    def __init__(self, terrain: TerrainMap, kind: str, batch: int, vegetation: Tensor | None = None):
        vegetation = torch.zeros_like(terrain.height) if vegetation is None else vegetation
        listed = (terrain.height, terrain.stiffness, terrain.damping, terrain.friction, vegetation)
        channels = torch.stack(torch.broadcast_tensors(*listed))
        if channels.ndim == 3:
            channels = channels[:, None]
        pages = channels.shape[1]
        if pages not in (1, batch):
            raise ValueError(f"terrain: got a batch of {pages} maps, expected 1 or {batch}")
        # One row of cells per channel: gathers dominate the run time and need contiguous memory.
        self.channels = channels.flatten(1)
        cells = terrain.grid.rows * terrain.grid.columns
        self._page = None if pages == 1 else cells * torch.arange(batch, device=channels.device)[:, None]
        self._grid: Grid = terrain.grid
        self._kind = kind

        def axes(x: float, y: float) -> Tensor:
            return torch.tensor([[x], [y]], dtype=channels.dtype, device=channels.device)

        self._origin = axes(*terrain.grid.origin)
        self._limit = axes(terrain.grid.columns - 1, terrain.grid.rows - 1)
        self._zero = torch.zeros_like(self._limit)
        self._corners = torch.tensor([0, 1, self._grid.columns, self._grid.columns + 1], device=channels.device)[
            :, None, None
        ]

    def with_channels(self, channels: Tensor) -> TerrainLookup:
        """A lookup with the same grid and other values, packed like :attr:`channels`."""
        other = copy(self)
        other.channels = channels
        return other

    @property
    def largest_friction(self) -> Tensor:
        """Of all maps, a scalar."""
        return self.channels[3].detach().max()

    def __call__(self, points: Tensor) -> Ground:
        """Ground below points ``[B, ≥ 2, N]`` [m]."""
        return self._bilinear(points) if self._kind == "bilinear" else self._constant(points)

    def _gather(self, flat: Tensor) -> Tensor:
        """Channels ``[5, ..., B, N]`` at flat indices ``[..., B, N]`` within a map."""
        if self._page is not None:
            flat = flat + self._page
        return self.channels.index_select(1, flat.flatten()).unflatten(1, flat.shape)

    def _bilinear(self, points: Tensor) -> Ground:
        raw = (points[:, :2] - self._origin) / self._grid.resolution
        coordinate = torch.clamp(raw, self._zero, self._limit)
        # The last cell centre belongs to the previous square, so that the neighbours exist.
        # A trajectory that diverged has no cell; its NaN comes back through the fractions below.
        corner = torch.minimum(torch.nan_to_num(coordinate.detach()).floor(), self._limit - 1.0)
        u, w = (coordinate - corner).unbind(1)
        column, row = corner.long().unbind(1)
        values = self._gather(self._corners + (row * self._grid.columns + column))
        lower = 1.0 - w
        weights = torch.stack([lower - u * lower, u * lower, w - u * w, u * w])
        value = (values * weights).sum(1)
        # The height does not depend on clamped coordinates.
        free = (raw.detach() == coordinate.detach()) / self._grid.resolution
        here, right, above, diagonal = values[0]
        slope_x = (lower * (right - here) + w * (diagonal - above)) * free[:, 0]
        slope_y = (above - here + u * (diagonal - above - right + here)) * free[:, 1]
        upward = torch.rsqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        normal = torch.stack([-slope_x * upward, -slope_y * upward, upward], dim=1)
        return Ground(value[0], normal, *value[1:])

    def _constant(self, points: Tensor) -> Ground:
        coordinate = torch.nan_to_num((points[:, :2].detach() - self._origin) / self._grid.resolution)
        column, row = torch.clamp(coordinate, self._zero, self._limit).round().long().unbind(1)
        value = self._gather(row * self._grid.columns + column)
        flat = torch.zeros_like(value[0])
        return Ground(value[0], torch.stack([flat, flat, torch.ones_like(flat)], dim=1), *value[1:])
