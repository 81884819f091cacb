"""TerrainMap: the ground as the physics sees it (paper III-C, "Terrain model")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from monoforce_ros.terrain.grid import Grid

CHANNELS = ("height", "geometric_height", "stiffness", "damping", "friction")


@dataclass(frozen=True)
class TerrainDefaults:
    """Material of ground about which nothing more is known: firm soil."""

    stiffness: float = 2.0e6
    """[N/m³]: a Husky's wheels sink 8 mm."""
    damping: float = 4.0e4
    """[N s/m³]: about half of critical for a Husky on that stiffness."""
    friction: float = 0.8
    """[-]."""


@dataclass(frozen=True)
class TerrainMap:
    """Maps of the ground in one frame (z up), ``[rows, columns]`` or, for a batch, ``[B, rows, columns]``.

    All maps have the same shape and finite values; a cell without a measurement holds an interpolated value and is
    False in ``observed``. Raises ``ValueError`` naming the channel otherwise.
    """

    height: Tensor
    """Height at which the ground starts to generate forces (H_t) [m]."""
    geometric_height: Tensor
    """Height of what a sensor sees (H_g), vegetation included [m]."""
    stiffness: Tensor
    """Spring constant per contact area [N/m³]."""
    damping: Tensor
    """Damping per contact area [N s/m³]."""
    friction: Tensor
    """Friction coefficient [-]."""
    observed: Tensor
    """Whether a cell was measured (bool)."""
    grid: Grid

    def __post_init__(self):
        shape = self.height.shape
        if len(shape) not in (2, 3) or tuple(shape[-2:]) != (self.grid.rows, self.grid.columns):
            raise ValueError(
                f"terrain height: got shape {tuple(shape)}, expected [B,] {self.grid.rows} rows, "
                f"{self.grid.columns} columns"
            )
        for name in (*CHANNELS, "observed"):
            channel = getattr(self, name)
            if channel.shape != shape:
                raise ValueError(f"terrain {name}: got shape {tuple(channel.shape)}, expected {tuple(shape)}")
            # One NaN or infinity makes the sum one; a sum of large finite numbers may overflow, hence the second look.
            if name != "observed" and not torch.isfinite(channel.sum()) and not torch.isfinite(channel).all():
                bad = int((~torch.isfinite(channel)).sum())
                raise ValueError(
                    f"terrain {name}: {bad} of {channel.numel()} cells are not finite; fill holes by interpolation and "
                    "mark them in `observed`"
                )
        for name in ("stiffness", "damping", "friction"):
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
        """A map of one material; what is visible is the ground, and all of it observed, unless given."""

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

    @classmethod
    def stack(cls, maps: Sequence[TerrainMap]) -> TerrainMap:
        """A batch ``[B, rows, columns]`` of maps that lie on one grid."""
        if any(entry.grid != maps[0].grid for entry in maps):
            raise ValueError("terrain maps on different grids cannot be stacked")
        channels = {name: torch.stack([getattr(m, name) for m in maps]) for name in (*CHANNELS, "observed")}
        return cls(**channels, grid=maps[0].grid)

    def measured_nearby(self, reach: float = 0.3) -> np.ndarray:
        """Whether a cell of one map was measured or is within ``reach`` [m] of one that was, ``[rows, columns]`` bool.

        Between a lidar's rings heights are interpolated, and as good as measured.
        """
        observed = self.observed.cpu().numpy()
        if not observed.any():
            return observed
        away = cv2.distanceTransform((~observed).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return away * self.grid.resolution <= reach + 1e-6

    @property
    def batch_size(self) -> int | None:
        """Number of maps in the batch; None for a single map."""
        return self.height.shape[0] if self.height.ndim == 3 else None

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> TerrainMap:
        """The same map in another precision or on another device."""
        changed = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, Tensor):
                changed[entry.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        if all(value is getattr(self, name) for name, value in changed.items()):
            return self
        return replace(self, **changed)
