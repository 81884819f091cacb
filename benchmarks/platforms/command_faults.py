"""Faults on the way from a command to the drives' target speeds."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from injection import TICK, Injection


@dataclass
class Delay(Injection):
    """Commands reach the base later."""

    delay: float = 0.0
    _queue: deque = field(default_factory=deque)

    def twist(self, time: float, twist: np.ndarray) -> np.ndarray:
        """The command of ``delay`` seconds ago."""
        self._queue.append(twist)
        if len(self._queue) > round(self.delay / TICK):
            return self._queue.popleft()
        return self._queue[0] if self.onset else np.zeros(2)


@dataclass
class TwistLimits(Injection):
    """The base clamps the yaw rate and ramps speed and yaw rate."""

    yaw_rate: float = math.inf
    acceleration: float = math.inf
    yaw_acceleration: float = math.inf
    _last: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def twist(self, time: float, twist: np.ndarray) -> np.ndarray:
        """The limited command."""
        wanted = np.array([twist[0], np.clip(twist[1], -self.yaw_rate, self.yaw_rate)])
        change = TICK * np.array([self.acceleration, self.yaw_acceleration])
        self._last = self._last + np.clip(wanted - self._last, -change, change)
        return self._last


@dataclass
class Dropouts(Injection):
    """The base loses commands for a second or so now and then, and keeps the last one."""

    share: float = 0.0
    seed: int = 0

    def __post_init__(self):
        random = np.random.default_rng(self.seed)
        self._windows = []
        time = 0.0
        while time < 200.0:
            gap = random.uniform(0.6, 1.4)
            time += random.exponential(gap * (1 - self.share) / self.share)
            self._windows.append((time, time + gap))
            time += gap
        self._kept = np.zeros(2)

    def twist(self, time: float, twist: np.ndarray) -> np.ndarray:
        """The command, or the last one before the gap."""
        if not any(start <= time < stop for start, stop in self._windows):
            self._kept = twist
        return self._kept


@dataclass
class TurnSignGain(Injection):
    """Turns to one side are faster than to the other."""

    difference: float = 0.0

    def twist(self, time: float, twist: np.ndarray) -> np.ndarray:
        """The command with a yaw rate that depends on its sign."""
        return twist * (1.0, 1.0 + 0.5 * self.difference * np.sign(twist[1]))


@dataclass
class DeadBand(Injection):
    """The drives ignore slow speeds and lose as much from faster ones."""

    width: float = 0.0

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Target speeds beyond the band."""
        return np.where(np.abs(speeds) > self.width, speeds - np.sign(speeds) * self.width, 0.0)


@dataclass
class SpeedLimit(Injection):
    """The drives do not exceed a speed."""

    limit: float = math.inf

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Limited target speeds."""
        return np.clip(speeds, -self.limit, self.limit)


@dataclass
class Lag(Injection):
    """The drives approach their targets exponentially."""

    time_constant: float = 0.1
    _state: np.ndarray | None = None

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Filtered target speeds."""
        keep = math.exp(-TICK / self.time_constant)
        self._state = speeds if self._state is None else speeds + (self._state - speeds) * keep
        return self._state


@dataclass
class DriveFactors(Injection):
    """Constant factors on the speeds of the left and the right drive."""

    left: float = 1.0
    right: float = 1.0

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Scaled target speeds."""
        return speeds * (self.left, self.right)


@dataclass
class SupplySag(Injection):
    """The battery empties: all speeds fall with time."""

    rate: float = 0.0

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Target speeds reduced by ``rate`` [1/s] times the time."""
        return speeds * max(0.1, 1.0 - self.rate * (time - self.onset))


@dataclass
class Backlash(Injection):
    """Play in the gears: after every reversal of a drive's acceleration its speed stays for a while."""

    play: float = 0.0
    _out: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Hysteresis of width ``2 play`` [m/s]."""
        self._out = np.clip(self._out, speeds - self.play, speeds + self.play)
        return self._out


@dataclass
class ThermalCutout(Injection):
    """The motor controllers cut in and out periodically."""

    period: float = 6.0
    off: float = 0.0

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Target speeds; a tenth of them for ``off`` seconds of each period."""
        return speeds * (0.1 if math.fmod(time, self.period) > self.period - self.off else 1.0)


@dataclass
class SpeedCurve(Injection):
    """The drives' speed is a curved function of the commanded one: fast when slow, slow when fast."""

    bend: float = 0.0
    top: float = 1.0

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Target speeds along a sine-shaped curve."""
        return speeds + self.bend * self.top * np.sin(2 * np.pi * speeds / self.top) / np.pi
