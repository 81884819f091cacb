"""ProgressCheck: whether a robot that is commanded to move does move."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.special import stdtrit

WINDOW = 2.0
"""Time over which commanded and measured motion are compared [s]: bases start within a second."""
_ERROR_RATE = 1e-3
"""Probability, per estimate, that the noise of a standing robot's odometry passes for motion.

It holds for white noise: with 0 to 5 cm per axis (and half as many rad of heading), at 10 to 50 Hz and 0.2 to 1 m/s, a
stuck robot was said to drive at most 0.08 % of the time. With noise correlated over 0.2 to 2 s it was up to 1.7 %."""
_SHARE = 0.1
"""Smallest share of the commanded motion that counts as moving: below it, a robot stands or spins its wheels."""
_MISSED = 0.5
"""A robot is said to stand only if the estimate excludes this share of the commanded motion."""
_SMALLEST = 0.1
"""Smallest commanded motion that is judged [m, rad]."""
_COMPARABLE = 0.5
"""Share of the larger of the two commanded motions [m, rad] from which the smaller one alone may show motion."""
_OPPOSED = 0.5
"""Smallest share of the commanded motion, in the other direction, from which on a robot moves against its commands: one
that slides back while its wheels grip, or whose sensors drift, shows less; wrong signs show about 1."""
_OPPOSED_TURN = 0.5
"""Smallest commanded turn within the window [rad] that is judged so: the heading of a robot that pulls to one side
drifts against slighter ones."""
_FEWEST = 6
"""Fewest poses that show motion: with fewer, their noise is unknown."""


class ProgressCheck:
    """Compares commanded with measured motion over the last :data:`WINDOW` seconds.

    The share ``k`` of the commanded motion that the robot carries out is the slope of a regression of measured on
    commanded positions (along the measured heading), or of measured on commanded headings. The scatter around the
    regression gives the standard error of ``k``, so that odometry with more noise has to show more motion.
    """

    def __init__(self) -> None:
        # Time [s], speed [m/s], yaw rate [rad/s], x [m], y [m], heading [rad].
        self._samples: deque[tuple[float, float, float, float, float, float]] = deque()

    def clear(self) -> None:
        """Forget everything: the robot is not commanded to move."""
        self._samples.clear()

    def add(self, time: float, command: tuple[float, float], position: np.ndarray, heading: float) -> None:
        """Note a measured pose and the command in effect.

        Args:
            time: time of the pose [s]; a pose of the same time is ignored, after a backward jump it starts anew.
            command: forward speed [m/s] and yaw rate [rad/s].
            position: ``[2]`` [m].
            heading: [rad].
        """
        if self._samples and time <= self._samples[-1][0]:
            if time == self._samples[-1][0]:
                return
            self._samples.clear()
        self._samples.append((time, *command, float(position[0]), float(position[1]), heading))
        while time - self._samples[0][0] > WINDOW:
            self._samples.popleft()

    @property
    def moving(self) -> bool | None:
        """Whether the robot moves as commanded; None while the odometry shows neither."""
        if len(self._samples) < _FEWEST:
            return None
        along, position, turned, heading, _, full = self._motion()
        driving, turning = _moved(along, position, full=full), _moved(turned, heading, full=full)
        # Of the two, the larger one is what the robot is commanded to do. The other counts only if it is hardly less: a
        # tenth of a slight turn is the drift of a heading.
        lengths = _length(along), _length(turned)
        (larger, main), (smaller, other) = sorted(zip(lengths, (driving, turning), strict=True), key=_by_length)[::-1]
        return True if other and smaller > _COMPARABLE * larger else main

    @property
    def opposed(self) -> str:
        """The motion that goes against its commands, ``speed`` or ``yaw rate``; empty if the odometry shows none.

        Only commands that kept their sign over the whole window are judged: after a change of direction every robot
        moves against its commands for a while.
        """
        if len(self._samples) < _FEWEST:
            return ""
        along, position, turned, heading, one_way, full = self._motion()
        for name, steps, measured, smallest, kept in (
            ("speed", along, position, _SMALLEST, one_way[0]),
            ("yaw rate", turned, heading, _OPPOSED_TURN, one_way[1]),
        ):
            if full and kept and _length(steps) > smallest and (found := _share(steps, measured)) is not None:
                share, margin = found
                if share + margin < -_OPPOSED:
                    return name
        return ""

    def _motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[bool, bool], bool]:
        """Commanded steps and measured positions, the same of the heading, whether each command kept its sign (at most
        zero in between), and whether the window is full.
        """
        time, speed, yaw_rate, x, y, heading = np.array(self._samples).T
        heading = np.unwrap(heading)
        step = np.diff(time)
        along = (speed[:-1] * step) * np.array([np.cos(heading[:-1]), np.sin(heading[:-1])])
        one_way = bool((speed >= 0).all() or (speed <= 0).all()), bool((yaw_rate >= 0).all() or (yaw_rate <= 0).all())
        full = bool(time[-1] - time[0] > 0.8 * WINDOW)
        return along, np.array([x, y]), (yaw_rate[:-1] * step)[None], heading[None], one_way, full


def _by_length(entry: tuple[float, bool | None]) -> float:
    return entry[0]


def _length(steps: np.ndarray) -> float:
    return float(np.linalg.norm(steps, axis=0).sum())


def _moved(steps: np.ndarray, measured: np.ndarray, *, full: bool) -> bool | None:
    """Whether measured positions ``[d, n]`` follow commanded steps ``[d, n - 1]``; None if that is uncertain."""
    if (found := _share(steps, measured)) is None:
        return None
    share, margin = found
    if share > margin and share + margin > _SHARE:
        return True
    return False if full and _length(steps) > _SMALLEST and share + margin < _MISSED else None


def _share(steps: np.ndarray, measured: np.ndarray) -> tuple[float, float] | None:
    """The share of commanded steps ``[d, n - 1]`` that positions ``[d, n]`` show, and its margin at the rate
    :data:`_ERROR_RATE`; None without commanded steps.
    """
    dimensions, count = measured.shape
    commanded = np.concatenate([np.zeros((dimensions, 1)), np.cumsum(steps, axis=1)], axis=1)
    commanded -= commanded.mean(axis=1, keepdims=True)
    measured = measured - measured.mean(axis=1, keepdims=True)
    power = float((commanded**2).sum())
    if power < 1e-12:
        return None
    share = float((commanded * measured).sum()) / power
    scatter = measured - share * commanded
    # Errors that last for several samples count as fewer samples (as in an AR(1) process). The correlation of residuals
    # is too small by about two samples' worth.
    spread = float((scatter**2).sum())
    lag = float((scatter[:, 1:] * scatter[:, :-1]).sum()) / max(spread, 1e-18) + 2.0 / count
    repeats = (1.0 + lag) / (1.0 - lag) if (lag := min(max(lag, 0.0), 0.95)) else 1.0
    freedom = max(dimensions * (count / repeats - 1.0) - 1.0, 1.0)
    error = np.sqrt(spread * repeats / (dimensions * (count - 1.0) - 1.0) / power)
    return share, float(stdtrit(freedom, 1.0 - _ERROR_RATE) * error)
