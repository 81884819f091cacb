"""Transforms of the last seconds, and the tree of transforms as it was at a time."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core.frames import TransformTree
from monoforce_ros.core.geometry import homogeneous
from monoforce_ros.core.tracks import NANOSECOND

_KEPT = 10.0
"""Time that poses are kept for [s], as long as tf2 keeps them."""
_JUMP = 1.0
"""A stamp this much older than the newest one [s] is a clock that was set back, not a late message."""


class PoseHistory:
    """A frame's poses of the last 10 s."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, np.ndarray]] = deque()

    def add(self, stamp: int, pose: np.ndarray) -> None:
        """Keep a pose ``[4, 4]`` of a stamp [ns]; late ones are ignored, after a backward time jump it starts anew.

        Of one stamp the last one counts: some publishers leave it at zero.
        """
        if self._poses and stamp == self._poses[-1][0]:
            self._poses[-1] = stamp, pose
            return
        if self._poses and stamp < self._poses[-1][0]:
            if (self._poses[-1][0] - stamp) * NANOSECOND < _JUMP:
                return
            self._poses.clear()
        self._poses.append((stamp, pose))
        while (stamp - self._poses[0][0]) * NANOSECOND > _KEPT:
            self._poses.popleft()

    def at(self, stamp: int, *, hold: bool = False) -> np.ndarray | None:
        """The pose ``[4, 4]`` at a stamp [ns], interpolated.

        Before the oldest one and after the newest one it is None or, with ``hold``, that one.
        """
        poses = list(self._poses)
        after = bisect_left(poses, stamp, key=lambda entry: entry[0])
        if after < len(poses) and (after > 0 or poses[0][0] == stamp):
            return _between(poses[max(after - 1, 0)], poses[after], stamp)
        return poses[min(after, len(poses) - 1)][1] if hold and poses else None

    def gap_text(self, stamp: int) -> str:
        """How far a stamp [ns] is outside of the poses, in words."""
        if not self._poses:
            return "there is none yet"
        oldest, newest = self._poses[0][0], self._poses[-1][0]
        if stamp > newest:
            return f"the newest one is {(stamp - newest) * NANOSECOND:.2f} s older"
        return f"the oldest one kept is {(oldest - stamp) * NANOSECOND:.2f} s newer"


@dataclass(frozen=True)
class PoseTrack:
    """A frame's recorded poses."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], strictly increasing; at least one."""
    poses: np.ndarray
    """``[n, 4, 4]``."""

    def at(self, stamp: int) -> np.ndarray:
        """The pose ``[4, 4]`` at a stamp [ns], interpolated; beyond the first and last one, that one."""
        after = int(np.searchsorted(self.stamps, stamp))
        before, after = max(after - 1, 0), min(after, len(self.stamps) - 1)
        first, second = ((int(self.stamps[i]), self.poses[i]) for i in (before, after))
        return _between(first, second, min(max(stamp, first[0]), second[0]))


def _between(first: tuple[int, np.ndarray], second: tuple[int, np.ndarray], stamp: int) -> np.ndarray:
    """Pose ``[4, 4]`` at a stamp between two stamped poses [ns]: the translation linear, the turn at a constant rate.

    Most frames of a robot do not move; a pose between two equal ones costs next to nothing.
    """
    (before, start), (after, end) = first, second
    if np.array_equal(start, end):
        return end
    share = (stamp - before) / max(after - before, 1)
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    place = (1.0 - share) * start[:3, 3] + share * end[:3, 3]
    return homogeneous(start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix(), place)


class TransformHistory:
    """Transforms between named frames over the last 10 s; static ones are valid at all times."""

    def __init__(self) -> None:
        self._static: dict[tuple[str, str], np.ndarray] = {}
        self._stamped: dict[tuple[str, str], PoseHistory] = {}

    def add(self, parent: str, child: str, matrix: np.ndarray, stamp: int | None) -> None:
        """Keep the pose ``[4, 4]`` of a child in its parent's frame at a stamp [ns], None for a static transform."""
        if stamp is None:
            self._static[parent, child] = matrix
        else:
            self._stamped.setdefault((parent, child), PoseHistory()).add(stamp, matrix)

    def at(self, stamp: int, *, hold: bool = False) -> TransformTree:
        """The transforms that are known at a stamp [ns]; see :meth:`PoseHistory.at`.

        Another thread may add transforms meanwhile.
        """
        tree = TransformTree(dict(self._static))
        for (parent, child), history in list(self._stamped.items()):
            pose = history.at(stamp, hold=hold)
            if pose is not None:
                tree.add(parent, child, pose)
        return tree
