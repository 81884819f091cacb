"""Route: the closed path that the simulated driver follows; the world is laid out around it."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

_SPACING = 0.05

# World coordinates [m]. The first points put the start at the origin, heading along x; the next ones leave room for
# the ramp in the left half of the first camera image.
_CONTROL_POINTS = np.array(
    [
        [0.0, 0.0], [3.0, 0.0], [5.8, 0.3], [8.0, 1.8], [9.0, 4.2], [9.0, 7.2], [7.2, 10.4], [3.5, 12.2],
        [-0.8, 12.0], [-4.2, 10.0], [-6.2, 6.6], [-5.8, 2.6], [-3.2, 0.3],
    ]
)  # fmt: skip
_FIXED_POINTS = 4


class Route:
    """A smooth closed curve in world coordinates, sampled evenly.

    Attributes:
        points: ``[n, 2]`` positions [m], first one at the origin.
        headings: ``[n]`` direction of travel [rad].
        length: length of one lap [m].
    """

    def __init__(self, random: np.random.Generator):
        control = _CONTROL_POINTS.copy()
        control[_FIXED_POINTS:] += random.uniform(-0.5, 0.5, control[_FIXED_POINTS:].shape)
        # The last point before the start is fixed, since it sets the heading at the start.
        control[-1] = _CONTROL_POINTS[-1] * [1.0, 0.0]
        self._pass_through(control)

    @classmethod
    def through(cls, control: np.ndarray) -> Route:
        """A route through control points ``[n, 2]`` [m], from the first one on and back to it."""
        route = cls.__new__(cls)
        route._pass_through(control)
        return route

    def _pass_through(self, control: np.ndarray) -> None:
        knots = np.vstack([control, control[:1]])
        chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
        spline = CubicSpline(chords, knots, bc_type="periodic")
        dense = spline(np.linspace(0.0, chords[-1], 20_000))
        stations = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
        self.length = float(stations[-1])
        even = np.linspace(0.0, self.length, round(self.length / _SPACING), endpoint=False)
        self.points = np.stack([np.interp(even, stations, dense[:, axis]) for axis in range(2)], axis=1)
        steps = np.roll(self.points, -1, axis=0) - np.roll(self.points, 1, axis=0)
        self.headings = np.arctan2(steps[:, 1], steps[:, 0])
        self._tree = cKDTree(self.points)

    def at(self, station: float, lateral: float = 0.0) -> tuple[np.ndarray, float]:
        """Position ``[2]`` [m] and heading [rad] at a distance along the route, ``lateral`` metres to its left."""
        index = round(station / _SPACING) % len(self.points)
        heading = float(self.headings[index])
        return self.points[index] + lateral * np.array([-np.sin(heading), np.cos(heading)]), heading

    def distance(self, positions: np.ndarray) -> np.ndarray:
        """Distance of positions ``[..., 2]`` to the route [m]."""
        return self._tree.query(positions, workers=-1)[0]

    def advance(self, station: float, position: np.ndarray, window: float = 2.0) -> float:
        """Station [m] of the point closest to ``position``, between ``station`` and ``window`` metres further."""
        first = round(station / _SPACING)
        indices = (first + np.arange(round(window / _SPACING))) % len(self.points)
        offsets = self.points[indices] - position
        return (first + int(np.argmin((offsets**2).sum(axis=1)))) * _SPACING
