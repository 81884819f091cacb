"""ObstacleMemory: obstacles seen from two places, and those that came too near to be seen."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from monoforce_ros.core import NANOSECOND, MotionState, transform_points
from monoforce_ros.perception.standing_points import LEAST_RISE
from monoforce_ros.terrain import Grid

RETENTION_TIME, RETENTION_DISTANCE = 10.0, 6.0
"""How long an obstacle is remembered after it was seen last [s], as long as by default one that a lidar looks over, and
how far the robot may drive meanwhile [m], as odometry drifts."""
_WITHIN = 3.0
"""Distance from the robot within which obstacles are remembered [m]: further ones are still seen, and better placed
later."""
_REPLACED = 3
"""Cells around an obstacle seen now within which it replaces remembered ones: its place is known to about that."""
_ANOTHER_PLACE = 0.1
"""Distance from which on images are of another place [m]."""
_AGAIN = 5
"""Cells around an obstacle seen before within which it is the same: a tenth of 5 m."""


class ObstacleMemory:
    """Remembers obstacles in the odometry frame.

    What is seen from one place alone is wrong too often: it counts when it was seen near there from the place before,
    too. Obstacles nearby are remembered until images show that they have gone: a camera that looks ahead sees neither
    what is below its image nor what it has turned away from.

    Args:
        grid: cells of the maps.
    """

    def __init__(self, grid: Grid):
        self._grid = grid
        self.forget()

    def forget(self) -> None:
        """Remember nothing: odometry has jumped."""
        self._tops = np.zeros((0, 3))
        """Top of each remembered cell in the odometry frame [m]."""
        self._seen_at = np.zeros((0, 2))
        """When it was seen last [s], and distance travelled until then [m]."""
        self._travelled = 0.0
        self._place: np.ndarray | None = None
        self._before: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=2)
        """Where the robot was, and cells in which it saw something ``[n, 3]``, in the odometry frame [m]."""

    def recalled(self, heights: np.ndarray, sight: np.ndarray, motion: MotionState, ground: float) -> np.ndarray:
        """Heights of obstacles seen now, with those remembered ``[rows, columns]`` [m]; NaN where there are none.

        Args:
            heights: height above the ground of what is seen now ``[rows, columns]`` [m], NaN elsewhere.
            sight: height above the ground at which the lowest measured ray passes over each cell [m]; NaN without any.
            motion: the robot's motion; calls come in order of time.
            ground: height of the ground under the robot in its terrain frame [m].
        """
        if self._place is not None:
            self._travelled += float(np.linalg.norm(motion.position - self._place))
        self._place = motion.position.copy()
        seconds = motion.stamp * NANOSECOND
        age = np.array([seconds, self._travelled]) - self._seen_at
        heights = self._confirmed(heights, motion)
        fresh = np.isfinite(heights)
        replaced = cv2.dilate(fresh.astype(np.uint8), np.ones((2 * _REPLACED + 1, 2 * _REPLACED + 1), np.uint8)) > 0
        pose = motion.odometry_from_terrain
        local = transform_points(np.linalg.inv(pose), self._tops)
        rows, columns, inside = self._grid.cells(local[:, :2])
        rise = local[:, 2] - ground
        with np.errstate(invalid="ignore"):
            gone = sight[rows, columns] < rise - LEAST_RISE
        kept = inside & (age[:, 0] < RETENTION_TIME) & (age[:, 1] < RETENTION_DISTANCE)
        kept &= ~(replaced[rows, columns] | gone)
        self._tops, self._seen_at = self._tops[kept], self._seen_at[kept]
        remembered = np.full(heights.shape, -1.0, np.float32)
        np.maximum.at(remembered, (rows[kept], columns[kept]), rise[kept])
        # Cells of two turned grids leave gaps.
        closed = cv2.morphologyEx(remembered, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        result = np.fmax(heights, np.where(closed > LEAST_RISE, closed, np.nan))
        near = fresh & (np.hypot(*np.meshgrid(self._grid.x, self._grid.y)) < _WITHIN)
        row, column = np.nonzero(near)
        tops = np.stack([self._grid.x[column], self._grid.y[row], heights[near] + ground], axis=1)
        self._tops = np.concatenate([self._tops, transform_points(pose, tops)])
        self._seen_at = np.concatenate([self._seen_at, np.tile([seconds, self._travelled], (len(tops), 1))])
        return result

    def _confirmed(self, heights: np.ndarray, motion: MotionState) -> np.ndarray:
        """Those of the heights ``[rows, columns]`` [m] near which something was seen from the place before."""
        grid, pose = self._grid, motion.odometry_from_terrain
        row, column = np.nonzero(np.isfinite(heights))
        cells = transform_points(pose, np.stack([grid.x[column], grid.y[row], np.zeros(len(row))], axis=1))
        elsewhere = [
            there for place, there in self._before if np.linalg.norm(motion.position - place) >= _ANOTHER_PLACE
        ]
        if not self._before or np.linalg.norm(motion.position - self._before[-1][0]) >= _ANOTHER_PLACE:
            self._before.append((motion.position.copy(), cells))
        if not elsewhere:
            return np.full_like(heights, np.nan)
        rows, columns, inside = grid.cells(transform_points(np.linalg.inv(pose), elsewhere[-1])[:, :2])
        seen = np.zeros(heights.shape, np.uint8)
        seen[rows[inside], columns[inside]] = 1
        around = cv2.dilate(seen, np.ones((2 * _AGAIN + 1, 2 * _AGAIN + 1), np.uint8)) > 0
        return np.where(around, heights, np.nan)
