"""Terrain shape: height field of the ground, with hills, a ramp, kerbs and a rim that hides the world's edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from monoforce_ros.synthetic.route import Route

# Wavelength-like scale [m] and standard deviation [m] of each layer of hills at roughness 1.
_HILLS = ((2.6, 0.13), (1.0, 0.045), (0.35, 0.010))
_LEVEL_RADIUS = 1.0
_RIM_WIDTH = 6.0
GROUNDS = ("mixed", "rigid", "grass", "yard")


@dataclass(frozen=True, kw_only=True)
class TerrainSettings:
    """Settings of the ground.

    Attributes:
        size: edge length of the square world [m].
        resolution: spacing of the heights [m].
        roughness: factor on the height of the hills [-].
        flat: level ground without hills, ramp, rocks, trees, walls or grass.
        bare: hills without anything on them.
        ground: ``mixed`` (some patches of tall grass), ``rigid`` (no grass), ``grass`` (along most of the route), or
            ``yard`` (hills with walls and grass around the start).
    """

    size: float = 40.0
    resolution: float = 0.1
    roughness: float = 1.0
    flat: bool = False
    bare: bool = False
    ground: str = "mixed"

    def __post_init__(self):
        if self.ground not in GROUNDS:
            raise ValueError(f"ground: got {self.ground!r}, expected one of {GROUNDS}")
        if not 30.0 <= self.size <= 200.0:
            raise ValueError(f"size: got {self.size}, expected 30 to 200 m")
        if not 0.02 <= self.resolution <= 0.5:
            raise ValueError(f"resolution: got {self.resolution}, expected 0.02 to 0.5 m")
        if not 0.0 <= self.roughness <= 3.0:
            raise ValueError(f"roughness: got {self.roughness}, expected 0 to 3")


@dataclass(frozen=True)
class Ramp:
    """A flat-topped mound: ascent, plateau and descent, with sloping sides.

    Attributes:
        centre: ``[2]`` world position [m].
        heading: driving direction across it [rad].
    """

    centre: np.ndarray
    heading: float
    height: float = 0.42
    plateau_length: float = 1.0
    slope_length: float = 1.5
    plateau_width: float = 1.9
    side_length: float = 0.8

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height [m] that the ramp adds at world positions; any shape, the same for ``x`` and ``y``."""
        offset_x, offset_y = x - self.centre[0], y - self.centre[1]
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        along = np.abs(cosine * offset_x + sine * offset_y) - self.plateau_length / 2
        across = np.abs(cosine * offset_y - sine * offset_x) - self.plateau_width / 2
        rise = np.minimum(1.0 - along / self.slope_length, 1.0 - across / self.side_length)
        return self.height * np.clip(rise, 0.0, 1.0)


@dataclass(frozen=True)
class Kerb:
    """A step up across the route, level behind its edge, then descending to the ground.

    Attributes:
        centre: ``[2]`` world position of the middle of the edge [m].
        heading: driving direction up the step [rad].
        height: [m].
    """

    centre: np.ndarray
    heading: float
    height: float
    level_length: float = 1.2
    fall_length: float = 1.6
    width: float = 2.6
    side_length: float = 0.6

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height [m] that the kerb adds at world positions; any shape, the same for ``x`` and ``y``."""
        offset_x, offset_y = x - self.centre[0], y - self.centre[1]
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        along = cosine * offset_x + sine * offset_y
        across = np.abs(cosine * offset_y - sine * offset_x) - self.width / 2
        fall = 1.0 - (along - self.level_length) / self.fall_length
        return self.height * np.clip(np.minimum(fall, 1.0 - across / self.side_length), 0.0, 1.0) * (along >= 0.0)


@dataclass(frozen=True)
class HeightField:
    """Heights on a square grid, triangulated like MuJoCo's height fields.

    Attributes:
        heights: ``[row = y, column = x]`` [m].
        resolution: spacing of the heights [m].
        origin: ``[2]`` world position of ``heights[0, 0]`` [m].
    """

    heights: np.ndarray
    resolution: float
    origin: np.ndarray

    @property
    def half_size(self) -> float:
        """Half the edge length [m]."""
        return (self.heights.shape[0] - 1) * self.resolution / 2

    @property
    def centre(self) -> np.ndarray:
        """World position of the middle ``[2]`` [m]."""
        return self.origin + self.half_size

    def contains(self, position: np.ndarray, margin: float) -> bool:
        """Whether a world position ``[2]`` is more than ``margin`` metres inside the edge."""
        return bool((np.abs(position - self.centre) < self.half_size - margin).all())

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """World coordinates x and y [m] of the heights, each ``[rows, columns]``."""
        steps = np.arange(self.heights.shape[0]) * self.resolution
        return np.meshgrid(self.origin[0] + steps, self.origin[1] + steps)

    def height_at(self, positions: np.ndarray) -> np.ndarray:
        """Height [m] at world positions ``[..., 2]``, on the triangles' planes; clamped at the edge."""
        cells = (np.asarray(positions) - self.origin) / self.resolution
        cells = np.clip(cells, 0.0, self.heights.shape[0] - 1 - 1e-9)
        column, row = np.floor(cells[..., 0]).astype(int), np.floor(cells[..., 1]).astype(int)
        x, y = cells[..., 0] - column, cells[..., 1] - row
        low, high = self.heights[row, column], self.heights[row + 1, column + 1]
        # Each cell is cut along its diagonal from (row, column) to (row + 1, column + 1).
        corner = np.where(x > y, self.heights[row, column + 1], self.heights[row + 1, column])
        smaller, larger = np.minimum(x, y), np.maximum(x, y)
        return low + (larger - smaller) * (corner - low) + smaller * (high - low)

    def nearest(self, positions: np.ndarray) -> np.ndarray:
        """Value of the nearest cell at world positions ``[..., 2]``; clamped at the edge."""
        cells = np.nan_to_num((np.asarray(positions) - self.origin) / self.resolution)
        cells = np.clip(np.rint(cells).astype(int), 0, self.heights.shape[0] - 1)
        return self.heights[cells[..., 1], cells[..., 0]]

    def triangles(self, step: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Vertices ``[n, 3]`` [m] and faces ``[m, 3]`` of every ``step``-th height, counter-clockwise from above."""
        x, y = (axis[::step, ::step] for axis in self.grid())
        vertices = np.stack([x, y, self.heights[::step, ::step]], axis=-1).reshape(-1, 3)
        count = x.shape[0]
        corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
        faces = [[corner, corner + 1, corner + count + 1], [corner, corner + count + 1, corner + count]]
        return vertices, np.concatenate([np.stack(face, axis=1) for face in faces])

    def normals(self) -> np.ndarray:
        """Unit normals ``[rows, columns, 3]`` of the smooth surface through the heights."""
        slope_y, slope_x = np.gradient(self.heights, self.resolution)
        normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def build_ground(
    settings: TerrainSettings,
    route: Route,
    ramp: Ramp | None,
    random: np.random.Generator,
    kerbs: Sequence[Kerb] = (),
) -> HeightField:
    """Shape the ground around a route; it is level at height 0 where the route starts."""
    count = 2 * round(settings.size / settings.resolution / 2) + 1
    middle = (route.points.min(axis=0) + route.points.max(axis=0)) / 2
    # Whole cells, so that the start lies on a vertex.
    middle = np.round(middle / settings.resolution) * settings.resolution
    origin = middle - (count - 1) * settings.resolution / 2
    field = HeightField(np.zeros((count, count)), settings.resolution, origin)
    if settings.flat:
        return field
    x, y = field.grid()
    heights = np.zeros((count, count))
    for scale, deviation in _HILLS:
        layer = gaussian_filter(random.standard_normal((count, count)), scale / settings.resolution / 2, mode="wrap")
        heights += settings.roughness * deviation * layer / layer.std()
    from_start = np.hypot(x, y)
    start = round(-origin[1] / settings.resolution), round(-origin[0] / settings.resolution)
    heights -= heights[start] * np.exp(-((from_start / 4.0) ** 2))
    heights *= np.clip((from_start - _LEVEL_RADIUS) / 1.5, 0.0, 1.0)
    if ramp is not None:
        added = ramp.height_at(x, y)
        # Hills under the ramp would deform it.
        near = gaussian_filter((added > 0.0).astype(float), 0.5 / settings.resolution)
        heights = heights * (1.0 - 0.8 * near) + gaussian_filter(added, 0.06 / settings.resolution)
    for kerb in kerbs:
        added = kerb.height_at(x, y)
        near = gaussian_filter((added > 0.0).astype(float), 0.4 / settings.resolution)
        heights = heights * (1.0 - 0.8 * near) + added
    edge = field.half_size - np.maximum(np.abs(x - field.centre[0]), np.abs(y - field.centre[1]))
    heights += 2.2 * np.clip(1.0 - edge / _RIM_WIDTH, 0.0, 1.0) ** 1.5
    return HeightField(heights, settings.resolution, origin)
