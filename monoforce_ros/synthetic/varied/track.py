"""Track: a random closed curve that the driver of a randomised world follows."""

from __future__ import annotations

import math

import numpy as np

from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.varied.settings import RouteSettings

_HARMONICS = 4
_SAMPLES = 720
_KNOTS = 40
_TIGHTEST = 1.3
"""Smallest radius of a turn [m]; skid-steered robots follow it at walking speed."""
_LARGEST_EXTENT = 26.0
"""Largest extent of the track along an axis [m]: a world of 40 m keeps 7 m around it."""
_ATTEMPTS = 300


def draw_route(settings: RouteSettings, random: np.random.Generator) -> Route:
    """A closed curve whose start is anywhere on it, moved to the origin with its heading along x.

    The curve is an ellipse with random higher harmonics (a Fourier series); it may cross itself.

    Raises:
        ValueError: the settings leave no curve that fits the world.
    """
    drawn = settings.draw(random)
    angles = np.arange(_SAMPLES) / _SAMPLES * 2.0 * math.pi
    waviness = drawn.waviness
    for attempt in range(_ATTEMPTS):
        points = np.zeros((_SAMPLES, 2))
        for harmonic in range(1, _HARMONICS + 1):
            size = drawn.radius * (1.0 if harmonic == 1 else waviness * random.uniform(0.2, 1.0) / harmonic)
            for axis in range(2):
                phase = random.uniform(0.0, 2.0 * math.pi)
                if harmonic == 1:
                    # A quarter turn apart, so that the first harmonic is an ellipse and no line.
                    phase = axis * math.pi / 2 + 0.2 * phase / math.pi
                points[:, axis] += size * random.uniform(0.7, 1.15) * np.cos(harmonic * angles + phase)
        if drawn.clockwise:
            points = points[::-1]
        points = np.roll(points, -int(random.integers(_SAMPLES)), axis=0)
        tangent = points[1] - points[-1]
        cosine, sine = tangent / np.linalg.norm(tangent)
        points = (points - points[0]) @ np.array([[cosine, -sine], [sine, cosine]])
        if _smallest_turn(points) > _TIGHTEST and np.ptp(points, axis=0).max() < _LARGEST_EXTENT:
            return Route.through(points[:: _SAMPLES // _KNOTS])
        if attempt % 20 == 19:
            waviness *= 0.85
    raise ValueError(
        f"route: no closed track with turns wider than {_TIGHTEST} m within {_LARGEST_EXTENT} m was found with radius "
        f"{drawn.radius:.1f} m; expected a radius of 3 to 12 m"
    )


def _smallest_turn(points: np.ndarray) -> float:
    """Smallest radius of curvature [m] of a closed curve ``[n, 2]``."""
    ahead, behind = np.roll(points, -4, axis=0), np.roll(points, 4, axis=0)
    first, second = points - behind, ahead - points
    turn = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1) * np.linalg.norm(ahead - behind, axis=1)
    return float((lengths / np.maximum(2.0 * turn, 1e-9)).min())
