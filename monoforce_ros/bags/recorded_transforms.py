"""RecordedTransforms: the transforms of one pass over a bag, by whether they are fixed or move."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from monoforce_ros.bags.moving_frame import MovingFrame
from monoforce_ros.core import PoseTrack

FIXED = 0.01
"""Largest change of a transform on /tf between frames that are fixed to each other [m, rad]: a joint that moves less
displaces what is measured by less than odometry's own error."""

_Frames = tuple[str, str]


class RecordedTransforms:
    """Collects transforms as parent and child with the pose ``[4, 4]`` of the child."""

    def __init__(self) -> None:
        self.fixed: dict[_Frames, np.ndarray] = {}
        """Static ones and, of others, those that hold still: frames fixed on the robot."""
        self.beside_odometry: dict[_Frames, list[tuple[int, np.ndarray]]] = {}
        """Transforms of the odometry's child frame, other than its pose, at the stamps of the odometry [ns]."""
        self._changed: set[_Frames] = set()
        self._newest: dict[_Frames, np.ndarray] = {}
        self._stamped: dict[_Frames, MovingFrame] = {}

    def add_static(self, found: Mapping[_Frames, np.ndarray]) -> None:
        """Keep those of a message on /tf_static."""
        self.fixed |= found

    def add(self, found: Mapping[_Frames, np.ndarray], stamps: Mapping[_Frames, int], odometry: _Frames) -> None:
        """Keep those of a message on /tf.

        Args:
            found: poses by frames.
            stamps: theirs [ns]; 0 for none.
            odometry: frame and child frame of the odometry.
        """
        world, child = _bare(odometry)
        for frames, matrix in found.items():
            names = _bare(frames)
            if child in names and world not in names:
                self._newest[frames] = matrix
            # Without a stamp nobody knows when it held.
            if stamps[frames] and world not in names:
                self._stamped.setdefault(frames, MovingFrame()).add(stamps[frames], matrix)
            if frames not in self._changed:
                first = self.fixed.setdefault(frames, matrix)
                if np.abs(first - matrix).max() > FIXED:
                    self._changed.add(frames)
                    del self.fixed[frames]

    def sample(self, stamp: int) -> None:
        """Keep the newest transforms of the odometry's child frame at the stamp of an odometry message [ns]."""
        for frames, matrix in self._newest.items():
            self.beside_odometry.setdefault(frames, []).append((stamp, matrix))

    def changed(self, frames: _Frames) -> bool:
        """Whether a transform does not hold still."""
        return frames in self._changed

    def tracks(self, odometry_frame: str) -> dict[_Frames, PoseTrack]:
        """Poses that move, without those in the odometry's frame, which is known since the first odometry only."""
        world = odometry_frame.lstrip("/")
        return {
            frames: kept.track()
            for frames, kept in self._stamped.items()
            if frames in self._changed and world not in _bare(frames)
        }


def _bare(frames: _Frames) -> _Frames:
    """Names without the leading slashes of ROS 1."""
    parent, child = frames
    return parent.lstrip("/"), child.lstrip("/")
