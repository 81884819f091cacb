"""Vegetation: patches of tall grass, which look solid to sensors and are soft."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from monoforce_ros.synthetic import shapes
from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.terrain_shape import HeightField

_TUFTS_PER_AREA = 22.0
_TUFT_REACH = 4.5
_BLADES_PER_TUFT = 5


@dataclass(frozen=True)
class GrassPatch:
    """An elliptic patch with a ragged edge, in world coordinates.

    Attributes:
        centre: ``[2]`` [m].
        heading: direction of the first half-axis [rad].
        length: first half-axis [m].
        width: second half-axis [m].
    """

    centre: np.ndarray
    heading: float
    length: float
    width: float

    def edge_distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Rough distance inside the edge [m], negative outside."""
        offset_x, offset_y = x - self.centre[0], y - self.centre[1]
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        along = (cosine * offset_x + sine * offset_y) / self.length
        across = (cosine * offset_y - sine * offset_x) / self.width
        return (1.0 - np.hypot(along, across)) * min(self.length, self.width)


@dataclass(frozen=True, kw_only=True)
class GrassSettings:
    """Height, density and stiffness of grass.

    Attributes:
        height: height of the canopy inside a patch [m].
        edge: width over which the canopy rises from zero to its full height [m].
        density: blades per area [1/m²].
        blade_width: [m].
        spring: upward force on a wheel per depth below the canopy [N/m].
        drag: resistance at low speed on a wheel in grass of full height [N].
        viscous_drag: additional resistance per speed [N s/m].
    """

    height: float = 0.42
    edge: float = 0.5
    density: float = 560.0
    blade_width: float = 0.016
    spring: float = 110.0
    drag: float = 20.0
    viscous_drag: float = 48.0

    def __post_init__(self):
        for name in ("height", "edge", "density", "blade_width"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected a positive number")
        for name in ("spring", "drag", "viscous_drag"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected 0 or more")


@dataclass(frozen=True)
class Grass:
    """The canopy over a ground, and its forces on wheels.

    Attributes:
        settings: height, density and stiffness.
        canopy: height of the canopy above the ground, on the ground's grid.
        tiles: meshes of blades, one for each patch.
        layer: thickness of a soft layer on the ground, such as snow, on the ground's grid; None without one.
    """

    settings: GrassSettings
    canopy: HeightField
    tiles: tuple[shapes.Shape, ...]
    layer: HeightField | None = None

    @classmethod
    def grow(
        cls,
        patches: tuple[GrassPatch, ...],
        ground: HeightField,
        random: np.random.Generator,
        settings: GrassSettings | None = None,
    ) -> Grass:
        """Grow patches on a ground."""
        settings = settings or GrassSettings()
        x, y = ground.grid()
        ragged = gaussian_filter(random.standard_normal(x.shape), 0.25 / ground.resolution)
        ragged *= 0.16 / ragged.std()
        heights = np.zeros(x.shape)
        for patch in patches:
            inside = np.clip((patch.edge_distance(x, y) + ragged) / settings.edge, 0.0, 1.0)
            heights = np.maximum(heights, settings.height * inside)
        uneven = gaussian_filter(random.standard_normal(x.shape), 0.4 / ground.resolution)
        heights *= 1.0 + 0.12 * uneven / uneven.std()
        canopy = HeightField(heights, ground.resolution, ground.origin)
        return cls(settings, canopy, tuple(_blades_of(patch, canopy, ground, settings, random) for patch in patches))

    @property
    def soft_cells(self) -> np.ndarray:
        """Cells of the ground's grid on which wheels may feel forces."""
        cells = self.canopy.heights > 0.0
        return cells if self.layer is None else cells | (self.layer.heights > 0.0)

    def height_at(self, positions: np.ndarray) -> np.ndarray:
        """Height of the canopy above the ground [m] at world positions ``[..., 2]``."""
        return self.canopy.height_at(positions)

    def wheel_forces(
        self,
        ground: HeightField,
        centres: np.ndarray,
        radii: np.ndarray,
        velocities: np.ndarray,
        share: float = 1.0,
    ) -> np.ndarray | None:
        """Forces of the grass on wheels.

        Args:
            ground: the ground below the grass.
            centres: ``[n, 3]`` world positions of the wheels' centres [m].
            radii: ``[n]`` [m].
            velocities: ``[n, 3]`` of the centres, in the world frame [m/s].
            share: factor on the forces, 1 for a robot with four wheels.

        Returns:
            ``[n, 3]`` forces in the world frame [N], or None if no wheel touches grass.
        """
        canopy = self.height_at(centres[:, :2])
        if not canopy.any():
            return None
        depth = np.clip(ground.height_at(centres[:, :2]) + canopy - (centres[:, 2] - radii), 0.0, canopy)
        speed = np.linalg.norm(velocities[:, :2], axis=1)
        drag = (
            depth
            / self.settings.height
            * (self.settings.drag * np.tanh(speed / 0.05) + self.settings.viscous_drag * speed)
        )
        forces = np.zeros((len(centres), 3))
        forces[:, :2] = -(drag / np.maximum(speed, 1e-6))[:, None] * velocities[:, :2]
        forces[:, 2] = self.settings.spring * depth
        return share * forces


def short_grass(
    ground: HeightField, route: Route, cover: np.ndarray, tile: HeightField, random: np.random.Generator
) -> shapes.Shape:
    """Tufts of short grass along a route, only for images: wheels and lidar rays ignore them.

    Args:
        ground: the ground below them.
        route: tufts grow within a few metres of it.
        cover: density of grass in 0..1, ``[rows, columns]`` over the extent of ``ground``.
        tile: the part of the ground to cover.
        random: generator of positions and shapes.
    """
    size = 2 * tile.half_size
    tufts = tile.origin + random.uniform(0.0, size, (round(_TUFTS_PER_AREA * size**2), 2))
    cells = ((tufts - ground.origin) / (2 * ground.half_size) * cover.shape[0]).astype(int)
    cells = np.clip(cells, 0, cover.shape[0] - 1)
    near = route.distance(tufts)
    keep = cover[cells[:, 1], cells[:, 0]] > random.uniform(0.3, 1.0, len(tufts))
    keep &= near < random.uniform(1.0, _TUFT_REACH, len(tufts))
    centres = np.repeat(tufts[keep], _BLADES_PER_TUFT, axis=0)
    if not len(centres):
        return shapes.EMPTY
    offsets = random.normal(0.0, 0.028, centres.shape)
    positions = np.clip(centres + offsets, ground.origin, ground.origin + 2 * ground.half_size)
    roots = np.concatenate([positions, ground.height_at(positions)[:, None] - 0.01], axis=1)
    heights = random.uniform(0.04, 0.11, len(roots))
    return shapes.blades(roots, heights, 0.012, 9.0 * offsets + 0.15 * random.standard_normal(offsets.shape), random)


def _blades_of(
    patch: GrassPatch, canopy: HeightField, ground: HeightField, settings: GrassSettings, random: np.random.Generator
) -> shapes.Shape:
    reach = max(patch.length, patch.width) + 0.6
    count = round(settings.density * (2 * reach) ** 2)
    positions = patch.centre + random.uniform(-reach, reach, (count, 2))
    heights = canopy.height_at(positions)
    tall = heights > 0.06
    positions, heights = positions[tall], heights[tall]
    # A wind direction that varies over the patch, and random variation of each blade.
    swirl = 1.7 * np.sin(1.1 * positions[:, 0] + 0.6) + 1.3 * np.cos(0.9 * positions[:, 1])
    lean = 0.22 * np.stack([np.cos(swirl), np.sin(swirl)], axis=1) + 0.2 * random.standard_normal(positions.shape)
    heights = heights * random.uniform(0.6, 1.15, len(heights))
    roots = np.concatenate([positions, ground.height_at(positions)[:, None] - 0.01], axis=1)
    return shapes.blades(roots, heights, settings.blade_width, lean, random)
