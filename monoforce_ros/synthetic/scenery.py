"""Scenery: positions and shapes of the rocks, trees, walls and grass of a world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from monoforce_ros.synthetic import shapes
from monoforce_ros.synthetic.obstacle import Obstacle
from monoforce_ros.synthetic.paint import Paint
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.terrain_shape import HeightField, Kerb, Ramp, TerrainSettings, build_ground
from monoforce_ros.synthetic.vegetation import Grass, GrassPatch

RAMP_STATION = 11.4
# Along the route [m], to its left [m], radius along the route and across it [m].
_GRASS_PATCHES = (
    (4.9, 0.1, 1.5, 1.9),
    (7.6, -3.6, 1.3, 1.0),
    (17.5, 0.2, 1.6, 1.8),
    (24.5, 2.4, 1.2, 1.4),
    (31.0, -0.2, 1.7, 1.7),
    (41.5, 0.3, 1.4, 1.9),
)
# Additional patches of a world with ground ``grass``.
_MORE_GRASS = (
    (8.3, 0.3, 1.5, 1.7),
    (14.6, -0.3, 1.5, 1.8),
    (21.0, -0.2, 1.6, 1.7),
    (24.3, -0.4, 1.5, 1.6),
    (27.7, 0.3, 1.6, 1.8),
    (34.4, -0.3, 1.7, 1.8),
    (37.9, 0.2, 1.5, 1.7),
)
# Along the route [m], out of sight in short recordings.
_KERB_STATIONS = (20.5, 38.0)
_PATCH_STATIONS = (14.5, 22.5, 27.5, 34.5)
_YARD_SECTORS = 6
_OPAQUE_HEIGHT = 0.1
"""Height of grass that hides the ground [m]."""
_WALLS = 5
_BOULDERS, _STONES, _TREES, _RIM_TREES = 26, 46, 30, 26


@dataclass(frozen=True)
class Tree:
    """A tree at world position ``base`` ``[3]`` [m]; ``foliage`` is ``broad`` or ``conifer``."""

    foliage: str
    base: np.ndarray
    trunk_radius: float
    stem: shapes.Shape
    crown: shapes.Shape


@dataclass(frozen=True)
class GroundPatch:
    """An elliptic patch of ground with lower friction.

    Attributes:
        area: outline.
        cores: height of firm cores inside vegetation above the ground, on its grid [m], which neither cameras nor the
            lidar see; None without any.
        friction: factor on the friction of ordinary ground [-].
        kind: ``mud`` or ``gravel``.
    """

    area: GrassPatch
    friction: float
    kind: str

    def contains(self, positions: np.ndarray) -> np.ndarray:
        """Whether world positions ``[..., 2]`` lie in it."""
        return self.area.edge_distance(positions[..., 0], positions[..., 1]) > 0.0


@dataclass(frozen=True)
class Wall:
    """A free-standing wall.

    Attributes:
        centre: ``[2]`` [m].
        heading: direction along it [rad].
        size: length, thickness and height [m].
    """

    centre: np.ndarray
    heading: float
    size: np.ndarray
    shape: shapes.Shape

    def contains(self, x: np.ndarray, y: np.ndarray, *, margin: float = 0.0) -> np.ndarray:
        """Whether world positions lie in its footprint, grown by ``margin`` [m]."""
        offset_x, offset_y = x - self.centre[0], y - self.centre[1]
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        along, across = cosine * offset_x + sine * offset_y, cosine * offset_y - sine * offset_x
        return (np.abs(along) <= self.size[0] / 2 + margin) & (np.abs(across) <= self.size[1] / 2 + margin)


class Appearance(Protocol):
    """How a world looks."""

    def paint(self, scenery: Scenery) -> Paint:
        """Colours, sky and light of a world."""
        ...


@dataclass(frozen=True)
class Scenery:
    """Everything in a world except the robot; positions in world coordinates [m].

    Attributes:
        obstacles: objects of randomised worlds, which have materials of their own.
        cores: height of firm cores inside vegetation above the ground, on its grid [m], which neither cameras nor the
            lidar see; None without any.
        friction: factor on the friction of ordinary ground over the whole ground; None leaves it to ``patches``.
        appearance: colours of a randomised world; None stands for those of :func:`textures.nature`.
    """

    ground: HeightField
    route: Route
    ramp: Ramp | None
    rocks: tuple[shapes.Shape, ...]
    trees: tuple[Tree, ...]
    grass: Grass
    kerbs: tuple[Kerb, ...] = ()
    patches: tuple[GroundPatch, ...] = ()
    walls: tuple[Wall, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    cores: HeightField | None = None
    friction: HeightField | None = None
    appearance: Appearance | None = None

    @property
    def support(self) -> HeightField:
        """The ground that carries and stops wheels: the ground and the firm cores of plants."""
        if self.cores is None:
            return self.ground
        return HeightField(self.ground.heights + self.cores.heights, self.ground.resolution, self.ground.origin)

    @property
    def surface(self) -> HeightField:
        """The ground that cameras and the lidar see: a soft layer, such as snow, lies on the one that carries."""
        layer = self.grass.layer
        if layer is None:
            return self.ground
        return HeightField(self.ground.heights + layer.heights, self.ground.resolution, self.ground.origin)


def build_scenery(settings: TerrainSettings, seed: int) -> Scenery:
    """Lay out a world; each kind of object has its own random stream."""
    route = Route(random_stream(seed, "route"))
    if settings.flat or settings.bare:
        ground = build_ground(settings, route, None, random_stream(seed, "ground"))
        return Scenery(ground, route, None, (), (), Grass.grow((), ground, random_stream(seed, "grass")))
    if settings.ground == "yard":
        return _build_yard(settings, route, seed)
    ramp = Ramp(*route.at(RAMP_STATION))
    kerbs = _place_kerbs(route, random_stream(seed, "kerbs"))
    ground = build_ground(settings, route, ramp, random_stream(seed, "ground"), kerbs)
    patches = []
    grown = {"mixed": _GRASS_PATCHES, "rigid": (), "grass": (*_GRASS_PATCHES, *_MORE_GRASS)}[settings.ground]
    for station, lateral, along, across in grown:
        centre, heading = route.at(station, lateral)
        patches.append(GrassPatch(centre, heading, along, across))
    grass = Grass.grow(tuple(patches), ground, random_stream(seed, "grass"))
    rocks = _place_rocks(ground, route, ramp, grass, random_stream(seed, "rocks"))
    trees = _place_trees(ground, route, ramp, grass, random_stream(seed, "tree places"), random_stream(seed, "foliage"))
    other_ground = _place_patches(route, grass, random_stream(seed, "ground patches"))
    walls = _place_walls(ground, route, ramp, rocks, trees, random_stream(seed, "walls"))
    return Scenery(ground, route, ramp, rocks, trees, grass, kerbs, other_ground, walls)


def _build_yard(settings: TerrainSettings, route: Route, seed: int) -> Scenery:
    """Walls and tall grass at various distances all around the start, where the robot turns on the spot."""
    random = random_stream(seed, "yard")
    ground = build_ground(settings, route, None, random_stream(seed, "ground"))
    walls, patches = [], []
    for sector in range(_YARD_SECTORS):
        bearing = 2.0 * np.pi * (sector + random.uniform(0.2, 0.8)) / _YARD_SECTORS
        direction = np.array([np.cos(bearing), np.sin(bearing)])
        kind = random.choice(["wall", "grass", "nothing"], p=[0.5, 0.3, 0.2])
        if kind == "wall":
            size = np.array([random.uniform(1.2, 3.6), 0.25, random.uniform(0.5, 1.3)])
            facing = bearing + np.pi / 2 + random.uniform(-0.6, 0.6)
            walls.append(standing_wall(ground, random.uniform(1.5, 4.5) * direction, facing, size))
        elif kind == "grass":
            length, width = random.uniform(0.8, 1.6), random.uniform(1.0, 2.2)
            centre = (length + random.uniform(0.8, 3.5)) * direction
            patches.append(GrassPatch(centre, bearing, length, width))
    grass = Grass.grow(tuple(patches), ground, random_stream(seed, "grass"))
    return Scenery(ground, route, None, (), (), grass, walls=tuple(walls))


def standing_wall(ground: HeightField, centre: np.ndarray, heading: float, size: np.ndarray) -> Wall:
    """A wall of ``size`` length, thickness and height [m] that extends below the ground."""
    bottom = float(ground.height_at(centre)) - 0.3
    shape = shapes.box(size + np.array([0.0, 0.0, 0.3]), heading).moved(np.array([*centre, bottom]))
    return Wall(centre, float(heading), size, shape)


def _place_kerbs(route: Route, random: np.random.Generator) -> tuple[Kerb, ...]:
    return tuple(
        Kerb(*route.at(station + random.uniform(-0.5, 0.5)), random.uniform(0.05, 0.085)) for station in _KERB_STATIONS
    )


def _place_patches(route: Route, grass: Grass, random: np.random.Generator) -> tuple[GroundPatch, ...]:
    """Patches that tall grass does not hide: a robot could get stuck in invisible mud, which is unpredictable."""
    patches = []
    for station in _PATCH_STATIONS:
        centre, heading = route.at(station + random.uniform(-0.5, 0.5), random.uniform(-0.3, 0.3))
        area = GrassPatch(centre, heading, random.uniform(1.4, 2.0), random.uniform(1.4, 1.9))
        kind = random.choice(("mud", "gravel"))
        friction = random.uniform(0.25, 0.4) if kind == "mud" else random.uniform(0.55, 0.7)
        patch = GroundPatch(area, float(friction), str(kind))
        x, y = grass.canopy.grid()
        hidden = patch.contains(np.stack([x, y], axis=-1)) & (grass.canopy.heights > _OPAQUE_HEIGHT)
        if not hidden.any():
            patches.append(patch)
    return tuple(patches)


def _place_walls(
    ground: HeightField,
    route: Route,
    ramp: Ramp,
    rocks: tuple[shapes.Shape, ...],
    trees: tuple[Tree, ...],
    random: np.random.Generator,
) -> tuple[Wall, ...]:
    """Walls next to the route, parallel or perpendicular to it, clear of the route and of other objects."""
    walls: list[Wall] = []
    obstacles = np.array([rock.vertices[:, :2].mean(axis=0) for rock in rocks] + [tree.base[:2] for tree in trees])
    for _ in range(400):
        if len(walls) == _WALLS:
            break
        lateral = random.choice([-1.0, 1.0]) * random.uniform(1.9, 3.2)
        centre, heading = route.at(random.uniform(13.0, route.length - 4.0), lateral)
        heading += random.choice([0.0, np.pi / 2]) + random.uniform(-0.2, 0.2)
        size = np.array([random.uniform(1.6, 3.0), 0.25, random.uniform(0.7, 1.3)])
        wall = standing_wall(ground, centre, heading, size)
        blocked = (
            wall.contains(*route.points.T, margin=1.0).any()
            or wall.contains(*obstacles.T, margin=0.9).any()
            or wall.contains(*ramp.centre, margin=2.5)
            or any(np.linalg.norm(other.centre - centre) < 4.0 for other in walls)
        )
        if not blocked:
            walls.append(wall)
    return tuple(walls)


def _place_rocks(
    ground: HeightField, route: Route, ramp: Ramp, grass: Grass, random: np.random.Generator
) -> tuple[shapes.Shape, ...]:
    rocks: list[shapes.Shape] = []
    while len(rocks) < _BOULDERS + _STONES:
        is_boulder = len(rocks) < _BOULDERS
        # Boulders line the route, small stones lie on it.
        width = random.uniform(0.45, 1.15) if is_boulder else random.uniform(0.14, 0.32)
        lateral = random.choice([-1, 1]) * random.uniform(1.5, 5.0) if is_boulder else random.uniform(-1.3, 1.3)
        centre, _ = route.at(random.uniform(0.0, route.length), lateral)
        size = width * np.array([1.0, random.uniform(0.65, 1.0), random.uniform(0.55, 0.85)])
        # Stones on the route must be lower than the robot's ground clearance.
        protrusion = size[2] * 0.62 if is_boulder else min(0.5 * size[2], random.uniform(0.03, 0.085))
        clearance = 1.0 + width / 2 if is_boulder else 0.0
        blocked = (
            route.distance(centre) < clearance
            or np.linalg.norm(centre) < 1.6 + width / 2
            or ramp.height_at(*(centre + np.zeros((1, 2))).T).max() > 0.0
            or grass.height_at(centre) > 0.05
        )
        if blocked:
            continue
        height = float(ground.height_at(centre)) + protrusion - size[2] / 2
        rocks.append(shapes.rock(size, random).moved(np.array([*centre, height])))
    return tuple(rocks)


def _place_trees(
    ground: HeightField,
    route: Route,
    ramp: Ramp,
    grass: Grass,
    random: np.random.Generator,
    foliage: np.random.Generator,
) -> tuple[Tree, ...]:
    trees: list[Tree] = []
    taken = np.empty((0, 2))
    attempts = 0
    while len(trees) < _TREES + _RIM_TREES and attempts < 5000:
        attempts += 1
        reach = ground.half_size - 1.0
        offset = random.uniform(-reach, reach, 2)
        on_rim = len(trees) >= _TREES
        if on_rim != bool(np.abs(offset).max() > reach - 4.0):
            continue
        position = ground.centre + offset
        crowded = len(taken) and np.linalg.norm(taken - position, axis=1).min() < 2.2
        if crowded or route.distance(position) < 2.3 or grass.height_at(position) > 0.0:
            continue
        if np.linalg.norm(position - ramp.centre) < 3.5:
            continue
        taken = np.vstack([taken, position])
        trees.append(_grow_tree(np.array([*position, float(ground.height_at(position))]), foliage))
    return tuple(trees)


def _grow_tree(base: np.ndarray, random: np.random.Generator) -> Tree:
    height = random.uniform(3.6, 6.5)
    radius = height * random.uniform(0.022, 0.032)
    # The stem starts below the ground, so that its end is not visible on a slope.
    sunk = base - np.array([0.0, 0.0, 0.3])
    if random.uniform() < 0.5:
        crown = shapes.conifer_crown(height * random.uniform(0.22, 0.28), 0.86 * height, random)
        stem = shapes.trunk(radius, 0.8 * height).moved(sunk)
        return Tree("conifer", base, radius, stem, crown.moved(base + np.array([0.0, 0.0, 0.14 * height])))
    crown = shapes.broad_crown(height * random.uniform(0.26, 0.36), 0.62 * height, random)
    stem = shapes.trunk(radius, 0.75 * height).moved(sunk)
    return Tree("broad", base, radius, stem, crown.moved(base + np.array([0.0, 0.0, 0.68 * height])))
