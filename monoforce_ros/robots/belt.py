"""Belts: outlines of wheels and tracks. A wheel is a belt around one circle, a track a belt around two."""

from __future__ import annotations

import math

import numpy as np

_FEWEST = 6
"""Samples on half a wheel: it rolls on a polygon, and one of 12 corners is 3 % lower than the wheel."""


def belt_outline(
    length: float, rear_radius: float, front_radius: float, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sample the tight belt around two circles in its own plane (x forward, z up, origin half-way between them).

    Args:
        length: distance between the circles' centres [m]; 0 gives a wheel of ``front_radius``.
        rear_radius: radius of the circle at x = -length / 2 [m].
        front_radius: radius of the circle at x = +length / 2 [m].
        spacing: the largest distance between neighbouring samples [m].

    Returns:
        positions ``[n, 2]`` (x, z) [m]; unit tangents ``[n, 2]`` in the direction in which the surface moves relative
        to the body when the drive runs forward (backwards at the bottom); arc length of each sample ``[n]`` [m];
        curvature there ``[n]`` [1/m], 0 on the straight parts.
    """
    # Angle of the straight parts, which are tangents of both circles, to the line between the centres.
    tilt = 0.0 if length == 0.0 else math.asin(np.clip((rear_radius - front_radius) / length, -1.0, 1.0))
    front, rear = np.array([length / 2, 0.0]), np.array([-length / 2, 0.0])
    fewest = 2 if length > 0.0 else _FEWEST
    pieces = [_arc(front, front_radius, -math.pi / 2 + tilt, math.pi / 2 - tilt, spacing, fewest)]
    if length > 0.0:
        upper = np.array([math.sin(tilt), math.cos(tilt)])
        lower = np.array([math.sin(tilt), -math.cos(tilt)])
        pieces.append(_line(front + front_radius * upper, rear + rear_radius * upper, spacing))
        pieces.append(_arc(rear, rear_radius, math.pi / 2 - tilt, 3 * math.pi / 2 + tilt, spacing))
        pieces.append(_line(rear + rear_radius * lower, front + front_radius * lower, spacing))
    else:
        pieces.append(_arc(rear, front_radius, math.pi / 2, 3 * math.pi / 2, spacing, fewest))
    positions, directions, lengths = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    radii = [front_radius, np.inf, rear_radius, np.inf] if length > 0.0 else [front_radius, front_radius]
    curvatures = [np.full(len(piece[0]), 1.0 / radius) for piece, radius in zip(pieces, radii, strict=True)]
    # The outline runs forwards along the bottom; the belt of a robot that drives forward moves the other way.
    return positions, -directions, lengths, np.concatenate(curvatures)


def _arc(
    centre: np.ndarray, radius: float, start: float, end: float, spacing: float, fewest: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # With an even count, samples are symmetric about the lowest point and never at the junction of two pieces.
    count = max(fewest, 2 * math.ceil(radius * (end - start) / spacing / 2))
    angles = start + (np.arange(count) + 0.5) * (end - start) / count
    radial = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tangent = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    return centre + radius * radial, tangent, np.full(count, radius * (end - start) / count)


def _line(start: np.ndarray, end: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    distance = float(np.linalg.norm(end - start))
    count = max(2, math.ceil(distance / spacing))
    fractions = ((np.arange(count) + 0.5) / count)[:, None]
    direction = np.repeat(((end - start) / distance)[None], count, axis=0)
    return start + fractions * (end - start), direction, np.full(count, distance / count)
