"""Drive session: driver, base controller and injections of one drive, the same for every engine."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from drawn_platform import Platform
from drive_commands import RATE, Driver
from ground_shape import Ground
from injection import TICK, BaseState, Build, Injection

_TICKS_PER_COMMAND = round(1.0 / (RATE * TICK))


@dataclass(frozen=True)
class DriveJob:
    """One drive to be simulated."""

    platform: Platform
    ground: Ground
    driver: Driver
    injections: tuple[Injection, ...]
    duration: float
    """[s]."""


@dataclass(frozen=True)
class Trace:
    """A simulated drive at the ``TICK`` of the controller.

    Attributes:
        positions: ``[n, 3]`` of the base frame in the world [m].
        rotations: ``[n, 3, 3]``, world ← base.
        velocities, rates: ``[n, 3]`` in the base frame [m/s, rad/s].
        wheel_speeds: ``[n, wheels]`` [rad/s], left ones first.
        commands: ``[m, 2]`` at the rate of the driver [m/s, rad/s].
        mishap: why the robot tipped over, left the ground or diverged; None if it did not.
    """

    positions: np.ndarray
    rotations: np.ndarray
    velocities: np.ndarray
    rates: np.ndarray
    wheel_speeds: np.ndarray
    commands: np.ndarray
    mishap: str | None = None


class DriveSession:
    """Driver, base controller and injections of a drive."""

    def __init__(self, job: DriveJob):
        self._job = job
        platform = job.platform
        self._delay: deque[np.ndarray] = deque([np.zeros(2)] * round(platform.dead_time / TICK))
        self._drives = np.zeros(2)
        self._command = np.zeros(2)
        self._keep = math.exp(-TICK / platform.lag)
        self._ticks = 0
        self._states: list[BaseState] = []
        self._commands: list[np.ndarray] = []
        self.mishap: str | None = None

    def tick(self, state: BaseState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Record a state; target speeds ``[2]`` of the left and right wheels [rad/s], force ``[3]`` and torque ``[3]``.

        Force [N] and torque [N m] about the robot's centre of mass are in the world frame.
        """
        job, platform, time = self._job, self._job.platform, self._ticks * TICK
        self._states.append(state)
        if self._ticks % _TICKS_PER_COMMAND == 0:
            start = self._states[0].position
            self._command = np.array(job.driver.command(time, (state.position - start)[:2], state.heading))
            self._commands.append(self._command)
        self._ticks += 1
        active = [injection for injection in job.injections if time >= injection.onset]
        twist = self._command
        for injection in active:
            twist = injection.twist(time, twist)
        self._delay.append(twist)
        speed, rate = self._delay.popleft()
        speed = min(max(speed, -platform.maximum_speed), platform.maximum_speed)
        rate = min(max(rate, -platform.maximum_yaw_rate), platform.maximum_yaw_rate)
        turn = rate * platform.controller_track / 2
        target = np.array([speed - turn, speed + turn])
        for injection in active:
            target = injection.drives(time, target)
        self._drives = target + (self._drives - target) * self._keep
        force, torque = np.zeros(3), np.zeros(3)
        for injection in active:
            one, other = injection.wrench(time, state)
            force, torque = force + one, torque + other
        return self._drives / platform.controller_radius, force, torque

    def check(self) -> bool:
        """Whether the drive may go on; sets ``mishap`` otherwise."""
        state = self._states[-1]
        if not np.isfinite(state.position).all():
            self.mishap = "diverged"
        elif state.rotation[2, 2] < 0.6:
            self.mishap = "tipped over"
        elif np.abs(state.position[:2]).max() > 20.0 and self._job.ground.heights is not None:
            self.mishap = "left the ground"
        return self.mishap is None

    def trace(self) -> Trace:
        """The drive as recorded."""
        states = self._states
        return Trace(
            positions=np.array([state.position for state in states]),
            rotations=np.array([state.rotation for state in states]),
            velocities=np.array([state.velocity for state in states]),
            rates=np.array([state.rates for state in states]),
            wheel_speeds=np.array([state.wheel_speeds for state in states]),
            commands=np.array(self._commands),
            mishap=self.mishap,
        )


def combined_build(injections: Sequence[Injection]) -> Build:
    """The one build that injections ask for, or the default; two would contradict each other."""
    builds = [injection.build for injection in injections if injection.build != Build()]
    if len(builds) > 1:
        raise ValueError(f"injections: got {len(builds)} that change the robot's build, expected at most one")
    return builds[0] if builds else Build()
