"""Error and message conversion shared by the dataset loaders."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from monoforce_ros.bags import builders
from monoforce_ros.core import MotionTrack


class DatasetError(ValueError):
    """A dataset with a missing or invalid file; the message names the file."""


def require_returns(points: np.ndarray, file: Path) -> None:
    """Raise ``DatasetError`` if no point ``[n, 3]`` of a cloud is a finite return."""
    returns = np.isfinite(points).all(axis=1) & (points != 0.0).any(axis=1)
    if not returns.any():
        raise DatasetError(f"{file}: none of its {len(points)} points is a finite return")


def odometry_message(motion: MotionTrack, index: int) -> builders.Message:
    """``nav_msgs/Odometry`` of one state of a motion."""
    return builders.odometry(
        int(motion.stamps[index]),
        motion.frame_id,
        motion.child_frame_id,
        motion.positions[index],
        motion.quaternions[index],
        motion.linear_velocities[index],
        motion.angular_velocities[index],
    )
