"""ProgressCheck: whether a robot that is commanded to move does move."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW = 2.0
"""Time over which commanded and measured motion are compared [s]: bases start within a second."""
_SHARE = 0.1
"""Smallest share of the commanded motion that counts as moving: below it, a robot stands or spins its wheels."""
_SMALLEST = 0.1
"""Smallest commanded motion that is judged [m, rad]; odometry at rest drifts by less within the window."""


class ProgressCheck:
    """Compares commanded with measured motion over the last :data:`WINDOW` seconds."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, np.ndarray]] = deque()

    def clear(self) -> None:
        """Forget everything: the robot is not commanded to move."""
        self._samples.clear()

    def add(self, time: float, command: tuple[float, float], position: np.ndarray, heading: float) -> None:
        """Note a command and the robot's pose.

        Args:
            time: steady time [s], increasing.
            command: forward speed [m/s] and yaw rate [rad/s].
            position: ``[2]`` [m].
            heading: [rad].
        """
        effort = max(abs(command[0]), abs(command[1]))
        self._samples.append((time, effort, np.array([*position[:2], np.cos(heading), np.sin(heading)])))
        while time - self._samples[0][0] > WINDOW:
            self._samples.popleft()

    @property
    def moving(self) -> bool | None:
        """Whether the robot moves as commanded; None while too little was commanded to tell."""
        if len(self._samples) < 2:
            return None
        times = np.array([time for time, _, _ in self._samples])
        efforts = np.array([effort for _, effort, _ in self._samples])
        commanded = float((np.diff(times) * efforts[:-1]).sum())
        poses = np.array([pose for _, _, pose in self._samples])
        done = float(np.linalg.norm(poses - poses[0], axis=1).max())
        if done > _SHARE * commanded and done > _SHARE * _SMALLEST:
            return True
        return False if commanded > _SMALLEST and times[-1] - times[0] > 0.8 * WINDOW else None
