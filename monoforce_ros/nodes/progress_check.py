"""ProgressCheck: whether a robot that is commanded to move does move."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

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
_LAGS = (0.0, 0.3, 0.6, 0.9, 1.2, 1.5)
"""Lags of a base [s] with any of which its motion may follow commands that change their sign."""
_OPPOSED_TURN = 0.5
"""Smallest commanded turn within the window [rad] that is judged so: the heading of a robot that pulls to one side
drifts against slighter ones."""
_CERTAIN = 6.0
"""Smallest ratio of a mean velocity and its standard error at which it counts as motion, with noise that is correlated
over several poses."""
PATIENCE = 6.0
"""Time without motion as commanded [s] after which a goal is dropped: three windows. Bases that start slowly have moved
by then; what stands for longer is stuck, switched off or lost, and must not drive on by itself once it is free."""
_INTERVAL = 0.1
"""Time between the poses at which it is judged whether commands are followed [s]: odometry may come at 200 Hz."""
_FEWEST = 6
"""Fewest poses that show motion: with fewer, their noise is unknown."""


@dataclass(frozen=True)
class MeasuredVelocity:
    """Mean velocity over the window, in the robot's axes at its middle."""

    forward: float
    """[m/s]."""
    left: float
    """[m/s]."""
    yaw_rate: float
    """[rad/s]."""


class ProgressCheck:
    """Compares commanded with measured motion over the last :data:`WINDOW` seconds.

    The share ``k`` of the commanded motion that the robot carries out is the slope of a regression of measured on
    commanded positions (along the measured heading and, of robots that move sideways, across it), or of measured on
    commanded headings. The scatter around the regression gives the standard error of ``k``, so that odometry with more
    noise has to show more motion.
    """

    def __init__(self) -> None:
        # Time [s], speed [m/s], yaw rate [rad/s], speed to the left [m/s], x [m], y [m], heading [rad].
        self._samples: deque[tuple[float, ...]] = deque()
        # Earlier commands: time [s], speed [m/s], yaw rate [rad/s], speed to the left [m/s].
        self._earlier: deque[tuple[float, ...]] = deque()
        self._followed = self._next = 0.0

    def clear(self) -> None:
        """Forget everything: the robot is not commanded to move."""
        self._samples.clear()
        self._earlier.clear()

    def add(self, time: float, command: Sequence[float], position: np.ndarray, heading: float) -> None:
        """Note a measured pose and the command in effect.

        Args:
            time: time of the pose [s]; a pose of the same time is ignored, after a backward jump it starts anew.
            command: forward speed [m/s], yaw rate [rad/s] and, of robots that move sideways, speed to the left [m/s].
            position: ``[2]`` [m].
            heading: [rad].
        """
        if self._samples and time <= self._samples[-1][0]:
            if time == self._samples[-1][0]:
                return
            self.clear()
        if not self._samples:
            self._followed = self._next = time
        speed, yaw_rate, left = (*command, 0.0)[:3]
        self._samples.append((time, speed, yaw_rate, left, float(position[0]), float(position[1]), heading))
        while time - self._samples[0][0] > WINDOW:
            self._earlier.append(self._samples.popleft()[:4])
        while self._earlier and time - self._earlier[0][0] > WINDOW + _LAGS[-1]:
            self._earlier.popleft()
        if time < self._next:
            return
        self._next = time + _INTERVAL
        if self.moving or self._little_commanded:
            self._followed = time

    @property
    def moving(self) -> bool | None:
        """Whether the robot moves as commanded; None while the odometry shows neither."""
        if len(self._samples) < _FEWEST:
            return None
        time, position, heading = self._measured()
        along, turned = self._commanded(time, heading)
        full = bool(time[-1] - time[0] > 0.8 * WINDOW)
        driving, turning = _moved(along, position, full=full), _moved(turned, heading[None], full=full)
        # Of the two, the larger one is what the robot is commanded to do. The other counts only if it is hardly less: a
        # tenth of a slight turn is the drift of a heading.
        lengths = _length(along), _length(turned)
        (larger, main), (smaller, other) = sorted(zip(lengths, (driving, turning), strict=True), key=_by_length)[::-1]
        return True if other and smaller > _COMPARABLE * larger else main

    @property
    def unfollowed(self) -> float:
        """Time for which the robot has been commanded to move without moving as commanded [s]."""
        return self._samples[-1][0] - self._followed if self._samples else 0.0

    @property
    def opposed(self) -> str:
        """The motion that goes against its commands, ``speed`` or ``yaw rate``; empty if the odometry shows none.

        After a change of direction every robot moves against its commands for a while: then it counts only if no lag
        explains the motion.
        """
        if len(self._samples) < _FEWEST:
            return ""
        time, position, heading = self._measured()
        if time[-1] - time[0] <= 0.8 * WINDOW:
            return ""
        given = np.array([*self._earlier, *(sample[:4] for sample in self._samples)])
        for index, (name, smallest) in enumerate((("speed", _SMALLEST), ("yaw rate", _OPPOSED_TURN))):
            measured = heading[None] if index else position
            values = given[:, [2] if index else [1, 3]]
            steady = ((values >= 0).all(axis=0) | (values <= 0).all(axis=0)).all()
            lags = _LAGS[:1] if steady else _LAGS
            if all(_opposes(self._commanded(time, heading, lag)[index], measured, smallest) for lag in lags):
                return name
        return ""

    @property
    def velocity(self) -> MeasuredVelocity | None:
        """The mean measured velocity; None if the odometry shows no motion of more than its noise."""
        if len(self._samples) < _FEWEST:
            return None
        time, position, heading = self._measured()
        span = time - time.mean()
        power = float((span**2).sum())
        rates, moves = [], False
        for values in (*position, heading):
            rate = float((span * (values - values.mean())).sum()) / power
            scatter = values - values.mean() - rate * span
            error = np.sqrt(float((scatter**2).sum()) / (len(time) - 2) / power)
            moves |= abs(rate) * float(time[-1] - time[0]) > _SMALLEST and abs(rate) > _CERTAIN * error
            rates.append(rate)
        if not moves:
            return None
        middle = float(heading[len(heading) // 2])
        cosine, sine = np.cos(middle), np.sin(middle)
        return MeasuredVelocity(
            float(cosine * rates[0] + sine * rates[1]), float(cosine * rates[1] - sine * rates[0]), rates[2]
        )

    @property
    def _little_commanded(self) -> bool:
        """Whether less motion is commanded within the window than can be judged."""
        time, _, heading = self._measured()
        return max(_length(steps) for steps in self._commanded(time, heading)) < _SMALLEST

    def _measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [s], positions ``[2, n]`` [m] and headings [rad] within the window."""
        time, _, _, _, x, y, heading = np.array(self._samples).T
        return time, np.array([x, y]), np.unwrap(heading)

    def _commanded(self, time: np.ndarray, heading: np.ndarray, lag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Steps ``[2, n - 1]`` [m] and turns ``[1, n - 1]`` [rad] between poses, of commands with a lag [s]."""
        given = np.array([*self._earlier, *(sample[:4] for sample in self._samples)])
        # The command in effect at a time; before the first one, the robot was not commanded to move.
        index = np.searchsorted(given[:, 0], time[:-1] - lag + 1e-9, side="right") - 1
        commands = np.where(index[:, None] >= 0, given[index, 1:], 0.0)
        step = np.diff(time)
        cosine, sine = np.cos(heading[:-1]), np.sin(heading[:-1])
        ahead, left = np.array([cosine, sine]), np.array([-sine, cosine])
        return (commands[:, 0] * ahead + commands[:, 2] * left) * step, (commands[:, 1] * step)[None]


def _opposes(steps: np.ndarray, measured: np.ndarray, smallest: float) -> bool:
    """Whether measured positions ``[d, n]`` go against commanded steps ``[d, n - 1]`` of at least a length."""
    if _length(steps) <= smallest or (found := _share(steps, measured)) is None:
        return False
    share, margin = found
    return share + margin < -_OPPOSED


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
