"""Sensor poses on the robot: from /tf_static if tf2 is installed, otherwise from the robot file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Transform
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from monoforce_ros.messages import MessageError
from monoforce_ros.robots import RobotModel

if TYPE_CHECKING:
    from tf2_ros import Buffer as TransformBuffer


class SensorFrames:
    """Poses of sensor frames in the robot's base frame.

    tf2 is part of every ROS installation but not of the Python wheels, so it is used if it can be imported.
    ``/tf_static`` takes precedence over the robot file, which describes the model, not the individual robot.
    """

    def __init__(self, node: Node, robot: RobotModel):
        self._robot = robot
        self._buffer: TransformBuffer | None = None
        try:
            from tf2_ros import Buffer, TransformListener
        except ImportError:
            return
        self._buffer = Buffer()
        # The node's own executor spins the listener; the look-ups below never wait.
        self._listener = TransformListener(self._buffer, node)

    def base_from(self, frame_id: str) -> np.ndarray:
        """Pose ``[4, 4]`` of a frame in the base frame; raises ``MessageError``, which lists the known frames."""
        frame = frame_id.lstrip("/")
        if frame == self._robot.base_frame:
            return np.eye(4)
        if self._buffer is not None and self._buffer.can_transform(self._robot.base_frame, frame, Time()):
            return _matrix(self._buffer.lookup_transform(self._robot.base_frame, frame, Time()).transform)
        if frame in self._robot.sensors:
            return self._robot.sensors[frame].double().numpy()
        raise MessageError(
            f"the pose of frame {frame_id!r} on the robot is unknown: add it to the robot file under `sensors` "
            f"(frames there: {sorted(self._robot.sensors)}) or publish it on /tf_static"
        )


def _matrix(transform: Transform) -> np.ndarray:
    rotation, translation = transform.rotation, transform.translation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    matrix[:3, 3] = [translation.x, translation.y, translation.z]
    return matrix
