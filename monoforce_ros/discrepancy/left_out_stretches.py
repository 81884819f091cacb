"""Left-out stretches: times of a recording in which the model's motion cannot be compared with the measured one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monoforce_ros.discrepancy.evidence import Evidence, window_starts
from monoforce_ros.discrepancy.terrain_evidence import off_map_stretches
from monoforce_ros.discrepancy.wheel_motion import WheelsWithoutMotion, undriven_stretches, wheels_without_motion
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class LeftOut:
    """Start and end of each stretch that windows must not overlap, by reason, each ``[n, 2]`` int64 [ns]."""

    undriven: np.ndarray
    """The robot moves without commands: somebody drives it with a joystick."""
    in_place: np.ndarray
    """All wheels turn and the robot stays where it is."""
    off_map: np.ndarray
    """The robot is at the edge of its map or beyond it."""
    spinning: WheelsWithoutMotion | None
    """When wheels turn while the robot, or one side of it, stays where it is."""

    @classmethod
    def of(cls, evidence: Evidence, robot: RobotModel) -> LeftOut:
        """What cannot be compared of a recording."""
        motion, nothing = evidence.smoothed.motion, np.zeros((0, 2), np.int64)
        spinning = wheels_without_motion(motion, evidence.wheels, evidence.commands, robot)
        undriven, in_place, off_map = nothing, nothing, off_map_stretches(evidence, robot)
        if len(evidence.commands):
            undriven = undriven_stretches(evidence.commands, evidence.wheels, motion, robot)
            if spinning is not None and spinning.side == "both":
                in_place = np.array(spinning.stretches, np.int64).reshape(-1, 2)
        return cls(undriven, in_place, off_map, spinning)

    @property
    def stretches(self) -> np.ndarray:
        """Of all reasons, ``[n, 2]`` [ns]."""
        return np.concatenate([self.undriven, self.in_place, self.off_map])

    def starts(self, evidence: Evidence, horizon: float, stride: float = 1.0) -> np.ndarray:
        """Starts of the windows of a recording that can be compared, ``[W]`` [ns].

        Args:
            evidence: the recording.
            horizon: length of a window [s].
            stride: time between windows [s].
        """
        starts = window_starts(evidence.smoothed.motion, evidence.smoothed.stretches, horizon, stride)
        return starts[~overlapping(self.stretches, starts, horizon)]


def overlapping(stretches: np.ndarray, starts: np.ndarray, horizon: float) -> np.ndarray:
    """Windows from ``starts`` ``[W]`` [ns] over ``horizon`` [s] that overlap any stretch ``[n, 2]`` [ns], ``[W]``."""
    low, high = stretches.T
    return ((starts[:, None] < high) & (starts[:, None] + round(horizon * 1e9) > low)).any(axis=1)
