"""Where sensors sit on the robot: from the robot's own transforms where tf2 is installed, else from its file."""

from __future__ import annotations

import numpy as np
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from monoforce_ros.messages import MessageError
from monoforce_ros.robots import RobotModel


class SensorFrames:
    """Poses of sensor frames in the robot's base frame.

    tf2 is part of every ROS installation but not of its Python wheels, so it is used where it can be imported. The
    ``/tf_static`` of a robot goes before the robot file, which describes the model, not the unit.
    """

    def __init__(self, node: Node, robot: RobotModel):
        self._robot = robot
        self._buffer = None
        try:
            from tf2_ros import Buffer, TransformListener
        except ImportError:
            return
        self._buffer = Buffer()
        # The listener spins with the node's own executor; look-ups below never wait.
        self._listener = TransformListener(self._buffer, node)

    def base_from(self, frame_id: str) -> np.ndarray:
        """Pose ``[4, 4]`` of a frame in the base frame; raises ``MessageError`` that says what is known instead."""
        frame = frame_id.lstrip("/")
        if frame == self._robot.base_frame:
            return np.eye(4)
        if self._buffer is not None and self._buffer.can_transform(self._robot.base_frame, frame, Time()):
            return _matrix(self._buffer.lookup_transform(self._robot.base_frame, frame, Time()).transform)
        if frame in self._robot.sensors:
            return self._robot.sensors[frame].double().numpy()
        raise MessageError(
            f"the pose of frame {frame_id!r} on the robot is unknown: add it to the robot file under `sensors` "
            f"(known there: {sorted(self._robot.sensors)}) or publish it on /tf_static"
        )


def _matrix(transform) -> np.ndarray:
    rotation, translation = transform.rotation, transform.translation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    matrix[:3, 3] = [translation.x, translation.y, translation.z]
    return matrix
