"""World: one randomised world with its robot, cameras and driver."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from monoforce_ros.synthetic.command_profile import CommandProfile
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.recorded_camera import RecordedCamera
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.appearance import VariedAppearance
from monoforce_ros.synthetic.varied.driver import VariedDriver
from monoforce_ros.synthetic.varied.ground_areas import draw_ground_areas
from monoforce_ros.synthetic.varied.palette import from_hsv
from monoforce_ros.synthetic.varied.plants import draw_vegetation
from monoforce_ros.synthetic.varied.relief import draw_relief
from monoforce_ros.synthetic.varied.rig import draw_rig
from monoforce_ros.synthetic.varied.settings import WorldSettings
from monoforce_ros.synthetic.varied.things import Builder, place_things, plant_trees
from monoforce_ros.synthetic.varied.track import draw_route
from monoforce_ros.synthetic.vehicle import Vehicle


@dataclass(frozen=True)
class VariedWorld:
    """A drawn world.

    Attributes:
        settings: what it was drawn from.
        seed: its seed.
        scenery: ground, plants and things.
        light: drawn values of :class:`monoforce_ros.synthetic.varied.settings.LightSettings`.
        description: figures by which recordings are sorted into strata, such as ``vegetation_height`` [m].
    """

    settings: WorldSettings
    seed: int
    scenery: Scenery
    light: SimpleNamespace
    description: dict[str, float | str | bool]

    def robot(self) -> Vehicle:
        """The world's robot in its colour, without cameras.

        Raises:
            RobotFileError: a robot file was set and is invalid.
        """
        drawn = self.settings.robot.draw(self._stream("robot"))
        robot = Vehicle.load(drawn.kind)
        colour = from_hsv(drawn.hue, 0.75, drawn.brightness)
        return replace(robot, colour=(float(colour[0]), float(colour[1]), float(colour[2])))

    def rig(self, robot: Vehicle) -> tuple[RecordedCamera, ...]:
        """Cameras on the robot."""
        return draw_rig(self.settings.rig, self.settings.imaging, robot, self._stream("rig"))

    def driver(self, robot: Vehicle) -> CommandProfile:
        """Follows the world's track."""
        random = self._stream("driver")
        return VariedDriver(self.scenery.route, self.settings.route.draw(random), robot.maximum_speed, random)

    def _stream(self, purpose: str) -> np.random.Generator:
        return random_stream(self.seed, f"varied {purpose}")


def draw_world(settings: WorldSettings, seed: int) -> VariedWorld:
    """Draw a world; each group of settings has its own random stream, so that a change of one leaves the others."""

    def stream(purpose: str) -> np.random.Generator:
        return random_stream(seed, f"varied {purpose}")

    route = draw_route(settings.route, stream("route"))
    relief = draw_relief(settings.terrain, route, stream("terrain"))
    ground = relief.ground
    areas = draw_ground_areas(settings.ground, ground, route, relief.slope, stream("ground"))
    vegetation = draw_vegetation(settings.vegetation, relief, areas, route, stream("vegetation"))
    builder = Builder(ground, stream("obstacles"))
    stairs = settings.terrain.stairs.draw(stream("stairs"))
    things = place_things(settings.obstacles, stairs, route, builder, vegetation.hidden_places)
    trees = plant_trees(settings.obstacles.trees.draw(stream("tree count")), route, ground, things, stream("trees"))
    light = settings.light.draw(stream("light"))
    appearance = VariedAppearance(seed, areas, builder.materials, vegetation.materials, settings.palette, light)
    friction = HeightField(areas.values("friction"), ground.resolution, ground.origin)
    obstacles = (*things, *vegetation.foliage)
    scenery = Scenery(
        ground, route, None, (), trees, vegetation.grass, obstacles=obstacles, cores=vegetation.cores,
        friction=friction, appearance=appearance,
    )  # fmt: skip
    main = areas.areas[0]
    description: dict[str, float | str | bool] = {
        "style": settings.style,
        "seed": seed,
        "vegetation_height": round(vegetation.height, 3),
        "vegetation_coverage": round(vegetation.coverage, 4),
        "slope_deg": round(math.degrees(relief.slope), 2),
        "ground": main.look,
        "misleading_ground": main.look != main.substance,
        "friction": round(main.friction, 3),
        "sky": light.sky,
        "sun_elevation_deg": round(math.degrees(light.sun_elevation), 1),
        "shadows": light.shadows,
        "season": light.season,
        "visibility": round(light.visibility, 1),
        "obstacles": len(things),
    }
    return VariedWorld(settings, seed, scenery, light, description)
