"""Relief: the shape of a randomised world's ground, with hills, banks, ditches, steps, ramps and a slope."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.terrain_shape import HeightField, Kerb, Ramp
from monoforce_ros.synthetic.varied.settings import TerrainShapeSettings

SIZE, RESOLUTION = 40.0, 0.1
_LEVEL_RADIUS, _LEVEL_EDGE = 0.7, 1.2
_RIM_WIDTH = 6.0
_CLIMBABLE = 0.11
"""Largest step on the track [m]; the smallest shipped wheel has a radius of 0.165 m."""


@dataclass(frozen=True)
class Relief:
    """The ground, and the ditches in it.

    Attributes:
        ground: heights that carry wheels.
        ditches: mask of the ground's grid.
        slope: inclination of the whole world [rad].
    """

    ground: HeightField
    ditches: np.ndarray
    slope: float


def draw_relief(settings: TerrainShapeSettings, route: Route, random: np.random.Generator) -> Relief:
    """Shape the ground; it is level at height 0 where the route starts."""
    drawn = settings.draw(random)
    count = 2 * round(SIZE / RESOLUTION / 2) + 1
    middle = (route.points.min(axis=0) + route.points.max(axis=0)) / 2
    # Whole cells, so that the start lies on a vertex.
    middle = np.round(middle / RESOLUTION) * RESOLUTION
    field = HeightField(np.zeros((count, count)), RESOLUTION, middle - (count - 1) * RESOLUTION / 2)
    x, y = field.grid()
    heights = _noise(count, drawn.hill_size, drawn.hill_height, random)
    heights += _noise(count, 0.5, drawn.bumps, random)
    direction = np.array([math.cos(drawn.slope_direction), math.sin(drawn.slope_direction)])
    heights += math.tan(drawn.slope) * (direction[0] * x + direction[1] * y)
    for _ in range(drawn.banks):
        heights += _bank(x, y, field, random)
    ditches = np.zeros(heights.shape, bool)
    for _ in range(drawn.ditches):
        depth = _ditch(x, y, route, random)
        heights -= depth
        ditches |= depth > 0.5 * depth.max()
    heights *= _steepness_factor(field, heights, route, drawn.steepest)
    heights += _noise(count, 0.12, drawn.roughness, random)
    for _ in range(drawn.ramps):
        heights = _with_ramp(x, y, heights, route, random)
    for _ in range(drawn.steps):
        heights += _step(x, y, route, random)
    from_start = np.hypot(x, y)
    start = round(-field.origin[1] / RESOLUTION), round(-field.origin[0] / RESOLUTION)
    heights = (heights - heights[start]) * np.clip((from_start - _LEVEL_RADIUS) / _LEVEL_EDGE, 0.0, 1.0)
    edge = field.half_size - np.maximum(np.abs(x - field.centre[0]), np.abs(y - field.centre[1]))
    heights += drawn.rim * np.clip(1.0 - edge / _RIM_WIDTH, 0.0, 1.0) ** 1.5
    return Relief(HeightField(heights, RESOLUTION, field.origin), ditches, drawn.slope)


def _noise(count: int, scale: float, deviation: float, random: np.random.Generator) -> np.ndarray:
    layer = gaussian_filter(random.standard_normal((count, count)), scale / RESOLUTION / 2, mode="wrap")
    return deviation * layer / layer.std()


def _place(route: Route, random: np.random.Generator, share_on_track: float = 0.5) -> tuple[np.ndarray, float, bool]:
    """A random place on the track or beside it: position ``[2]``, heading [rad], and whether it is on the track."""
    is_on_track = random.random() < share_on_track
    # Not at the start, where the robot settles.
    station = random.uniform(3.5, route.length - 3.0)
    lateral = random.normal(0.0, 0.4) if is_on_track else random.choice([-1.0, 1.0]) * random.uniform(1.2, 6.5)
    centre, heading = route.at(station, lateral)
    turn = random.normal(0.0, 0.35) if is_on_track else random.uniform(-math.pi, math.pi)
    return centre, heading + turn, is_on_track


def _bank(x: np.ndarray, y: np.ndarray, field: HeightField, random: np.random.Generator) -> np.ndarray:
    """A terrace on one side of a wavy line, or a dam along it."""
    centre = field.centre + random.uniform(-12.0, 12.0, 2)
    heading = random.uniform(-math.pi, math.pi)
    along = np.cos(heading) * (x - centre[0]) + np.sin(heading) * (y - centre[1])
    across = np.cos(heading) * (y - centre[1]) - np.sin(heading) * (x - centre[0])
    across = across + random.uniform(0.0, 1.5) * np.sin(along / random.uniform(2.0, 6.0) + random.uniform(0.0, 6.3))
    height, width = random.uniform(0.15, 1.1), random.uniform(0.5, 2.5)
    if random.random() < 0.5:
        return height * 0.5 * (1.0 + np.tanh(across / width))
    return height * np.exp(-((across / width) ** 2))


def _ditch(x: np.ndarray, y: np.ndarray, route: Route, random: np.random.Generator) -> np.ndarray:
    """Depth of a ditch of finite length [m]."""
    centre, heading, _ = _place(route, random)
    along = np.cos(heading) * (y - centre[1]) - np.sin(heading) * (x - centre[0])
    across = np.cos(heading) * (x - centre[0]) + np.sin(heading) * (y - centre[1])
    across = across + random.uniform(0.0, 0.5) * np.sin(along / random.uniform(1.0, 4.0))
    length, width = random.uniform(1.5, 9.0), random.uniform(0.25, 0.9)
    ends = np.clip((length - np.abs(along)) / 0.8, 0.0, 1.0)
    return random.uniform(0.08, 0.5) * ends * np.exp(-((np.abs(across) / width) ** random.uniform(1.5, 5.0)))


def _step(x: np.ndarray, y: np.ndarray, route: Route, random: np.random.Generator) -> np.ndarray:
    """An abrupt step up or down that levels out on its other side."""
    centre, heading, is_on_track = _place(route, random)
    height = random.uniform(0.03, _CLIMBABLE if is_on_track else 0.3)
    if random.random() < 0.5:
        heading += math.pi
    kerb = Kerb(
        centre, heading, height, random.uniform(0.3, 2.5), random.uniform(0.8, 3.0), random.uniform(1.0, 4.0),
        random.uniform(0.2, 1.0),
    )  # fmt: skip
    return kerb.height_at(x, y)


def _with_ramp(
    x: np.ndarray, y: np.ndarray, heights: np.ndarray, route: Route, random: np.random.Generator
) -> np.ndarray:
    centre, heading, _ = _place(route, random, 0.7)
    height = random.uniform(0.12, 0.65)
    ramp = Ramp(
        centre, heading, height, random.uniform(0.4, 2.0), height / math.tan(random.uniform(0.18, 0.42)),
        random.uniform(1.3, 2.6), random.uniform(0.3, 1.2),
    )  # fmt: skip
    added = ramp.height_at(x, y)
    # Hills under the ramp would deform it: its base has the height of the ground at its middle.
    near = gaussian_filter((added > 0.0).astype(float), 0.5 / RESOLUTION)
    base = float(heights[np.unravel_index(np.argmin((x - centre[0]) ** 2 + (y - centre[1]) ** 2), x.shape)])
    return heights + 0.8 * near * (base - heights) + gaussian_filter(added, 0.05 / RESOLUTION)


def _steepness_factor(field: HeightField, heights: np.ndarray, route: Route, steepest: float) -> float:
    """Factor on the heights with which the track's slope stays below ``steepest`` [rad] on 97 % of its length."""
    slopes = np.abs(np.stack(np.gradient(heights, field.resolution))).max(axis=0)
    slope = HeightField(slopes, field.resolution, field.origin).height_at(route.points)
    return float(min(1.0, math.tan(steepest) / max(float(np.quantile(slope, 0.97)), 1e-6)))
