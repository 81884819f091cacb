"""Command profiles: commands over time from a table, a driver that follows the route, or test signals."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Protocol

import numpy as np

from monoforce_ros.synthetic.route import Route

NAMES = ("random", "steps", "sweep", "straight", "circle", "spin", "crab")
_MAXIMUM_FILE_BYTES = 10_000_000


class CommandProfile(Protocol):
    """Gives a command for each instant."""

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, ...]:
        """Forward speed [m/s], yaw rate [rad/s] and, for robots that crab, speed to the left [m/s] at ``time``.

        Calls are in ascending order of time.

        Args:
            time: since the start of the recording [s].
            position: ``[2]`` of the robot in the world [m].
            heading: heading of the robot in the world [rad].
        """
        ...


class CommandTable:
    """Commands that change at given times and hold in between.

    Args:
        times: ``[n]`` ascending [s]; the command is zero before the first one.
        commands: ``[n, 2]`` forward speed [m/s] and yaw rate [rad/s]; ``[n, 3]`` with a speed to the left [m/s].
    """

    def __init__(self, times: np.ndarray, commands: np.ndarray):
        times, commands = np.asarray(times, float), np.asarray(commands, float)
        shapes = ((len(times), 2), (len(times), 3))
        if times.ndim != 1 or commands.shape not in shapes or not len(times):
            raise ValueError(
                f"commands: got shapes {times.shape} and {commands.shape}, expected [n] and [n, 2] or [n, 3]"
            )
        if not (np.isfinite(times).all() and np.isfinite(commands).all() and (np.diff(times) > 0).all()):
            raise ValueError("commands: expected finite numbers and ascending times")
        self._times, self._commands = times, commands

    @classmethod
    def read(cls, path: Path) -> CommandTable:
        """Read a CSV file with the columns t [s], v [m/s], w [rad/s] and, optionally, the speed to the left y [m/s].

        A header line is optional.
        """
        if not path.is_file():
            raise ValueError(f"commands: got {str(path)!r}, expected one of {', '.join(NAMES)} or a CSV file (t,v,w)")
        if path.stat().st_size > _MAXIMUM_FILE_BYTES:
            raise ValueError(f"{path}: got {path.stat().st_size} bytes, expected at most {_MAXIMUM_FILE_BYTES}")
        rows: list[list[float]] = []
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.reader(file), start=1):
                if not row or row[0].lstrip().startswith("#") or (not rows and row[0].strip() == "t"):
                    continue
                try:
                    rows.append([float(value) for value in row])
                except ValueError:
                    rows.append([])
                if len(rows[-1]) not in (3, 4) or len(rows[-1]) != len(rows[0]):
                    raise ValueError(f"{path}, line {number}: got {row}, expected numbers t,v,w or t,v,w,y")
        if not rows:
            raise ValueError(f"{path}: got no commands, expected lines t,v,w")
        table = np.array(rows)
        try:
            return cls(table[:, 0], table[:, 1:])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, ...]:
        """The last command at or before ``time``."""
        index = int(np.searchsorted(self._times, time + 1e-9, side="right")) - 1
        return _numbers(self._commands[max(index, 0)] if index >= 0 else 0.0 * self._commands[0])


class SteadyCommand:
    """A constant command, ramped up from rest."""

    def __init__(self, speed: float, yaw_rate: float, *lateral: float, rise_time: float = 1.5):
        self._target = np.array([speed, yaw_rate, *lateral])
        self._rise_time = rise_time

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, ...]:
        """The command, ramped up from rest."""
        return _numbers(self._target * min(1.0, time / self._rise_time))


class WanderingDriver:
    """Follows the route loosely, with random steps and ramps of speed and yaw rate.

    After an obstacle has stopped the robot, it reverses and goes around.

    Args:
        route: path to follow.
        random: draws speeds and deviations from the route.
    """

    _LOOKAHEAD = 1.7
    _STEERING_GAIN = 1.3
    _SLOWEST, _FASTEST = 0.3, 1.0
    _SHARPEST_TURN = 1.3
    _SWAY = 0.45
    _ACCELERATION, _YAW_ACCELERATION = 0.8, 2.5
    _STUCK_TIME, _STUCK_DISTANCE = 2.5, 0.12
    """Time [s] within which the robot must move by a distance [m]; otherwise something stops it."""
    _BACK_TIME = (1.2, 2.5)
    _SKIPPED = 2.5
    """Distance along the route by which the driver then looks ahead [m]."""

    def __init__(self, route: Route, random: np.random.Generator):
        self._route, self._random = route, random
        self._station = 0.0
        self._time = 0.0
        self._speed = self._yaw_rate = 0.0
        self._speed_target = self._sway = 0.0
        self._next_speed = self._next_sway = 0.0
        self._is_step = False
        self._place, self._since = np.zeros(2), 0.0
        self._until, self._turn = -math.inf, 0.0

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``, continued from the previous call."""
        elapsed, self._time = time - self._time, time
        if time >= self._next_speed:
            self._speed_target = self._random.uniform(self._SLOWEST, self._FASTEST)
            self._is_step = time > 0.0 and self._random.uniform() < 0.4
            self._next_speed = time + self._random.uniform(1.2, 2.8)
        if time >= self._next_sway:
            self._sway = self._random.uniform(-self._SWAY, self._SWAY)
            self._next_sway = time + self._random.uniform(0.6, 1.4)
        self._station = self._route.advance(self._station, position)
        target, _ = self._route.at(self._station + self._LOOKAHEAD)
        bearing = math.atan2(*(target - position)[::-1]) - heading
        bearing = math.remainder(bearing, 2 * math.pi)
        yaw_rate = np.clip(self._STEERING_GAIN * bearing + self._sway, -self._SHARPEST_TURN, self._SHARPEST_TURN)
        change = math.inf if self._is_step else self._ACCELERATION * elapsed
        self._speed += float(np.clip(self._speed_target - self._speed, -change, change))
        turn = self._YAW_ACCELERATION * elapsed
        self._yaw_rate += float(np.clip(yaw_rate - self._yaw_rate, -turn, turn))
        if time < self._until:
            return -0.6 * self._FASTEST, self._turn
        self._look_at_progress(time, position)
        return self._speed, self._yaw_rate

    def _look_at_progress(self, time: float, position: np.ndarray) -> None:
        """Reverse from the next command on where the robot has not moved."""
        if float(np.linalg.norm(position - self._place)) > self._STUCK_DISTANCE:
            self._place, self._since = position.copy(), time
        elif time - self._since > self._STUCK_TIME:
            self._until = time + self._random.uniform(*self._BACK_TIME)
            self._turn = float(self._random.choice([-1.0, 1.0])) * self._random.uniform(0.2, 0.9)
            self._station += self._SKIPPED
            self._place, self._since = position.copy(), self._until


class ExcitationDriver:
    """Random steps and ramps of speed and yaw rate, including stops and reversing, that stay near the start.

    It covers every motion regime in random order, as system identification requires.

    Args:
        fastest: largest speed [m/s].
        random: draws the commands.
        curvature: largest curvature of a turn [1/m]; turns on the spot become arcs where it is finite.
        crabs: whether commands have a lateral speed.
    """

    _REACH = 8.0
    _SHARPEST_TURN = 1.3
    _SIDEWAYS = 0.6
    """Largest lateral speed over the forward one."""

    def __init__(
        self, fastest: float, random: np.random.Generator, curvature: float = math.inf, *, crabs: bool = False
    ):
        self._fastest, self._random, self._curvature, self._crabs = fastest, random, curvature, crabs
        self._from = self._to = np.zeros(3 if crabs else 2)
        self._start, self._rise, self._end = 0.0, 0.1, 0.0

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, ...]:
        """The command at ``time``, continued from the previous call."""
        if time >= self._end:
            self._from = self._at(time)
            self._choose(position, heading)
            self._start, self._end = time, time + float(self._random.uniform(1.0, 3.5))
            self._rise = float(self._random.choice([1e-3, 0.5, 1.2]))
        return _numbers(self._at(time))

    def _at(self, time: float) -> np.ndarray:
        return self._from + (self._to - self._from) * min(1.0, (time - self._start) / self._rise)

    def _choose(self, position: np.ndarray, heading: float) -> None:
        random = self._random
        kind = str(random.choice(["stand", "back", "straight", "turn", "spin"], p=[0.08, 0.12, 0.25, 0.45, 0.1]))
        if kind == "spin" and math.isfinite(self._curvature):
            kind = "turn"
        speed = {"stand": 0.0, "spin": 0.0, "back": -0.5 * random.uniform(0.4, 1.0)}.get(kind, random.uniform(0.3, 1.0))
        rate = 0.0 if kind in ("stand", "straight") else random.uniform(-1.0, 1.0) * self._SHARPEST_TURN
        if np.hypot(*position) > self._REACH and kind != "stand":
            bearing = math.remainder(math.atan2(-position[1], -position[0]) - heading, 2 * math.pi)
            speed = random.uniform(0.3, 0.8)
            rate = float(np.clip(0.8 * bearing, -self._SHARPEST_TURN, self._SHARPEST_TURN))
        if math.isfinite(self._curvature):
            # A share of the sharpest turn at this speed, so that all steering angles occur.
            rate *= min(1.0, abs(speed) * self._fastest * self._curvature / self._SHARPEST_TURN)
        sideways = [random.uniform(-1.0, 1.0) * self._SIDEWAYS * abs(speed) * self._fastest] if self._crabs else []
        self._to = np.array([speed * self._fastest, rate, *sideways])


class SweepDriver:
    """Sweep of speed and yaw rate about a circle, from 0.05 Hz to 0.5 Hz in one minute and back in the next."""

    _PERIOD = 60.0
    _SLOW, _FAST = 0.05, 0.5

    def __init__(self, fastest: float):
        self._fastest = fastest

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``."""
        rounds, since = divmod(time, self._PERIOD)
        growth = (self._FAST - self._SLOW) / self._PERIOD
        forward = self._SLOW * since + 0.5 * growth * since**2
        phase = 2 * math.pi * (forward if rounds % 2 == 0 else -forward)
        ramp = min(1.0, time)
        return ramp * self._fastest * (0.55 - 0.35 * math.cos(0.7 * phase)), ramp * (0.35 + 0.85 * math.sin(phase))


def _numbers(command: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in command)


def make_profile(
    name_or_file: str,
    route: Route,
    random: np.random.Generator,
    maximum_speed: float = 1.0,
    curvature: float = math.inf,
    *,
    crabs: bool = False,
) -> CommandProfile:
    """The profile of a name (``NAMES``) or of a CSV file (t,v,w).

    Args:
        name_or_file: name or path.
        route: path that ``random`` follows.
        random: generator of random commands.
        maximum_speed: maximum speed of the robot [m/s]; profiles stay below 1.5 m/s, since the world is small.
        curvature: largest curvature of its turns [1/m]; infinite for one that turns in place.
        crabs: whether it can move sideways.

    Raises:
        ValueError: the robot cannot do what the profile asks for, there is neither such a profile nor such a file, or
            the file is not a table of commands.
    """
    if name_or_file == "random":
        return WanderingDriver(route, random)
    fastest = min(maximum_speed, 1.5)
    if name_or_file == "steps":
        return ExcitationDriver(fastest, random, curvature, crabs=crabs)
    if name_or_file == "sweep":
        return SweepDriver(fastest)
    if name_or_file == "straight":
        return SteadyCommand(0.7, 0.0)
    if name_or_file == "crab":
        if not crabs:
            raise ValueError("commands: got crab for a robot that cannot move sideways, expected another profile")
        return SteadyCommand(0.4, 0.0, 0.3)
    if name_or_file == "spin":
        return SteadyCommand(0.0, 1.2)
    if name_or_file == "circle":
        return SteadyCommand(0.6, 0.5)
    return CommandTable.read(Path(name_or_file).expanduser())
