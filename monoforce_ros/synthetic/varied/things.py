"""Things: rocks, walls, kerbs, fences, posts, logs, trees, boxes, stairs and vehicles of a randomised world."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from monoforce_ros.synthetic import shapes
from monoforce_ros.synthetic.obstacle import Obstacle, Part
from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.scenery import Tree
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.settings import ObstacleSettings

_SINK = 0.25
"""Objects reach this far below the ground, so that no gap shows on a slope [m]."""
_START_FREE = 1.6
_LARGEST_STONE, _LARGEST_KERB = 0.1, 0.11
"""Height of what may lie on the track: wheels of all shipped robots climb it [m]."""
_ATTEMPTS = 6
_ON_TRACK = 3
_ROCK_MATERIALS = 4
POST_RADIUS = 0.04

Maker = Callable[["Builder", np.ndarray, float], Obstacle]


class Builder:
    """Makes objects that stand on a ground, each with a material of its own.

    Attributes:
        materials: kind of material by name, filled by the objects made.
    """

    def __init__(self, ground: HeightField, random: np.random.Generator):
        self.ground = ground
        self.random = random
        self.materials: dict[str, str] = {}

    def material(self, kind: str) -> str:
        """Name of a new material; rocks share a few."""
        made = [name for name, other in self.materials.items() if other == kind == "rock"]
        if len(made) >= _ROCK_MATERIALS:
            return made[int(self.random.integers(len(made)))]
        name = f"surface_{len(self.materials)}"
        self.materials[name] = kind
        return name

    def _standing(self, shape: shapes.Shape, position: np.ndarray, heading: float, lift: float = 0.0) -> shapes.Shape:
        base = float(self.ground.height_at(position)) - _SINK + lift
        return shape.turned(_about_z(heading)).moved(np.array([*position, base]))

    def box(self, kind: str, position: np.ndarray, heading: float, size: np.ndarray, material: str = "") -> Obstacle:
        """A box of ``size`` length, width and height above the ground [m]."""
        shape = self._standing(shapes.box(size + np.array([0.0, 0.0, _SINK]), 0.0), position, heading)
        part = Part(shape, material or self.material(kind))
        return Obstacle(kind, (part,), position, float(np.hypot(*size[:2])) / 2)

    def post(self, position: np.ndarray, height: float, radius: float = POST_RADIUS) -> Obstacle:
        """A post of ``height`` above the ground [m]."""
        shape = self._standing(shapes.cylinder(radius, height + _SINK), position, 0.0)
        return Obstacle("post", (Part(shape, self.material("post")),), position, radius)

    def rock(self, position: np.ndarray, width: float, height: float) -> Obstacle:
        """A rock that protrudes by ``height`` from the ground [m]."""
        random = self.random
        size = np.array([width, width * random.uniform(0.65, 1.0), max(width * random.uniform(0.5, 0.9), 1.4 * height)])
        shape = shapes.rock(size, random)
        lift = float(self.ground.height_at(position)) + height - size[2] / 2
        material = self.material("rock")
        return Obstacle("rock", (Part(shape.moved(np.array([*position, lift])), material),), position, width / 2)

    def boulder(self, position: np.ndarray, heading: float) -> Obstacle:
        """A rock that stops a wheel."""
        width = self.random.uniform(0.3, 1.5)
        return self.rock(position, width, width * self.random.uniform(0.35, 0.75))

    def wall(self, position: np.ndarray, heading: float) -> Obstacle:
        """A free-standing wall."""
        random = self.random
        size = np.array([random.uniform(0.8, 5.0), random.uniform(0.08, 0.5), random.uniform(0.15, 1.6)])
        return self.box("wall", position, heading, size)

    def kerb(self, position: np.ndarray, heading: float) -> Obstacle:
        """A low, long edge."""
        random = self.random
        size = np.array([random.uniform(1.5, 5.0), random.uniform(0.1, 0.5), random.uniform(0.04, 0.2)])
        return self.box("kerb", position, heading, size)

    def crate(self, position: np.ndarray, heading: float) -> Obstacle:
        """A box of any proportions."""
        return self.box("box", position, heading, self.random.uniform(0.2, 1.3, 3))

    def pole(self, position: np.ndarray, heading: float) -> Obstacle:
        """A post of 8 cm or of any other thickness."""
        random = self.random
        radius = POST_RADIUS if random.random() < 0.6 else random.uniform(0.03, 0.15)
        return self.post(position, random.uniform(0.3, 2.2), radius)

    def log(self, position: np.ndarray, heading: float) -> Obstacle:
        """A fallen trunk."""
        random = self.random
        radius, length = random.uniform(0.06, 0.28), random.uniform(0.6, 4.0)
        lying = shapes.cylinder(radius, length).moved(np.array([0.0, 0.0, -length / 2]))
        lying = lying.turned(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
        shape = self._standing(lying, position, heading, _SINK + random.uniform(0.3, 0.9) * radius)
        return Obstacle("log", (Part(shape, self.material("wood")),), position, length / 2)

    def fence(self, position: np.ndarray, heading: float) -> Obstacle:
        """Posts with rails or panels between them."""
        random = self.random
        height, spacing = random.uniform(0.5, 1.4), random.uniform(1.0, 2.2)
        count, material = int(random.integers(2, 5)), self.material("fence")
        along = np.array([math.cos(heading), math.sin(heading)])
        offsets = (np.arange(count) - (count - 1) / 2) * spacing
        radius = random.uniform(0.03, 0.07)
        parts = []
        for offset in offsets:
            post = shapes.cylinder(radius, height + _SINK, sides=8)
            parts.append(Part(self._standing(post, position + offset * along, heading), material))
        has_panels = random.random() < 0.3
        rails = 1 if has_panels else int(random.integers(1, 4))
        for middle in (offsets[:-1] + offsets[1:]) / 2:
            for rail in range(rails):
                share = 0.5 if has_panels else (rail + 1) / rails
                rail_height = 0.8 * height if has_panels else 0.09
                panel = shapes.box(np.array([spacing, 0.04, rail_height]), 0.0)
                lift = _SINK + share * height - rail_height / (2 if has_panels else 1)
                parts.append(Part(self._standing(panel, position + middle * along, heading, lift), material))
        return Obstacle("fence", tuple(parts), position, count * spacing / 2)

    def vehicle(self, position: np.ndarray, heading: float) -> Obstacle:
        """A parked car, van or trailer: body, cabin and wheels."""
        random = self.random
        length, width = random.uniform(2.2, 4.6), random.uniform(1.3, 1.9)
        body, cabin, dark = self.material("vehicle"), self.material("vehicle"), self.material("vehicle")
        floor, side = random.uniform(0.2, 0.4), random.uniform(0.45, 0.9)
        parts = []
        for size, lift, shift, material in (
            ((length, width, side), floor, 0.0, body),
            ((length * random.uniform(0.35, 0.75), 0.92 * width, random.uniform(0.4, 0.8)), floor + side,
             random.uniform(-0.12, 0.12) * length, cabin),
        ):  # fmt: skip
            shape = shapes.box(np.array(size), 0.0).moved(np.array([shift, 0.0, 0.0]))
            parts.append(Part(self._standing(shape, position, heading, _SINK + lift), material))
        radius = random.uniform(0.26, 0.36)
        lying = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        for along in (-0.33, 0.33):
            for across in (-0.5, 0.5):
                wheel = shapes.cylinder(radius, 0.2).moved(np.array([0.0, 0.0, -0.1])).turned(lying)
                shape = wheel.moved(np.array([along * length, across * width, 0.0]))
                parts.append(Part(self._standing(shape, position, heading, _SINK + radius), dark))
        return Obstacle("vehicle", tuple(parts), position, length / 2)

    def stairs(self, position: np.ndarray, heading: float) -> Obstacle:
        """Stairs up to a landing."""
        random = self.random
        count, rise, tread = int(random.integers(2, 6)), random.uniform(0.07, 0.2), random.uniform(0.25, 0.5)
        width, landing = random.uniform(1.0, 3.0), random.uniform(0.6, 1.6)
        material, parts = self.material("kerb"), []
        full = count * tread + landing
        for step in range(count):
            depth = full - step * tread
            block = shapes.box(np.array([depth, width, rise * (step + 1) + _SINK]), 0.0)
            shape = block.moved(np.array([(full - depth) / 2, 0.0, 0.0]))
            parts.append(Part(self._standing(shape, position, heading), material))
        return Obstacle("stairs", tuple(parts), position, full / 2)


def _about_z(heading: float) -> np.ndarray:
    cosine, sine = math.cos(heading), math.sin(heading)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


_MAKERS: tuple[tuple[str, Maker], ...] = (
    ("vehicles", Builder.vehicle), ("stairs", Builder.stairs), ("walls", Builder.wall), ("fences", Builder.fence),
    ("kerbs", Builder.kerb), ("logs", Builder.log), ("boulders", Builder.boulder), ("boxes", Builder.crate),
    ("posts", Builder.pole),
)  # fmt: skip


def place_things(
    settings: ObstacleSettings, stairs: int, route: Route, builder: Builder, hidden_places: np.ndarray
) -> tuple[Obstacle, ...]:
    """Place obstacles anywhere; most keep clear of the track, and some may stand on it.

    Args:
        settings: numbers of each kind.
        stairs: number of stairs.
        route: the track.
        builder: makes the objects.
        hidden_places: ``[n, 2]`` positions inside vegetation for rocks [m].
    """
    random, ground = builder.random, builder.ground
    drawn = settings.draw(random)
    drawn.stairs = stairs
    blocking = _ON_TRACK if drawn.on_track else 0
    placed: list[Obstacle] = []
    for name, make in _MAKERS:
        for _ in range(getattr(drawn, name)):
            for _ in range(_ATTEMPTS):
                # Half of the things stand within view of the track, the others anywhere.
                if random.random() < 0.6:
                    side = float(random.choice([-1.0, 1.0])) * random.uniform(0.5, 6.0)
                    position, _ = route.at(random.uniform(0.0, route.length), side)
                else:
                    position = ground.centre + random.uniform(-0.85, 0.85, 2) * ground.half_size
                thing = make(builder, position, random.uniform(-math.pi, math.pi))
                distance = _distance_to(thing, route)
                on_track = distance < drawn.clearance
                crowded = any(
                    np.linalg.norm(other.position - position) < 0.6 * (other.radius + thing.radius) for other in placed
                )
                if crowded or np.linalg.norm(position) < _START_FREE + thing.radius or (on_track and not blocking):
                    continue
                blocking -= on_track
                placed.append(thing)
                break
    for _ in range(drawn.stones):
        # Stones lie anywhere, also on the track.
        position, _ = route.at(random.uniform(0.0, route.length), random.normal(0.0, 2.5))
        width = random.uniform(0.1, 0.4)
        if np.linalg.norm(position) > _START_FREE:
            height = min(random.uniform(0.3, 0.6) * width, random.uniform(0.02, _LARGEST_STONE))
            placed.append(builder.rock(position, width, height))
    for position in hidden_places:
        is_free = route.distance(position) > drawn.clearance
        width = random.uniform(0.2, 0.7)
        height = 0.5 * width if is_free else min(0.4 * width, _LARGEST_STONE)
        placed.append(builder.rock(position, width, height))
    return tuple(placed)


def plant_trees(
    count: int, route: Route, ground: HeightField, things: tuple[Obstacle, ...], random: np.random.Generator
) -> tuple[Tree, ...]:
    """Trees that keep clear of the track and of other things."""
    trees: list[Tree] = []
    taken = [(thing.position, thing.radius) for thing in things if thing.radius > 0.5]
    for _ in range(8 * count):
        if len(trees) == count:
            break
        position = ground.centre + random.uniform(-1.0, 1.0, 2) * (ground.half_size - 0.8)
        if route.distance(position) < random.uniform(1.0, 3.0) or np.linalg.norm(position) < 2.5:
            continue
        if any(np.linalg.norm(other - position) < radius + 0.8 for other, radius in taken):
            continue
        taken.append((position, 0.8))
        trees.append(_grow(np.array([*position, float(ground.height_at(position))]), random))
    return tuple(trees)


def _grow(base: np.ndarray, random: np.random.Generator) -> Tree:
    height = random.uniform(1.8, 7.0)
    radius = height * random.uniform(0.018, 0.045)
    sunk = base - np.array([0.0, 0.0, _SINK])
    kind = str(random.choice(["broad", "conifer", "bare"], p=[0.4, 0.35, 0.25]))
    stem = shapes.trunk(radius, 0.8 * height).moved(sunk)
    if kind == "conifer":
        crown = shapes.conifer_crown(height * random.uniform(0.14, 0.3), random.uniform(0.7, 0.92) * height, random)
        return Tree(kind, base, radius, stem, crown.moved(base + np.array([0.0, 0.0, 0.1 * height])))
    if kind == "broad":
        crown = shapes.broad_crown(height * random.uniform(0.2, 0.4), random.uniform(0.4, 0.65) * height, random)
        return Tree(kind, base, radius, stem, crown.moved(base + np.array([0.0, 0.0, 0.68 * height])))
    # A dead trunk.
    return Tree("broad", base, radius, stem, shapes.EMPTY)


def _distance_to(thing: Obstacle, route: Route) -> float:
    """Distance of a thing's outline from the track [m]."""
    corners = np.concatenate([part.shape.vertices[:, :2] for part in thing.parts if part.is_solid])
    middle = corners.mean(axis=0)
    # Between the outline and its middle, so that a wall across the track is noticed.
    samples = np.concatenate([middle + share * (corners - middle) for share in (0.25, 0.5, 0.75, 1.0)])
    return float(route.distance(samples).min())
