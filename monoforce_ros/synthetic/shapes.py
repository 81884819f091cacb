"""Shapes: triangle meshes of rocks, trunks, crowns and blades of grass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, Delaunay

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Shape:
    """A triangle mesh with its shading.

    Attributes:
        vertices: ``[n, 3]`` [m].
        faces: ``[m, 3]`` vertex indices, counter-clockwise from outside.
        normals: ``[n, 3]`` unit normals for shading, which need not be those of the faces.
        texture_coordinates: ``[n, 2]`` in 0..1.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    texture_coordinates: np.ndarray

    def turned(self, rotation: np.ndarray) -> Shape:
        """The same shape, turned about the origin by a matrix ``[3, 3]``."""
        return Shape(self.vertices @ rotation.T, self.faces, self.normals @ rotation.T, self.texture_coordinates)

    def moved(self, offset: np.ndarray) -> Shape:
        """The same shape, shifted by ``offset`` ``[3]`` [m]."""
        return Shape(self.vertices + offset, self.faces, self.normals, self.texture_coordinates)


EMPTY = Shape(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros((0, 2)))


def merge(shapes: list[Shape]) -> Shape:
    """Merge meshes: one large mesh renders faster than thousands of small ones."""
    starts = np.cumsum([0] + [len(shape.vertices) for shape in shapes[:-1]])
    return Shape(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate([shape.faces + start for shape, start in zip(shapes, starts, strict=True)]),
        np.concatenate([shape.normals for shape in shapes]),
        np.concatenate([shape.texture_coordinates for shape in shapes]),
    )


def rock(size: np.ndarray, random: np.random.Generator) -> Shape:
    """An angular boulder: the convex hull of a dented and stretched sphere.

    Args:
        size: ``[3]`` approximate edge lengths of its bounding box [m].
        random: generator of its shape.
    """
    directions = _even_directions(70)
    # A few flat cuts give the facets of broken stone; noise makes them irregular.
    cuts = _random_directions(7, random)
    depths = random.uniform(0.62, 0.95, len(cuts))
    reach = np.max(np.maximum(directions @ cuts.T, 1e-3) / depths, axis=1)
    points = directions / np.maximum(reach, 1.0)[:, None] * random.uniform(0.94, 1.0, (len(directions), 1))
    points *= size / np.ptp(points, axis=0)
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    face_normals = hull.equations[:, :3]
    winding = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners[(winding * face_normals).sum(axis=1) < 0] = corners[(winding * face_normals).sum(axis=1) < 0][:, ::-1]
    vertex_normals = np.repeat(face_normals, 3, axis=0)
    rounded = corners.reshape(-1, 3) / np.linalg.norm(corners.reshape(-1, 3), axis=1, keepdims=True)
    normals = _unit(0.75 * vertex_normals + 0.25 * rounded)
    vertices = corners.reshape(-1, 3)
    # The texture repeats every metre, projected along the main axis of each facet.
    axis = np.argmax(np.abs(face_normals), axis=1).repeat(3)
    planes = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    coordinates = np.take_along_axis(vertices, planes, axis=1) + random.uniform(0, 1, 2)
    return Shape(vertices, np.arange(len(vertices)).reshape(-1, 3), normals, coordinates)


def box(size: np.ndarray, heading: float) -> Shape:
    """A box standing at the origin, its length along ``heading``; the texture repeats every metre.

    Args:
        size: length, width and height ``[3]`` [m].
        heading: yaw [rad].
    """
    corners: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[list[int]] = []
    coordinates: list[list[float]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = side * np.eye(3)[axis]
            first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            # Corners counter-clockwise seen from outside.
            signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)][:: int(side)]
            start = 4 * len(faces) // 2
            for u, w in signs:
                corner = 0.5 * (normal + u * first + w * second) * size
                corners.append(corner + np.array([0.0, 0.0, size[2] / 2]))
                normals.append(normal)
                # Upright on the sides: the vertical is the texture's second axis.
                across = corner[1] if axis == 0 else corner[0]
                coordinates.append([across, corner[1] if axis == 2 else corner[2]])
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    cosine, sine = math.cos(heading), math.sin(heading)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Shape(np.array(corners) @ turn.T, np.array(faces), np.array(normals) @ turn.T, np.array(coordinates))


def trunk(radius: float, height: float) -> Shape:
    """A tapered stem standing at the origin, closed at both ends (convex)."""
    return _prism(radius, 0.6, height, 10)


def _prism(radius: float, taper: float, height: float, sides: int) -> Shape:
    angles = np.arange(sides + 1) / sides * 2 * math.pi
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides + 1)], axis=1)
    bottom, top = rim * radius * [1, 1, 0], rim * radius * taper + height * _UP
    vertices = np.concatenate([bottom, top, [[0, 0, 0]], [height * _UP]])
    normals = np.concatenate([rim, rim, [-_UP], [_UP]])
    around = np.arange(sides + 1) / sides
    coordinates = np.concatenate(
        [
            np.stack([around, np.zeros(sides + 1)], axis=1),
            np.stack([around, np.full(sides + 1, height)], axis=1),
            [[0.5, 0.0], [0.5, height]],
        ]
    )
    low = np.arange(sides)
    high = low + sides + 1
    centres = np.full(sides, 2 * sides + 2)
    faces = np.concatenate(
        [
            np.stack([low, low + 1, high + 1], axis=1),
            np.stack([low, high + 1, high], axis=1),
            np.stack([low + 1, low, centres], axis=1),
            np.stack([high, high + 1, centres + 1], axis=1),
        ]
    )
    return Shape(vertices, faces, normals, coordinates)


def broad_crown(radius: float, height: float, random: np.random.Generator) -> Shape:
    """Foliage in clumps around the origin: single leaves with the shading of their clump."""
    clumps = []
    size = np.array([radius, radius, height / 2])
    for direction in _random_directions(9, random):
        centre = direction * size * random.uniform(0.35, 0.62)
        clumps.append(_clump(centre, size * random.uniform(0.42, 0.58), 125, 0.125 * radius, random))
    return merge([*clumps, _clump(np.zeros(3), 0.62 * size, 110, 0.2 * radius, random)])


def conifer_crown(radius: float, height: float, random: np.random.Generator) -> Shape:
    """Foliage in a cone with its base at the origin: twigs that hang outwards and down."""
    count = 850
    # The lateral area of a cone grows with the distance from its tip.
    level = 1.0 - np.sqrt(random.uniform(0.0, 1.0, count))
    angle = random.uniform(0.0, 2 * math.pi, count)
    tier = 0.82 + 0.18 * (1.0 - (level * 7.0) % 1.0)
    reach = radius * (1.0 - level) * tier * random.uniform(0.65, 1.0, count) + 0.03
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    centres = outward * reach[:, None] + (level * height)[:, None] * _UP
    hanging = _unit(outward - random.uniform(0.3, 0.9, (count, 1)) * _UP)
    sideways = np.cross(outward, _UP) + 0.35 * random.standard_normal((count, 3))
    normals = _unit(outward + 0.55 * _UP + 0.25 * random.standard_normal((count, 3)))
    length = radius * random.uniform(0.18, 0.30, (count, 1)) * (1.15 - level[:, None])
    brightness = np.clip(0.25 + 0.6 * reach / radius / np.maximum(1.0 - level, 0.2) - 0.2 * (1 - tier) / 0.18, 0, 1)
    return _leaves(centres, hanging * length * 1.5, _unit(sideways) * length * 0.7, normals, brightness, random)


def blades(
    roots: np.ndarray, heights: np.ndarray, width: float, lean: np.ndarray, random: np.random.Generator
) -> Shape:
    """Blades of grass, each a bent, pointed strip of three triangles.

    Args:
        roots: ``[n, 3]`` positions on the ground [m].
        heights: ``[n]`` height of the tips above the roots [m].
        width: width at the root [m].
        lean: ``[n, 2]`` horizontal offset of the tip per height [-].
        random: generator of directions and colours.
    """
    count = len(roots)
    turn = random.uniform(0.0, math.pi, count)
    across = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    across *= (width / 2 * random.uniform(0.7, 1.3, count))[:, None]
    bend = np.concatenate([lean, np.zeros((count, 1))], axis=1) * heights[:, None]
    middle = roots + 0.3 * bend + (0.55 * heights)[:, None] * _UP
    tip = roots + bend + heights[:, None] * _UP
    vertices = np.stack([roots - across, roots + across, middle - 0.75 * across, middle + 0.75 * across, tip], axis=1)
    # Shaded as a meadow instead of single strips: normals lean with the blade but mostly point up.
    normal = _unit(_UP + 0.55 * _unit(random.standard_normal((count, 3))) + 0.8 * bend)
    tone = np.clip(random.normal(0.5, 0.2, count), 0.01, 0.99)
    levels = np.array([0.04, 0.04, 0.55, 0.55, 0.97])
    coordinates = np.stack([np.repeat(tone[:, None], 5, axis=1), np.tile(levels, (count, 1))], axis=-1)
    strip = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 4]])
    faces = (strip[None] + 5 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return Shape(vertices.reshape(-1, 3), faces, np.repeat(normal, 5, axis=0), coordinates.reshape(-1, 2))


def twigs(roots: np.ndarray, heights: np.ndarray, leaf: float, lean: np.ndarray, random: np.random.Generator) -> Shape:
    """Leaves at any height above roots ``[n, 3]``; arguments as for :func:`blades`, ``leaf`` is their length [m]."""
    count = len(roots)
    level = random.uniform(0.1, 1.0, count)
    bend = np.concatenate([lean * (level * heights)[:, None], (level * heights)[:, None]], axis=1)
    directions = _unit(random.standard_normal((count, 3)) + 0.5 * _UP)
    second = _unit(np.cross(directions, random.standard_normal((count, 3))))
    normals = _unit(_UP + 0.6 * random.standard_normal((count, 3)))
    sizes = leaf * random.uniform(0.6, 1.3, (count, 1))
    return _leaves(roots + bend, directions * sizes, 0.5 * second * sizes, normals, 0.15 + 0.75 * level, random)


def bush(radius: float, height: float, leaves: int, random: np.random.Generator) -> Shape:
    """Leaves in a dome that stands at the origin."""
    directions = _random_directions(leaves, random)
    directions[:, 2] = np.abs(directions[:, 2])
    bumpy = 1.0 + 0.2 * np.sin(directions @ random.uniform(2.0, 6.0, 3) + random.uniform(0.0, 6.3))
    centres = directions * np.array([radius, radius, height]) * (bumpy * random.uniform(0.55, 1.0, leaves))[:, None]
    first = np.cross(directions, random.standard_normal((leaves, 3)))
    second = np.cross(directions, first) + 0.4 * random.standard_normal((leaves, 3))
    sizes = 1.6 * math.sqrt(radius * height / leaves) * random.uniform(0.6, 1.3, (leaves, 1))
    normals = _unit(directions + 0.4 * random.standard_normal((leaves, 3)))
    brightness = np.clip(0.35 + 0.4 * directions[:, 2] + random.normal(0.0, 0.15, leaves), 0.0, 1.0)
    return _leaves(centres, _unit(first) * sizes, 0.6 * _unit(second) * sizes, normals, brightness, random)


def cylinder(radius: float, length: float, *, sides: int = 12) -> Shape:
    """A closed cylinder that stands at the origin; the texture wraps around it once and repeats every metre."""
    return _prism(radius, 1.0, length, sides)


def upper_surface(vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Height [m] of a convex body's upper side at horizontal positions ``[n, 2]``; NaN outside the body."""
    hull = ConvexHull(vertices)
    upper = hull.equations[hull.equations[:, 2] > 1e-6]
    planes = -(positions @ upper[:, :2].T + upper[:, 3]) / upper[:, 2]
    outline = Delaunay(vertices[ConvexHull(vertices[:, :2]).vertices, :2])
    return np.where(outline.find_simplex(positions) >= 0, planes.min(axis=1), np.nan)


def _clump(centre: np.ndarray, size: np.ndarray, count: int, leaf: float, random: np.random.Generator) -> Shape:
    directions = _random_directions(count, random)
    centres = centre + directions * size * random.uniform(0.75, 1.0, (count, 1))
    first = np.cross(directions, random.standard_normal((count, 3)))
    second = np.cross(directions, first) + 0.4 * random.standard_normal((count, 3))
    sizes = leaf * random.uniform(0.6, 1.3, (count, 1))
    normals = _unit(directions + 0.35 * random.standard_normal((count, 3)))
    brightness = np.clip(0.5 + 0.35 * directions[:, 2] + random.normal(0.0, 0.12, count), 0.0, 1.0)
    return _leaves(centres, _unit(first) * sizes, _unit(second) * sizes, normals, brightness, random)


def _leaves(
    centres: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    normals: np.ndarray,
    brightness: np.ndarray,
    random: np.random.Generator,
) -> Shape:
    """Rhombic leaves ``[n, 3]`` spanned by two half-diagonals, with a colour from dark to bright in 0..1 ``[n]``."""
    count = len(centres)
    vertices = np.stack([centres + first, centres + second, centres - first, centres - second], axis=1)
    tone = np.clip(random.normal(0.5, 0.2, count), 0.01, 0.99)
    coordinates = np.repeat(np.stack([tone, 0.05 + 0.9 * brightness], axis=1), 4, axis=0)
    faces = (np.array([[0, 1, 2], [0, 2, 3]])[None] + 4 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return Shape(vertices.reshape(-1, 3), faces, np.repeat(normals, 4, axis=0), coordinates)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _random_directions(count: int, random: np.random.Generator) -> np.ndarray:
    return _unit(random.standard_normal((count, 3)))


def _even_directions(count: int) -> np.ndarray:
    """Directions ``[n, 3]`` spread evenly on the sphere (Fibonacci lattice)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
