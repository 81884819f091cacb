"""Wheel blocks: commands and measured wheel speeds of a recording, in blocks that are fitted or held out together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.wheel_motion import side_speeds, undriven_stretches
from monoforce_ros.effects import Fastest
from monoforce_ros.robots import RobotModel

_HISTORY = 4.0
"""Length of the commands before a block [s]: twice the longest dead time of the catalogue, for slow integral parts."""
_LONGEST_GAP = 1.0
"""Between samples of a block [s]: a quarter of it, so that no block is judged by less than half of its time."""
BLOCK = 4.0
"""Length of the blocks that are fitted or held out together [s]: longer than drives respond to a step."""
_MOST_SAMPLES = 80
"""Samples of a block that are used at most: every so many are taken, so that 10 to 20 Hz remain, about 13 Hz of a rate
of 40 or 50 Hz. One time constant of 0.08 s then lies between two samples."""
_FEWEST_SAMPLES = 10
"""Of a block that is used: 2.5 Hz, at which commands that are held for a second can still be distinguished."""

_SETTLED = 1.5
"""Time for which a command must have been constant where the ratio of wheels and commands is taken [s]: a real
Warthog's drives (0.65 s dead time, 0.4 s lag) have reached nine tenths of it then."""
_CONSTANT = 0.02
"""Range of commands over the fastest one within which they are constant."""
_MEDIUM = (0.1, 0.6)
"""Commands over the fastest one at which that ratio is taken: above a dead band, and up to the lowest limit with which
the fits of limits begin."""
_FEWEST_STEADY = 10
"""Samples of each side that say a ratio; of fewer that of all samples is taken."""
_DEAD = 0.5
"""Ratio of one side over that of the other below which that side has lost most of its speed."""
_SMALLEST_RATIO = 0.1
"""Measured [rad/s] over commanded speed [m/s] below which wheels do not turn: that of a wheel with a radius of 10 m."""


@dataclass(frozen=True)
class WheelBlocks:
    """Commands and measured wheel speeds in blocks of one length."""

    twists: np.ndarray
    """Commanded forward speed [m/s], yaw rate [rad/s] and, of a robot that crabs, lateral speed [m/s], with those
    before the block, ``[n, 2, T]`` or ``[n, 3, T]``."""
    measured: np.ndarray
    """Measured speed of the left and right wheels, ``[n, 2, K]`` [rad/s], or [m/s] after division by the ratio."""
    place: np.ndarray
    """Time of each sample since the first command, in steps, ``[n, K]``."""
    known: np.ndarray
    """Samples that exist, ``[n, K]`` bool; others fill the array."""
    since: np.ndarray
    """Time of the first command of each block since that of the recording, ``[n]`` [s]."""
    step: float
    """Time between commands [s]."""
    robot: RobotModel
    """Its kinematics make wheel speeds of twists."""

    @classmethod
    def of(cls, commands: CommandTrack, wheels: WheelTrack, robot: RobotModel, step: float) -> WheelBlocks | None:
        """All blocks of about ``BLOCK`` in which the robot is driven by commands, at time steps of ``step`` [s]."""
        stamps = wheels.stamps
        undriven = undriven_stretches(commands, wheels, None, robot)
        breaks = np.flatnonzero(np.diff(stamps) > _LONGEST_GAP * 1e9) + 1
        length = round((_HISTORY + BLOCK) / step) + 1
        twists, measured, place, known, since = [], [], [], [], []
        for run in np.split(np.arange(len(stamps)), breaks):
            number = (stamps[run] - stamps[run[0]]) // round(BLOCK * 1e9)
            for part in np.split(run, np.flatnonzero(np.diff(number)) + 1):
                if len(part) < _FEWEST_SAMPLES or stamps[part[-1]] - stamps[part[0]] < 0.5 * BLOCK * 1e9:
                    continue
                part = part[:: -(-len(part) // _MOST_SAMPLES)]
                first, last = int(stamps[part[0]]) - round(_HISTORY * 1e9), int(stamps[part[-1]])
                if ((undriven[:, 0] < last) & (undriven[:, 1] > first)).any():
                    continue
                grid = first + np.rint(np.arange(length) * step * 1e9).astype(np.int64)
                fill = (0, _MOST_SAMPLES - len(part))
                twists.append(commands.sample(grid).T)
                measured.append(np.pad(wheels.speeds[part].T, ((0, 0), fill)))
                place.append(np.pad((stamps[part] - first) * 1e-9 / step, fill))
                known.append(np.arange(_MOST_SAMPLES) < len(part))
                since.append((first - int(commands.stamps[0])) * 1e-9)
        if not twists:
            return None
        bounds = np.array([[robot.maximum_speed], [robot.maximum_yaw_rate], [robot.maximum_lateral_speed]])
        bounds = bounds[: twists[0].shape[0]]
        limited = np.clip(np.array(twists), -bounds, bounds)
        return cls(limited, np.array(measured), np.array(place), np.array(known), np.array(since), step, robot)

    def __len__(self) -> int:
        return len(self.twists)

    def __getitem__(self, chosen: np.ndarray) -> WheelBlocks:
        parts = {name: getattr(self, name)[chosen] for name in ("twists", "measured", "place", "known", "since")}
        return replace(self, **parts)

    def spread(self, most: int) -> np.ndarray:
        """Indices of at most ``most`` blocks, evenly spread over the recording; those without any motion go first."""
        if len(self) <= most:
            return np.arange(len(self))
        moving = np.flatnonzero((np.abs(self.commanded()).max(axis=(1, 2)) > 0) | (self.measured != 0).any(axis=(1, 2)))
        return moving[np.unique(np.linspace(0, len(moving) - 1, min(most, len(moving))).round().astype(int))]

    @cached_property
    def fastest(self) -> Fastest:
        """Fastest commands: 99.5 % quantiles."""
        speeds = np.abs(self.commanded()).max(axis=1)
        return Fastest(float(np.quantile(speeds, 0.995)), float(np.quantile(np.abs(self.twists[:, 1]), 0.995)))

    @property
    def times(self) -> np.ndarray:
        """Of the commands since the recording's start, ``[n, 1, T]`` [s]."""
        return np.maximum(self.since[:, None, None] + self.step * np.arange(self.twists.shape[2]), 0.0)

    @property
    def pairs(self) -> np.ndarray:
        """Mask of the known samples of both sides, ``[n, 2, K]``."""
        return np.broadcast_to(self.known[:, None], self.measured.shape)

    def commanded(self, twists: np.ndarray | None = None) -> np.ndarray:
        """Wheel speeds ``[..., n, 2, T]`` [m/s] of commanded or given twists."""
        given = self.twists if twists is None else twists
        return np.moveaxis(side_speeds(self.robot, np.moveaxis(given, -2, -1)), -1, -2)

    def at_samples(self, speeds: np.ndarray) -> np.ndarray:
        """Speeds ``[..., n, 2, T]`` at the samples, ``[..., n, 2, K]``."""
        place, share = self._samples
        flat = speeds.reshape(*speeds.shape[:-3], -1)
        before, after = (flat.take(place + shift, axis=-1) for shift in (0, 1))
        return before + share * (after - before)

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray]:
        """The command before each sample among those of all blocks and sides ``[n, 2, K]``, and the share of a step
        that has passed since, ``[n, 1, K]``."""
        count, length = len(self), self.twists.shape[-1]
        index = np.minimum(self.place.astype(int), length - 2)[:, None]
        return index + length * np.arange(2 * count).reshape(count, 2, 1), self.place[:, None] - index

    def ratio(self) -> float | None:
        """Measured [rad/s] over commanded speed [m/s] where a command of medium size was constant for a while."""
        commanded, top = self.commanded(), self.fastest.speed
        # Until the sample.
        settled = round(_SETTLED / self.step)
        shift = {"size": settled + 1, "origin": settled // 2, "axis": 2}
        extent = self.at_samples(maximum_filter1d(commanded, **shift) - minimum_filter1d(commanded, **shift))
        recent = self.at_samples(commanded)
        medium = (np.abs(recent) > _MEDIUM[0] * top) & (np.abs(recent) < _MEDIUM[1] * top)
        steady = self.pairs & (extent < _CONSTANT * top) & medium
        sides = [self.measured[:, side][steady[:, side]] / recent[:, side][steady[:, side]] for side in range(2)]
        if min(map(len, sides)) < _FEWEST_STEADY:
            measured, recent = self.measured[self.pairs], recent[self.pairs]
            ratio = float(recent @ measured) / max(float(recent @ recent), 1e-9)
        else:
            # A dead side says nothing about the wheel's radius.
            left, right = (float(np.median(side)) for side in sides)
            ratio = 0.5 * (left + right) if min(left, right) > _DEAD * max(left, right) else max(left, right)
        return ratio if ratio > _SMALLEST_RATIO else None
