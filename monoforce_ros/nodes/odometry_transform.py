"""The transform on /tf that an odometry message implies."""

from __future__ import annotations

from typing import Any

from monoforce_ros.bags import builders
from monoforce_ros.messages import decoding


def odometry_transform(odometry: Any) -> Any:
    """``tf2_msgs/TFMessage`` of the bag builders with the pose of a ``nav_msgs/Odometry``.

    Raises:
        MessageError: the odometry is not finite.
    """
    state, frame_id, child_frame_id = decoding.decode_odometry(odometry)
    pose = {child_frame_id or "base_link": state.odometry_from_base}
    return builders.transforms(state.stamp, frame_id or "odom", pose)
