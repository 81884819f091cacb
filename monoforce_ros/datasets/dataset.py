"""Error and message conversion shared by the dataset loaders."""

from __future__ import annotations

from monoforce_ros.bags import builders
from monoforce_ros.core import MotionTrack


class DatasetError(ValueError):
    """A dataset with a missing or invalid file; the message names the file."""


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
