"""AlternatingPoses: whether the poses on a topic come from two estimators that do not agree."""

from __future__ import annotations

from collections import deque

import numpy as np

from monoforce_ros.core import NANOSECOND, MotionState, wrap_angle

_WINDOW = 1.0
"""Time within which poses are compared [s]: over it a parabola follows a robot that turns at 1 rad/s at 1 m/s to
2 cm."""
_INTERVAL = 0.1
"""Time between comparisons [s]: odometry may come at 200 Hz."""
_FEWEST = 3
"""Fewest poses of either estimator within the window, and half the number of changes from one to the other."""
_NEWEST = 16
"""Poses that are compared by themselves, too: two estimators of about the same rate are found the sooner."""
_APART = 0.1
"""Smallest distance of two tracks that matters [m]: a cell of a map. A radian of heading counts as a metre."""
_CLEAR = 2.0
"""Smallest gap between two groups of poses over the larger spread within them. White noise shows such groups that
alternate in 0.09 % of the poses at 8 Hz, 0.03 % at 10 Hz and 0.01 % at 20 Hz."""


class AlternatingPoses:
    """Finds two tracks that alternate among the last poses.

    An extended Kalman filter and a base that publish on the same topic each follow a smooth path. Noise of one
    estimator leaves no gap, and a jump is no return.
    """

    def __init__(self) -> None:
        # Stamp [ns], x, y, z [m], heading [rad].
        self._poses: deque[tuple[int, np.ndarray]] = deque()
        self._checked = 0
        self._apart = 0.0

    def clear(self) -> None:
        """Forget all poses."""
        self._poses.clear()
        self._checked, self._apart = 0, 0.0

    def add(self, state: MotionState) -> float:
        """Note a pose; returns how far the two tracks are apart [m], or 0 if there is one."""
        if self._poses and state.stamp < self._poses[-1][0] - _WINDOW / NANOSECOND:
            self.clear()
        self._poses.append((state.stamp, np.append(state.position, state.heading)))
        newest = max(stamp for stamp, _ in self._poses)
        while (newest - self._poses[0][0]) * NANOSECOND > _WINDOW:
            self._poses.popleft()
        if abs(newest - self._checked) * NANOSECOND >= _INTERVAL:
            poses = sorted(self._poses, key=lambda entry: entry[0])
            self._checked, self._apart = newest, _apart(poses[-_NEWEST:]) or _apart(poses)
        return self._apart


def _apart(poses: list[tuple[int, np.ndarray]]) -> float:
    """How far two tracks among poses in the order of their stamps are apart [m]; 0 if there is one."""
    if len(poses) < 2 * _FEWEST:
        return 0.0
    time = (np.array([stamp for stamp, _ in poses]) - poses[0][0]) * NANOSECOND
    values = np.array([pose for _, pose in poses])
    values[:, 3] = wrap_angle(values[:, 3] - values[0, 3])
    # What is left of a smooth path, along the direction in which most is left.
    path = np.vander(time, 3)
    rest = values - path @ np.linalg.lstsq(path, values, rcond=None)[0]
    along = rest @ np.linalg.svd(rest, full_matrices=False)[2][0]
    ordered = np.sort(along)
    gaps = np.diff(ordered)[_FEWEST - 1 : len(ordered) - _FEWEST]
    split = int(gaps.argmax()) + _FEWEST
    spread = max(ordered[split - 1] - ordered[0], ordered[-1] - ordered[split])
    gap = ordered[split] - ordered[split - 1]
    changes = int(np.count_nonzero(np.diff(along >= ordered[split])))
    if gap < max(_APART, _CLEAR * spread) or changes < 2 * _FEWEST:
        return 0.0
    return float(ordered[split:].mean() - ordered[:split].mean())
