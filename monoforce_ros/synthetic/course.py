"""Course: an obstacle course ahead of the robot, with a wall and behind it a band of tall grass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.scenery import Scenery, Wall, standing_wall
from monoforce_ros.synthetic.terrain_shape import HeightField, TerrainSettings, build_ground
from monoforce_ros.synthetic.vegetation import Grass, GrassPatch

_WALL_HEIGHT = 0.9
WALL_THICKNESS = 0.25
"""Thickness of the wall [m]."""


@dataclass(frozen=True, kw_only=True)
class CourseSettings:
    """Obstacles ahead of a robot that starts at the origin and faces along x; distances in metres.

    Attributes:
        wall: distance of a wall across the robot's path; None for no wall.
        wall_width: length of the wall.
        wall_side: offset of the wall's centre to the left.
        grass: distance of the near edge of a band of tall grass that cannot be bypassed; None for no grass.
        grass_depth: extent of the band along x.
        roughness: factor on the height of the hills.
    """

    wall: float | None = 3.0
    wall_width: float = 2.2
    wall_side: float = 0.0
    grass: float | None = 5.2
    grass_depth: float = 1.8
    roughness: float = 0.4

    def __post_init__(self):
        for name, low, high in (
            ("wall", 1.0, 12.0), ("wall_width", 0.3, 12.0), ("wall_side", -6.0, 6.0), ("grass", 1.0, 12.0),
            ("grass_depth", 0.3, 8.0), ("roughness", 0.0, 2.0),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"course {name}: got {value}, expected {low:g} to {high:g} m")

    @classmethod
    def draw(cls, seed: int) -> CourseSettings:
        """A random course."""
        random = random_stream(seed, "course")
        return cls(
            wall=random.uniform(2.6, 3.4), wall_width=random.uniform(1.6, 2.6), wall_side=random.uniform(-0.5, 0.5),
            grass=random.uniform(5.0, 5.8), grass_depth=random.uniform(1.4, 2.2),
        )  # fmt: skip


def build_course(settings: CourseSettings, seed: int) -> Scenery:
    """Lay out a course on hills of a seed."""
    route = Route(random_stream(seed, "route"))
    terrain = TerrainSettings(bare=True, roughness=settings.roughness)
    ground = build_ground(terrain, route, None, random_stream(seed, "ground"))
    patches: tuple[GrassPatch, ...] = ()
    if settings.grass is not None:
        middle = np.array([settings.grass + settings.grass_depth / 2, 0.0])
        # The ellipse is so wide that its edges are straight within the robot's map.
        patches = (GrassPatch(middle, 0.0, settings.grass_depth / 2, 12.0),)
    grass = Grass.grow(patches, ground, random_stream(seed, "grass"))
    walls = () if settings.wall is None else (_wall(settings, settings.wall, ground),)
    return Scenery(ground, route, None, (), (), grass, walls=walls)


def _wall(settings: CourseSettings, distance: float, ground: HeightField) -> Wall:
    centre = np.array([distance + WALL_THICKNESS / 2, settings.wall_side])
    size = np.array([settings.wall_width, WALL_THICKNESS, _WALL_HEIGHT])
    return standing_wall(ground, centre, np.pi / 2, size)
