"""Ground areas: what each part of the ground is made of, how slippery it is and how far wheels sink in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.distribution import LogUniform, Uniform
from monoforce_ros.synthetic.varied.settings import GROUND_KINDS, GroundSettings
from monoforce_ros.synthetic.vegetation import GrassPatch

# Factor on the friction of dry soil, and thickness of the soft layer [m], by kind of ground: dry and wet tyre-road and
# tyre-soil friction coefficients of Wong, Theory of Ground Vehicles, rounded and widened.
_FRICTION = {
    "meadow": (0.7, 1.0), "soil": (0.65, 0.95), "forest": (0.6, 0.9), "gravel": (0.5, 0.8), "sand": (0.45, 0.7),
    "mud": (0.25, 0.5), "snow": (0.2, 0.45), "ice": (0.08, 0.2), "asphalt": (0.85, 1.1), "concrete": (0.8, 1.05),
    "paving": (0.7, 1.0), "wet": (0.4, 0.7), "odd": (0.2, 1.1),
}  # fmt: skip
_DEPTH = {"soil": (0.0, 0.02), "gravel": (0.0, 0.02), "sand": (0.01, 0.07), "mud": (0.02, 0.1), "snow": (0.03, 0.25),
          "odd": (0.0, 0.12)}  # fmt: skip
LAYER_LIFT = LogUniform(1.0, 40.0)
"""Upward force on each of four wheels at full depth [N]: wheels sink to the firm ground below, which gives grip."""
LAYER_DRAG, LAYER_VISCOUS_DRAG = LogUniform(1.0, 22.0), LogUniform(2.0, 40.0)
_EDGE = 0.4
_PATH_HALF_WIDTH = 0.6
_GRIP_MARGIN = 0.12
"""A world's main ground has at least this much more friction than its slope needs: the robot must be able to start."""


@dataclass(frozen=True)
class Area:
    """A part of the ground.

    Attributes:
        look: kind that it looks like.
        substance: kind that friction and softness come from.
        friction: factor on the friction of ordinary ground [-].
        depth: thickness of the soft layer [m].
        lift: upward force on each of four wheels at full depth [N].
        drag, viscous_drag: resistance on a wheel at full depth [N], [N s/m].
    """

    look: str
    substance: str
    friction: float
    depth: float
    lift: float
    drag: float
    viscous_drag: float


@dataclass(frozen=True)
class GroundAreas:
    """Areas over the ground.

    Attributes:
        areas: the first one is the world's main ground.
        index: area of each cell of the ground's grid, uint8.
        depth: thickness of the soft layer [m] at each cell, with smooth edges.
        path: how worn the track is, 0..1.
    """

    areas: tuple[Area, ...]
    index: np.ndarray
    depth: np.ndarray
    path: np.ndarray

    def values(self, name: str) -> np.ndarray:
        """An attribute of the areas at each cell."""
        return np.array([getattr(area, name) for area in self.areas])[self.index]


def draw_ground_areas(
    settings: GroundSettings, ground: HeightField, route: Route, slope: float, random: np.random.Generator
) -> GroundAreas:
    """Spread areas over the ground, independent of the route except for a worn path along it."""
    drawn = settings.draw(random)
    areas = [_draw_area(drawn.kind, settings, random)]
    least = math.tan(slope) + _GRIP_MARGIN
    if areas[0].friction < least:
        areas[0] = Area(areas[0].look, areas[0].substance, least, *_softness(areas[0]))
    x, y = ground.grid()
    ragged = gaussian_filter(random.standard_normal(x.shape), 0.3 / ground.resolution)
    ragged *= 0.2 / ragged.std()
    index = np.zeros(x.shape, np.uint8)
    for _ in range(drawn.patches):
        area = _draw_area(settings.patch_kind.draw(random), settings, random)
        length, width = settings.patch_size.draw(random), settings.patch_size.draw(random)
        centre = ground.centre + random.uniform(-0.85, 0.85, 2) * (ground.half_size - 5.0)
        patch = GrassPatch(centre, random.uniform(-math.pi, math.pi), length, width)
        index[patch.edge_distance(x, y) + ragged > 0.0] = len(areas)
        areas.append(area)
    depth = gaussian_filter(np.array([area.depth for area in areas])[index], _EDGE / 2 / ground.resolution)
    path = np.zeros(x.shape)
    if drawn.path:
        path = np.clip(1.4 - route.distance(np.stack([x, y], axis=-1)) / _PATH_HALF_WIDTH, 0.0, 1.0)
        depth *= 1.0 - 0.7 * path
    return GroundAreas(tuple(areas), index, depth, path)


def _draw_area(look: str, settings: GroundSettings, random: np.random.Generator) -> Area:
    substance = look
    if settings.misleading.draw(random):
        substance = GROUND_KINDS[int(random.integers(len(GROUND_KINDS)))]
    return Area(
        look, substance, Uniform(*_FRICTION[substance]).draw(random),
        Uniform(*_DEPTH.get(substance, (0.0, 0.0))).draw(random), LAYER_LIFT.draw(random), LAYER_DRAG.draw(random),
        LAYER_VISCOUS_DRAG.draw(random),
    )  # fmt: skip


def _softness(area: Area) -> tuple[float, float, float, float]:
    return area.depth, area.lift, area.drag, area.viscous_drag
