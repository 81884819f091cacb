"""Command profiles: who drives, from a table or with the route in sight."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Protocol

import numpy as np

from monoforce_ros.synthetic.route import Route

NAMES = ("random", "straight", "circle")
_MAXIMUM_FILE_BYTES = 10_000_000


class CommandProfile(Protocol):
    """Gives a command for each instant."""

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s] at ``time`` [s], asked in ascending order.

        Args:
            time: since the recording's start [s].
            position: ``[2]`` of the robot in the world [m].
            heading: of the robot in the world [rad].
        """
        ...


class CommandTable:
    """Commands that change at given times and hold in between.

    Args:
        times: ``[n]`` ascending [s]; before the first one the robot stands.
        commands: ``[n, 2]`` forward speed [m/s] and yaw rate [rad/s].
    """

    def __init__(self, times: np.ndarray, commands: np.ndarray):
        times, commands = np.asarray(times, float), np.asarray(commands, float)
        if times.ndim != 1 or commands.shape != (len(times), 2) or not len(times):
            raise ValueError(f"commands: got shapes {times.shape} and {commands.shape}, expected [n] and [n, 2]")
        if not (np.isfinite(times).all() and np.isfinite(commands).all() and (np.diff(times) > 0).all()):
            raise ValueError("commands: expected finite numbers and ascending times")
        self._times, self._commands = times, commands

    @classmethod
    def read(cls, path: Path) -> CommandTable:
        """Read a CSV file with the columns t [s], v [m/s], w [rad/s]; a line of names at its top is allowed."""
        if not path.is_file():
            raise ValueError(f"commands: got {str(path)!r}, expected one of {', '.join(NAMES)} or a CSV file (t,v,w)")
        if path.stat().st_size > _MAXIMUM_FILE_BYTES:
            raise ValueError(f"{path}: got {path.stat().st_size} bytes, expected at most {_MAXIMUM_FILE_BYTES}")
        rows = []
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.reader(file), start=1):
                if not row or row[0].lstrip().startswith("#") or (not rows and row[0].strip() == "t"):
                    continue
                try:
                    time, speed, yaw_rate = (float(value) for value in row)
                except ValueError:
                    raise ValueError(f"{path}, line {number}: got {row}, expected three numbers t,v,w") from None
                rows.append((time, speed, yaw_rate))
        if not rows:
            raise ValueError(f"{path}: got no commands, expected lines t,v,w")
        table = np.array(rows)
        try:
            return cls(table[:, 0], table[:, 1:])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The last command at or before ``time``."""
        index = int(np.searchsorted(self._times, time + 1e-9, side="right")) - 1
        return tuple(self._commands[index].tolist()) if index >= 0 else (0.0, 0.0)


class SteadyCommand:
    """One command, reached gently."""

    def __init__(self, speed: float, yaw_rate: float, rise_time: float = 1.5):
        self._target = np.array([speed, yaw_rate])
        self._rise_time = rise_time

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command, ramped up from rest."""
        return tuple((self._target * min(1.0, time / self._rise_time)).tolist())


class WanderingDriver:
    """A driver who keeps to the route, more or less, with random steps and ramps of speed and yaw rate.

    Args:
        route: the drive's line.
        random: the driver's moods.
    """

    _AHEAD = 1.7
    _STEERING = 1.3
    _SLOWEST, _FASTEST = 0.3, 1.0
    _SHARPEST_TURN = 1.3
    _ACCELERATION, _YAW_ACCELERATION = 0.8, 2.5

    def __init__(self, route: Route, random: np.random.Generator):
        self._route, self._random = route, random
        self._station = 0.0
        self._time = 0.0
        self._speed = self._yaw_rate = 0.0
        self._speed_target = self._sway = 0.0
        self._next_speed = self._next_sway = 0.0
        self._is_step = False

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``; each call continues from the one before."""
        elapsed, self._time = time - self._time, time
        if time >= self._next_speed:
            self._speed_target = self._random.uniform(self._SLOWEST, self._FASTEST)
            self._is_step = time > 0.0 and self._random.uniform() < 0.4
            self._next_speed = time + self._random.uniform(1.2, 2.8)
        if time >= self._next_sway:
            self._sway = self._random.uniform(-0.45, 0.45)
            self._next_sway = time + self._random.uniform(0.6, 1.4)
        self._station = self._route.advance(self._station, position)
        target, _ = self._route.at(self._station + self._AHEAD)
        bearing = math.atan2(*(target - position)[::-1]) - heading
        bearing = math.remainder(bearing, 2 * math.pi)
        wanted = np.clip(self._STEERING * bearing + self._sway, -self._SHARPEST_TURN, self._SHARPEST_TURN)
        change = math.inf if self._is_step else self._ACCELERATION * elapsed
        self._speed += float(np.clip(self._speed_target - self._speed, -change, change))
        turn = self._YAW_ACCELERATION * elapsed
        self._yaw_rate += float(np.clip(wanted - self._yaw_rate, -turn, turn))
        return self._speed, self._yaw_rate


def make_profile(name_or_file: str, route: Route, random: np.random.Generator) -> CommandProfile:
    """The profile of a name (``random``, ``straight``, ``circle``) or of a CSV file (t,v,w).

    Raises:
        ValueError: there is neither such a profile nor such a file, or the file is not a table of commands.
    """
    if name_or_file == "random":
        return WanderingDriver(route, random)
    if name_or_file == "straight":
        return SteadyCommand(0.7, 0.0)
    if name_or_file == "circle":
        return SteadyCommand(0.6, 0.5)
    return CommandTable.read(Path(name_or_file).expanduser())
