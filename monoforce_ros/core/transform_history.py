"""Transforms of the last seconds, and the tree of transforms as it was at a time."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

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
        """Keep a pose ``[4, 4]`` of a stamp [ns]; late ones are ignored, after a backward time jump it starts anew."""
        if self._poses and stamp <= self._poses[-1][0]:
            if (self._poses[-1][0] - stamp) * NANOSECOND < _JUMP:
                return
            self._poses.clear()
        self._poses.append((stamp, pose))
        while (stamp - self._poses[0][0]) * NANOSECOND > _KEPT:
            self._poses.popleft()

    def at(self, stamp: int) -> np.ndarray | None:
        """The pose ``[4, 4]`` at a stamp [ns], interpolated; None before the oldest and after the newest one."""
        poses = list(self._poses)
        for (before, first), (after, second) in zip(poses[:1] + poses, poses, strict=False):
            if before <= stamp <= after:
                share = (stamp - before) / max(after - before, 1)
                turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]])))
                place = (1.0 - share) * first[:3, 3] + share * second[:3, 3]
                return homogeneous(turns(share).as_matrix(), place)
        return None

    def gap_text(self, stamp: int) -> str:
        """How far a stamp [ns] is outside of the poses, in words."""
        if not self._poses:
            return "there is none yet"
        oldest, newest = self._poses[0][0], self._poses[-1][0]
        if stamp > newest:
            return f"the newest one is {(stamp - newest) * NANOSECOND:.2f} s older"
        return f"the oldest one kept is {(oldest - stamp) * NANOSECOND:.2f} s newer"


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

    def at(self, stamp: int) -> TransformTree:
        """The transforms that are known at a stamp [ns]."""
        tree = TransformTree(self._static)
        for (parent, child), history in self._stamped.items():
            pose = history.at(stamp)
            if pose is not None:
                tree.add(parent, child, pose)
        return tree
