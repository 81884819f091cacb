"""Driver: commands for an excited drive that stays near its start."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

RATE = 20.0
"""Of commands [Hz]."""


class Driver(Protocol):
    """Gives a command for each instant."""

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s]; called in ascending order of ``time`` [s].

        Args:
            time: since the start of the recording [s].
            position: ``[2]`` of the robot, from its start [m].
            heading: of the robot [rad].
        """
        ...


class ManoeuvreDriver:
    """Straight stretches, arcs, weaving, turns on the spot, reversing and stops in random order.

    Args:
        fastest: largest speed [m/s].
        sharpest: largest yaw rate [rad/s].
        seed: seed of the draw.
        reach: distance from the start beyond which the robot is led back [m].
    """

    def __init__(self, fastest: float, sharpest: float, seed: int, reach: float = 9.0):
        self._fastest, self._sharpest, self._reach = fastest, sharpest, reach
        self._random = np.random.default_rng([seed, 3])
        self._end = 0.5
        self._target = self._last = (0.0, 0.0)
        self._weave = self._since = 0.0
        # Change per second as a share of the largest value: some operators step the commands, others ramp them.
        self._slew = float(self._random.choice([math.inf, 2.0, 0.8]))

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``."""
        if time >= self._end:
            self._choose(time, position, heading)
        weave = self._weave * math.sin(2.5 * (time - self._since))
        wanted = (self._target[0], self._target[1] + weave)
        change = self._slew / RATE
        speed, rate = (
            last + min(max(goal - last, -change * top), change * top)
            for goal, last, top in zip(wanted, self._last, (self._fastest, self._sharpest), strict=True)
        )
        self._last = speed, rate
        return self._last

    def _choose(self, time: float, position: np.ndarray, heading: float) -> None:
        random = self._random
        self._since, self._end, self._weave = time, time + random.uniform(1.2, 4.0), 0.0
        if np.hypot(*position) > self._reach:
            bearing = math.remainder(math.atan2(-position[1], -position[0]) - heading, 2 * math.pi)
            if abs(bearing) > 1.0:
                self._target = (0.3 * self._fastest, math.copysign(0.7 * self._sharpest, bearing))
                self._end = time + min(4.0, abs(bearing) / (0.5 * self._sharpest))
            else:
                self._target = (random.uniform(0.5, 0.9) * self._fastest, 0.3 * bearing)
            return
        kinds = ["straight", "arc", "weave", "spin", "reverse", "stop"]
        kind = str(random.choice(kinds, p=[0.24, 0.34, 0.12, 0.12, 0.12, 0.06]))
        speed = random.uniform(0.25, 0.95) * self._fastest
        rate = float(random.choice([-1, 1])) * random.uniform(0.2, 0.9) * self._sharpest
        self._target = {
            "straight": (speed, 0.0), "arc": (speed, rate), "weave": (speed, 0.0), "spin": (0.0, rate),
            "reverse": (-0.6 * speed, 0.4 * rate * float(random.integers(2))), "stop": (0.0, 0.0),
        }[kind]  # fmt: skip
        if kind == "weave":
            self._weave = 0.5 * rate


class ReplayedCommands:
    """The commands of another drive.

    Args:
        commands: ``[n, 2]`` forward speed [m/s] and yaw rate [rad/s] at ``RATE``.
    """

    def __init__(self, commands: np.ndarray):
        self._commands = commands

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``."""
        speed, rate = self._commands[min(round(time * RATE), len(self._commands) - 1)]
        return float(speed), float(rate)


class LeadingDriver:
    """A driver whose latest command others can follow.

    Args:
        driver: gives the commands.
    """

    def __init__(self, driver: Driver):
        self._driver = driver
        self.last = (0.0, 0.0)

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``."""
        self.last = self._driver.command(time, position, heading)
        return self.last


class FollowingDriver:
    """The same commands as another driver, in a drive that is simulated side by side and after that one.

    Args:
        leader: the other driver.
    """

    def __init__(self, leader: LeadingDriver):
        self._leader = leader

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``."""
        return self._leader.last
