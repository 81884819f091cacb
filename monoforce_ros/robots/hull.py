"""Hull: samples of boxes and of wheels' front and rear, fine where ground and obstacles can touch them."""

from __future__ import annotations

import math

import numpy as np

FACE_SPACING = 0.05
"""Largest distance between samples of the sides and the underside [m]: the finest cells of a map in use (0.05 m). An
interpolated post of one cell is two cells wide at its foot, so that samples one cell apart cannot miss it."""
EDGE_SPACING = 0.025
"""Largest distance between samples along the lower edges [m]. Half a cell: a post that reaches only a little above an
edge is narrow there."""
TOP_SPACING = 0.2
"""Largest distance between samples of the top [m], which touches the ground only if the robot lies on its back."""

CLIMBABLE = 1.75
"""Height over a wheel's radius up to which an obstacle meets the tread alone, which may climb it. In MuJoCo, Husky,
Jackal and Warthog (friction 0.8, 1 m/s) climb kerbs of 0.8, 1.3 and 1.5 radii and are stopped by 1.0, 1.4, 1.7."""


def wheel_samples(radius: float, width: float, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample the front and the rear of a wheel about its centre, for what is too high to be climbed.

    A tread is as soft as the ground and has few samples across: a thin post would slip past them or push the wheel
    aside. In a height map an obstacle reaches from the ground up, so that one row across the wheel at the height of
    :data:`CLIMBABLE` feels whatever is higher, and nothing else.

    Args:
        radius, width: of the wheel [m].
        spacing: as in :func:`box_samples`.

    Returns:
        points ``[n, 3]`` [m]; areas ``[n]`` [m²], in all the upper half of the wheel as seen from the front and the
        rear; unit normals, outwards ``[n, 3]``.
    """
    count = max(2, math.ceil(width / (min(1.0, spacing / FACE_SPACING) * EDGE_SPACING) - 1e-9)) + 1
    # From edge to edge: a post may meet the outermost of the wheel.
    across = np.linspace(-width / 2, width / 2, count)
    ends = np.repeat([-1.0, 1.0], count)
    points = np.stack([radius * ends, np.tile(across, 2), np.full(2 * count, (CLIMBABLE - 1.0) * radius)], axis=1)
    normals = np.stack([ends, np.zeros(2 * count), np.zeros(2 * count)], axis=1)
    # The outermost samples stand for half as much as the others.
    share = np.full(count, 1.0 / (count - 1))
    share[[0, -1]] /= 2.0
    return points, radius * width * np.tile(share, 2), normals


def box_samples(size: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sample the surface of a box with edges along the axes and its centre at the origin.

    The areas of each face's samples add up to the face, so that forces do not depend on the spacing.

    Args:
        size: edge lengths ``[3]`` [m].
        spacing: distance between samples [m] if it is below :data:`FACE_SPACING`; larger values do not matter.

    Returns:
        points ``[n, 3]`` [m]; areas ``[n]`` [m²]; unit normals of the faces, outwards ``[n, 3]``; the shorter edge
        of each sample's face ``[n]`` [m].
    """
    factor = min(1.0, spacing / FACE_SPACING)
    face, edge, top = factor * FACE_SPACING, factor * EDGE_SPACING, factor * TOP_SPACING
    parts = [
        _face(size, 2, -1.0, (_middles(size[0], face), _middles(size[1], face))),
        _face(size, 2, 1.0, (_middles(size[0], top), _middles(size[1], top))),
    ]
    # The lowest row lies on the edge and stands for the strip above it.
    strip = min(edge, size[2] / 4)
    above = _middles(size[2] - strip, face)
    rows = (above[0] + strip / 2, above[1])
    lowest = (np.array([-size[2] / 2]), np.array([strip]))
    for axis in (0, 1):
        along = size[1 - axis]
        for side in (-1.0, 1.0):
            parts.append(_face(size, axis, side, (_middles(along, edge), lowest)))
            parts.append(_face(size, axis, side, (_middles(along, face), rows)))
    points, areas, normals = (np.concatenate(values) for values in zip(*parts, strict=True))
    # The face across an axis has the other two edges.
    shorter = np.array([min(np.delete(size, axis)) for axis in range(3)])
    return points, areas, normals, np.abs(normals) @ shorter


def _middles(length: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Middles of equal parts of a length about 0, at least two, and the lengths of the parts [m]."""
    count = max(2, math.ceil(length / spacing - 1e-9))
    return ((np.arange(count) + 0.5) / count - 0.5) * length, np.full(count, length / count)


def _face(
    size: np.ndarray, axis: int, side: float, rows: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of a face across ``axis`` on the products of positions and lengths along the other two axes."""
    first, second = (other for other in range(3) if other != axis)
    places = np.meshgrid(rows[0][0], rows[1][0], indexing="ij")
    points = np.zeros((places[0].size, 3))
    points[:, axis], points[:, first], points[:, second] = side * size[axis] / 2, places[0].ravel(), places[1].ravel()
    normals = np.zeros_like(points)
    normals[:, axis] = side
    return points, np.outer(rows[0][1], rows[1][1]).ravel(), normals
