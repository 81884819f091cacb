"""MovingFrame: the poses of a frame on /tf, collected in little memory."""

from __future__ import annotations

from array import array

import numpy as np

from monoforce_ros.core import PoseTrack

_INTERVAL = 20_000_000
"""Between two poses that are kept [ns]: a joint that turns by 1 rad/s at an acceleration of 10 rad/s² is interpolated
to 0.03°, less than any joint is calibrated to."""
_JUMP = 1_000_000_000
"""Step back of the stamps after which a frame starts anew [ns]: a simulator was reset, or a bag played again."""
_SAME = 1e-6
"""Largest difference between poses of a frame that stands still [m, -]."""


class MovingFrame:
    """Collects stamped poses of one frame in another: of poses that stay the same only the first and the last.

    A wheel's transform of an hour takes 19 MB, not 90.
    """

    def __init__(self) -> None:
        self._stamps = array("q")
        self._values = array("d")
        self._last: np.ndarray | None = None
        self._stands = False
        """Whether the last two poses are the same."""
        self._went_back = False
        """Whether the last stamp lay far before the others."""

    def add(self, stamp: int, matrix: np.ndarray) -> None:
        """Add a pose ``[4, 4]`` of a stamp [ns]."""
        later = stamp - self._stamps[-1] if self._stamps else -1
        back = bool(self._stamps) and later < -_JUMP
        if back and self._went_back:
            self._stamps, self._values, self._last, self._stands = array("q"), array("d"), None, False
        elif back:
            # A single one may only be late.
            self._went_back = True
            return
        self._went_back = False
        if 0 <= later < _INTERVAL:
            return
        values = matrix[:3].ravel()
        same = self._last is not None and later > 0 and float(np.abs(self._last - values).max()) < _SAME
        if same and self._stands:
            self._stamps[-1] = stamp
            return
        self._stamps.append(stamp)
        self._values.extend(values)
        self._stands = same
        if not same:
            self._last = values

    def track(self) -> PoseTrack:
        """The poses in the order of their stamps; at least one was added."""
        stamps, first = np.unique(np.array(self._stamps, np.int64), return_index=True)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3] = np.array(self._values).reshape(-1, 3, 4)[first]
        return PoseTrack(stamps, poses)
