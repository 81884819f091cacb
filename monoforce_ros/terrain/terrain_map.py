"""TerrainMap: the terrain model of the physics (paper III-C, "Terrain model")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from monoforce_ros.terrain.grid import Grid

CHANNELS = ("height", "geometric_height", "stiffness", "damping", "friction")
SPREADS = ("geometric_spread", "decrease_spread")
"""Optional channels: how uncertain the heights are."""

_TOUCHING = 1.5
"""Distance of the centres of cells that touch, also by a corner [cells]."""
_SECTORS = 120
"""Directions around the robot in which it is known how far was measured: 3°, two cells of 0.1 m at 4 m."""


@dataclass(frozen=True)
class TerrainDefaults:
    """Material of ground without further information: firm soil."""

    stiffness: float = 2.0e6
    """[N/m³]: a Husky's wheels sink 8 mm."""
    damping: float = 4.0e4
    """[N s/m³]: about half of critical for a Husky on that stiffness."""
    friction: float = 0.8
    """[-]."""


@dataclass(frozen=True)
class TerrainMap:
    """Maps of the ground in one frame (z up), ``[rows, columns]`` or, for a batch, ``[B, rows, columns]``.

    All channels have the same shape and finite values; a cell without a measurement has an interpolated value and is
    False in ``observed``. The constructor raises ``ValueError`` otherwise, and names the channel.
    """

    height: Tensor
    """Height of the supporting ground, below which contact forces act (H_t) [m]."""
    geometric_height: Tensor
    """Height of the visible surface, vegetation included (H_g) [m]."""
    stiffness: Tensor
    """Spring constant per contact area [N/m³]."""
    damping: Tensor
    """Damping per contact area [N s/m³]."""
    friction: Tensor
    """Friction coefficient [-]."""
    observed: Tensor
    """Whether a cell was measured (bool)."""
    grid: Grid
    geometric_spread: Tensor | None = None
    """Expected absolute error of ``geometric_height`` [m], where the source knows it."""
    decrease_spread: Tensor | None = None
    """Expected absolute error of H_d, the difference of the two heights [m]."""

    def __post_init__(self):
        shape = self.height.shape
        if len(shape) not in (2, 3) or tuple(shape[-2:]) != (self.grid.rows, self.grid.columns):
            raise ValueError(
                f"terrain height: got shape {tuple(shape)}, expected [B,] {self.grid.rows} rows, "
                f"{self.grid.columns} columns"
            )
        for name in (*CHANNELS, *self.spreads, "observed"):
            channel = getattr(self, name)
            if channel.shape != shape:
                raise ValueError(f"terrain {name}: got shape {tuple(channel.shape)}, expected {tuple(shape)}")
            # The sum is a fast test; as large finite numbers may overflow, a failed one is confirmed cell by cell.
            if name != "observed" and not torch.isfinite(channel.sum()) and not torch.isfinite(channel).all():
                bad = int((~torch.isfinite(channel)).sum())
                raise ValueError(
                    f"terrain {name}: {bad} of {channel.numel()} cells are not finite; fill holes by interpolation and "
                    "mark them in `observed`"
                )
        for name in ("stiffness", "damping", "friction", *self.spreads):
            smallest = float(getattr(self, name).detach().amin())
            if smallest < 0:
                raise ValueError(f"terrain {name}: got a smallest value of {smallest:g}, expected ≥ 0")

    @classmethod
    def from_height(
        cls,
        height: Tensor,
        grid: Grid,
        *,
        geometric_height: Tensor | None = None,
        observed: Tensor | None = None,
        material: TerrainDefaults = TerrainDefaults(),
    ) -> TerrainMap:
        """A map with one material. By default the visible surface equals the ground, and all cells are observed."""

        def constant(value: float) -> Tensor:
            return torch.full_like(height, value, requires_grad=False)

        return cls(
            height=height,
            geometric_height=height.detach() if geometric_height is None else geometric_height,
            stiffness=constant(material.stiffness),
            damping=constant(material.damping),
            friction=constant(material.friction),
            observed=torch.ones_like(height, dtype=torch.bool) if observed is None else observed,
            grid=grid,
        )

    @classmethod
    def flat(
        cls,
        grid: Grid | None = None,
        *,
        height: float = 0.0,
        material: TerrainDefaults = TerrainDefaults(),
        dtype: torch.dtype = torch.float32,
    ) -> TerrainMap:
        """Level ground."""
        grid = grid or Grid.square()
        return cls.from_height(torch.full((grid.rows, grid.columns), height, dtype=dtype), grid, material=material)

    def with_material(self, material: TerrainDefaults) -> TerrainMap:
        """The same surfaces of one material."""

        def constant(value: float) -> Tensor:
            return torch.full_like(self.height, value, requires_grad=False)

        return replace(
            self,
            stiffness=constant(material.stiffness),
            damping=constant(material.damping),
            friction=constant(material.friction),
        )

    @classmethod
    def stack(cls, maps: Sequence[TerrainMap]) -> TerrainMap:
        """A batch ``[B, rows, columns]`` of maps on the same grid."""
        if any(entry.grid != maps[0].grid for entry in maps):
            raise ValueError("terrain maps: got different grids, expected one grid for a batch")
        spreads = [name for name in SPREADS if all(getattr(m, name) is not None for m in maps)]
        channels = {name: torch.stack([getattr(m, name) for m in maps]) for name in (*CHANNELS, *spreads, "observed")}
        return cls(**channels, grid=maps[0].grid)

    def measured_nearby(self, reach: float = 0.3) -> np.ndarray:
        """Whether a cell of a single map is within ``reach`` [m] of a measured one, ``[rows, columns]`` bool.

        Heights interpolated between the rings of a lidar are as good as measured.
        """
        observed = self.observed.cpu().numpy()
        if not observed.any():
            return observed
        distance = cv2.distanceTransform((~observed).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return distance * self.grid.resolution <= reach + 1e-6

    def extrapolated(self) -> np.ndarray:
        """Whether a cell of a single map lies behind all that was measured in its direction, ``[rows, columns]`` bool.

        Sensors see ground behind a gap between their rows of returns, but not behind an edge from which it drops, nor
        behind a wall. A measured cell speaks for those that touch it. The robot is at the origin of the map's frame.
        """
        observed = self.observed.cpu().numpy()
        distance, sector = polar(self.grid)
        farthest = np.full(_SECTORS, -np.inf)
        np.maximum.at(farthest, sector[observed], distance[observed])
        # Neighbouring sectors speak for it, too: a far row of returns has gaps.
        farthest = np.max([np.roll(farthest, by) for by in (-1, 0, 1)], axis=0)
        return ~observed & (distance > farthest[sector] + _TOUCHING * self.grid.resolution)

    def looked_over(self, sensor_height: float) -> np.ndarray:
        """Height below which a lidar sees nothing, nearer than all that it measured in a direction [m].

        That is its blind zone, below the lines of sight to the nearest measured cells; ``[rows, columns]``, -inf beyond
        them and where nothing was measured in a direction. The robot is at the origin of the map's frame.

        Args:
            sensor_height: of the lidar in the map's frame [m].
        """
        observed = self.observed.cpu().numpy()
        distance, sector = polar(self.grid)
        away, where = distance[observed], sector[observed]
        # Of repeated indices the last value counts, that of the nearest cell.
        order = np.argsort(-away, kind="stable")
        nearest, height = np.zeros(_SECTORS), np.full(_SECTORS, -np.inf)
        nearest[where[order]] = away[order]
        height[where[order]] = self.height.cpu().numpy()[observed][order]
        share = distance / np.maximum(nearest[sector], 1e-6)
        sight = np.full(distance.shape, -np.inf)
        blind = ~observed & (share < 1.0)
        sight[blind] = (sensor_height + (height[sector] - sensor_height) * share)[blind]
        return sight

    @property
    def spreads(self) -> tuple[str, ...]:
        """Those of :data:`SPREADS` that this map has."""
        return tuple(name for name in SPREADS if getattr(self, name) is not None)

    @property
    def height_spread(self) -> Tensor | None:
        """Expected absolute error of ``height`` [m], those of its two parts taken as independent; None if unknown."""
        if self.geometric_spread is None or self.decrease_spread is None:
            return self.geometric_spread
        return torch.hypot(self.geometric_spread, self.decrease_spread)

    @property
    def batch_size(self) -> int | None:
        """Number of maps in the batch; None for a single map."""
        return self.height.shape[0] if self.height.ndim == 3 else None

    def with_cells(self, cells: Tensor, values: Mapping[str, Tensor]) -> TerrainMap:
        """A map that takes the ``values`` of each channel in ``cells`` ``[rows, columns]`` bool, which are observed.

        Spreads stay: those of cells that are not observed now are the larger ones.
        """

        def merged(name: str, channel: Tensor) -> Tensor:
            return torch.where(cells, values[name].to(channel), channel)

        return replace(
            self,
            height=merged("height", self.height),
            geometric_height=merged("geometric_height", self.geometric_height),
            stiffness=merged("stiffness", self.stiffness),
            damping=merged("damping", self.damping),
            friction=merged("friction", self.friction),
            observed=self.observed | cells,
        )

    def repeated(self, count: int) -> TerrainMap:
        """This map ``count`` times as a batch, without a copy."""
        names = (*CHANNELS, *self.spreads, "observed")
        channels = {name: getattr(self, name).expand(count, -1, -1) for name in names}
        return replace(self, **channels)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> TerrainMap:
        """The same map in another precision or on another device."""
        channels = {name: getattr(self, name).to(device=device, dtype=dtype) for name in (*CHANNELS, *self.spreads)}
        observed = self.observed.to(device=device)
        if observed is self.observed and all(channel is getattr(self, name) for name, channel in channels.items()):
            return self
        return TerrainMap(**channels, observed=observed, grid=self.grid)


@lru_cache(maxsize=8)
def polar(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each cell from the origin [m], and the number of the sector in which it lies, ``[rows, columns]``."""
    x, y = np.meshgrid(grid.x, grid.y)
    sector = ((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    return np.hypot(x, y), sector
