"""The simulator in the loop with predictor and selector: a real drive through ROS, closed by MuJoCo."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from monoforce_ros.messages import message_class
from monoforce_ros.nodes.frames import TransformListener
from monoforce_ros.robots import load_robot


@pytest.fixture(scope="module")
def simulator(start):
    process = start("simulator", "--flat", "--lidar-rate", "5")
    process.wait_for("simulating husky in world 12")
    return process


@pytest.fixture(scope="module")
def heard(peer, simulator):
    received: dict[str, list] = {"odom": [], "points": []}
    for topic, kind in (("odom", Odometry), ("points", PointCloud2)):
        peer.node.create_subscription(kind, f"/{topic}", received[topic].append, QoSProfile(depth=20))
    return received


def place(message: Odometry) -> np.ndarray:
    return np.array([message.pose.pose.position.x, message.pose.pose.position.y])


def test_it_follows_commands_and_stops_without_them(peer, simulator, heard):
    publisher = peer.node.create_publisher(TwistStamped, "/cmd_vel", 5)
    assert peer.until(lambda: publisher.get_subscription_count() > 0 and heard["odom"], 20.0), simulator.output
    origin = place(heard["odom"][-1])
    command = TwistStamped()
    command.twist.linear.x = 0.5
    first = heard["odom"][-1]
    for _ in range(40):
        publisher.publish(command)
        peer.spin(0.05)
    gone = np.linalg.norm(place(heard["odom"][-1]) - origin)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in (first, heard["odom"][-1])]
    # As fast as commanded, by the simulation's own clock, which may lag on a busy computer; starting takes a moment.
    assert 0.3 < gone / (0.5 * (stamps[1] - stamps[0])) < 1.05
    assert heard["odom"][-1].twist.twist.linear.x == pytest.approx(0.5, abs=0.08)
    assert peer.until(lambda: abs(heard["odom"][-1].twist.twist.linear.x) < 0.02, 10.0)
    assert len(heard["points"]) >= 3
    cloud = heard["points"][-1]
    assert cloud.header.frame_id == "lidar" and cloud.width * cloud.height > 500
    peer.node.destroy_publisher(publisher)


def test_it_publishes_the_transforms_that_viewers_need(peer, simulator, heard):
    if message_class("tf2_msgs/msg/TFMessage") is None:
        pytest.skip("tf2_msgs is not installed (make interfaces builds it)")
    transforms = TransformListener(peer.node)
    assert peer.until(lambda: transforms.tree.find("odom", "lidar") is not None, 10.0), transforms.tree.frames
    husky = load_robot("husky")
    np.testing.assert_allclose(transforms.tree.find("base_link", "lidar"), husky.sensors["lidar"], atol=1e-6)
    assert np.linalg.norm(transforms.tree.find("odom", "base_link")[:2, 3] - place(heard["odom"][-1])) < 0.2


def test_predictor_and_selector_drive_it_to_a_goal(peer, simulator, heard, start):
    start("predictor", "--ros-args", "-p", "candidates:=15", "-p", "horizon:=3.0").wait_for(
        "predicting 3 s ahead for husky"
    )
    start("path_selector").wait_for("waiting for a goal")
    goals = peer.node.create_publisher(PoseStamped, "/goal_pose", 1)
    assert peer.until(lambda: goals.get_subscription_count() > 0, 10.0)
    target = place(heard["odom"][-1]) + np.array([2.5, 2.0])
    goal = PoseStamped()
    goal.header.frame_id = "odom"
    goal.pose.position.x, goal.pose.position.y = map(float, target)
    goals.publish(goal)
    began = time.monotonic()

    def left() -> float:
        return float(np.linalg.norm(place(heard["odom"][-1]) - target))

    assert peer.until(lambda: left() < 0.5, 60.0), (left(), simulator.output[-2000:])
    # There it stands, and stays.
    assert peer.until(lambda: abs(heard["odom"][-1].twist.twist.linear.x) < 0.02, 10.0)
    peer.spin(1.0)
    assert left() < 0.8 and time.monotonic() - began < 75.0
    assert simulator.stop() == 0, simulator.output


def test_an_invalid_robot_is_reported_in_one_line(start):
    process = start("simulator", "--robot", "no_such_robot")
    assert process.wait(30) == 1
    assert "no_such_robot" in process.output and "Traceback" not in process.output
