"""Wall ahead: a wall, a post or soft vegetation that looks like one across a robot's way, in any texture and colour."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from monoforce_ros.synthetic.obstacle import Obstacle
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.appearance import VariedAppearance
from monoforce_ros.synthetic.varied.ground_areas import draw_ground_areas
from monoforce_ros.synthetic.varied.plants import MixedGrass, Species, grow_blades
from monoforce_ros.synthetic.varied.relief import draw_relief
from monoforce_ros.synthetic.varied.settings import WorldSettings
from monoforce_ros.synthetic.varied.things import Builder
from monoforce_ros.synthetic.varied.track import draw_route
from monoforce_ros.synthetic.vegetation import GrassSettings

AHEAD_KINDS = ("wall", "post", "vegetation")
NEAREST, FARTHEST = 0.6, 6.0
"""Distance of the obstacle's near side from the robot's front [m]."""
_HEIGHT = (0.15, 1.2)
_CORRIDOR = 1.6
"""Half the width of the way ahead that is clear of other things [m]."""
# Ground that a Husky crosses at the commanded speed, so that only the obstacle stops it, in light that needs no
# exposure control.
_WAY = {
    "terrain.slope": "0..0.03", "terrain.hill_height": "0.02..0.06", "terrain.banks": "0", "terrain.ditches": "0",
    "terrain.steps": "0", "terrain.ramps": "0", "ground.kind": "meadow,soil,gravel,asphalt,concrete,paving",
    "ground.misleading": "false", "ground.patches": "0", "light.sky": "day,overcast,sunset,odd",
    "light.sun": "0.6..1.05", "light.ambient": "0.4..0.6",
}  # fmt: skip
# Forces of the soft vegetation on a wheel: the robot slows down and drives through.
_SOFT = {"lift": 15.0, "drag": 4.0, "viscous_drag": 8.0}


@dataclass(frozen=True)
class WallAhead:
    """A scene.

    Attributes:
        kind: one of :data:`AHEAD_KINDS`.
        distance: from the robot's front to the near side [m].
        height: [m].
        scenery: the world; the robot starts at its origin and drives along x.
    """

    kind: str
    distance: float
    height: float
    scenery: Scenery


def draw_wall_ahead(kind: str, seed: int, front: float) -> WallAhead:
    """Draw a scene; distance and height are those of the seed for every kind.

    Args:
        kind: one of :data:`AHEAD_KINDS`.
        seed: seed of the world.
        front: distance of the robot's front from its base frame [m].

    Raises:
        ValueError: the kind is unknown.
    """
    if kind not in AHEAD_KINDS:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(AHEAD_KINDS)}")
    settings = WorldSettings().narrowed(_WAY)

    def stream(purpose: str) -> np.random.Generator:
        return random_stream(seed, f"wall ahead {purpose}")

    random = stream("obstacle")
    distance, height = random.uniform(NEAREST, FARTHEST), random.uniform(*_HEIGHT)
    thickness = random.uniform(0.06, 0.5)
    width, side, turn = random.uniform(2.0, 5.0), random.uniform(-0.4, 0.4), random.uniform(-0.2, 0.2)
    route = draw_route(settings.route, stream("route"))
    relief = draw_relief(settings.terrain, route, stream("terrain"))
    ground = relief.ground
    areas = draw_ground_areas(settings.ground, ground, route, relief.slope, stream("ground"))
    builder = Builder(ground, stream("materials"))
    things: list[Obstacle] = []
    reach = distance + front + (thickness if kind != "post" else 0.04) / 2
    centre = np.array([reach, side])
    species = Species("heath", "plants_0", height, 2500.0, is_firm=False, **_SOFT)
    heights = np.zeros(ground.heights.shape)
    if kind == "wall":
        things.append(builder.box("wall", centre, math.pi / 2 + turn, np.array([width, thickness, height])))
    elif kind == "post":
        # In front of a wheel or the body: half a Husky's width to either side.
        things.append(builder.post(np.array([reach, 0.6 * side]), height))
    else:
        x, y = ground.grid()
        across = (x - centre[0]) * math.cos(turn) + (y - centre[1]) * math.sin(turn)
        along = (y - centre[1]) * math.cos(turn) - (x - centre[0]) * math.sin(turn)
        hedge = (np.abs(across) <= max(thickness, 0.25) / 2) & (np.abs(along) <= width / 2)
        uneven = gaussian_filter(stream("hedge").standard_normal(x.shape), 3.0)
        heights = np.where(hedge, height * (1.0 + 0.05 * uneven / uneven.std()), 0.0)
        things += grow_blades([species], np.zeros(x.shape, int), heights, ground, stream("leaves"))
    things += _bystanders(builder, reach)
    field = lambda values: HeightField(values, ground.resolution, ground.origin)  # noqa: E731
    inside = heights > 0.0
    grass = MixedGrass(
        GrassSettings(), field(heights), (), None, np.where(inside, height, 0.0),
        *(np.where(inside, _SOFT[name], 0.0) for name in ("lift", "drag", "viscous_drag")),
    )  # fmt: skip
    light = settings.light.draw(stream("light"))
    plants = {species.material: species.kind}
    appearance = VariedAppearance(seed, areas, builder.materials, plants, settings.palette, light)
    friction = field(areas.values("friction"))
    scenery = Scenery(
        ground, route, None, (), (), grass, obstacles=tuple(things), friction=friction, appearance=appearance
    )
    return WallAhead(kind, distance, height, scenery)


def _bystanders(builder: Builder, reach: float) -> list[Obstacle]:
    """Things beside the way, so that an object somewhere in the image means nothing."""
    random, found = builder.random, []
    for make in (builder.wall, builder.crate, builder.boulder, builder.pole, builder.log, builder.vehicle):
        for _ in range(int(random.integers(0, 3))):
            position = np.array([random.uniform(0.0, 11.0), random.choice([-1.0, 1.0]) * random.uniform(1.5, 6.5)])
            thing = make(position, random.uniform(-math.pi, math.pi))
            if abs(position[1]) > _CORRIDOR + thing.radius:
                found.append(thing)
    return found
