"""Where sensor data lie relative to the robot, online: their sensor may move on it."""

import numpy as np
import pytest
import rclpy
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import builders
from monoforce_ros.core import MotionTrack, RobotFrames, TransformHistory, homogeneous
from monoforce_ros.nodes.health import Health
from monoforce_ros.nodes.inputs import Received
from monoforce_ros.nodes.sensor_decoder import LIDAR, SensorDecoder

SECOND = 10**9


@pytest.fixture
def node(ros_environment, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", ros_environment["ROS_DOMAIN_ID"])
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("decoding", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def standing(count: int = 21) -> MotionTrack:
    """A robot that stands for two seconds from 1 s on."""
    stamps = SECOND + np.arange(count) * SECOND // 10
    zeros = np.zeros((count, 3))
    return MotionTrack(stamps, zeros, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), zeros, zeros)


def turned(angle: float) -> np.ndarray:
    return homogeneous(Rotation.from_euler("z", angle).as_matrix(), np.zeros(3))


@pytest.mark.parametrize(("at", "angle"), [(1.5, 0.25), (1.95, 0.475), (2.4, 0.5)])
def test_a_sensor_that_turns_on_the_robot_is_where_it_was_at_the_stamp(node, at, angle):
    """At the newest transform where the data are newer."""
    history = TransformHistory()
    history.add("head", "lidar", homogeneous(np.eye(3), np.array([0.2, 0.0, 0.5])), None)
    for step in range(11):
        history.add("base_link", "head", turned(0.05 * step), SECOND + step * SECOND // 10)
    decoder = SensorDecoder(RobotFrames("base_link"), history, Health(node, [LIDAR]))
    stamp = round(at * SECOND)
    cloud = builders.point_cloud(stamp, "lidar", np.tile([3.0, 0.0, 0.0], (5, 1)))
    seen = decoder.observe(stamp, {LIDAR: Received(cloud, stamp, 0.0)}, standing(), maximum_gap=0.3)
    np.testing.assert_allclose(seen.cloud[0], [3.2 * np.cos(angle), 3.2 * np.sin(angle), 0.5], atol=1e-4)


def test_a_joint_whose_transforms_have_no_stamps_is_where_it_was_last(node):
    history = TransformHistory()
    for step in range(4):
        history.add("base_link", "lidar", turned(0.1 * step), 0)
    decoder = SensorDecoder(RobotFrames("base_link"), history, Health(node, [LIDAR]))
    cloud = builders.point_cloud(2 * SECOND, "lidar", np.tile([3.0, 0.0, 0.0], (5, 1)))
    seen = decoder.observe(2 * SECOND, {LIDAR: Received(cloud, 2 * SECOND, 0.0)}, standing(), maximum_gap=0.3)
    np.testing.assert_allclose(seen.cloud[0], [3.0 * np.cos(0.3), 3.0 * np.sin(0.3), 0.0], atol=1e-4)
