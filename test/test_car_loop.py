"""Simulator, predictor and selector drive a car to a goal through ROS, and a robot that crabs sideways to one."""

import numpy as np
import yaml
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from test_steering import rover

from monoforce_ros.robots import load_robot


def reached(peer, start, robot, target, *, seconds=150.0):
    """Drive to a goal in the odometry frame; returns the commands that were sent and the joint states."""
    simulator = start("simulator", "--flat", "--lidar-rate", "0", "--robot", robot)
    simulator.wait_for("simulating", 180.0)
    odometry, commands, joints = [], [], []
    subscriptions = [
        peer.node.create_subscription(kind, topic, kept.append, QoSProfile(depth=20))
        for kind, topic, kept in ((Odometry, "/odom", odometry), (JointState, "/joint_states", joints))
    ]
    parameters = [
        "candidates:=13", "horizon:=3.0", "candidate_spacing:=0.1", "candidate_time_step:=0.02", "terrain_source:=flat",
        f"robot:={robot}", "rate:=3.0", "candidate_speeds:=[0.0,0.5,0.9]", "candidate_yaw_rate:=0.9",
    ]  # fmt: skip
    predictor = start("predictor", "--ros-args", *(word for p in parameters for word in ("-p", p)))
    predictor.wait_for("predicting 3 s ahead", 180.0)
    selector = start("path_selector", "--ros-args", "-p", "goal_tolerance:=0.45", "-p", "timeout:=4.0")
    selector.wait_for("waiting for a goal", 120.0)
    subscriptions.append(peer.node.create_subscription(TwistStamped, "/cmd_vel", commands.append, QoSProfile(depth=50)))
    goals = peer.node.create_publisher(PoseStamped, "/goal_pose", 1)
    assert peer.until(lambda: goals.get_subscription_count() > 0 and odometry, 20.0), simulator.output
    goal = PoseStamped()
    goal.header.frame_id = "odom"
    goal.pose.position.x, goal.pose.position.y = map(float, target)
    goals.publish(goal)

    def left():
        place = odometry[-1].pose.pose.position
        return float(np.hypot(place.x - target[0], place.y - target[1]))

    assert peer.until(lambda: left() < 0.6, seconds), (left(), selector.output[-1500:], simulator.output[-500:])
    for subscription in subscriptions:
        peer.node.destroy_subscription(subscription)
    peer.node.destroy_publisher(goals)
    for process in (selector, predictor, simulator):
        assert process.stop() == 0, process.output[-8000:]
    return np.array([[m.twist.linear.x, m.twist.angular.z, m.twist.linear.y] for m in commands]), joints


def test_a_car_reaches_a_goal_by_turns_that_it_can_drive(peer, start):
    commands, joints = reached(peer, start, "rally_car", (4.0, 2.5))
    limit = load_robot("rally_car").maximum_curvature
    driven = np.abs(commands[:, 0]) > 1e-6
    assert driven.any() and np.abs(commands[~driven, 1]).max(initial=0.0) < 1e-6  # it never turns in place
    assert (np.abs(commands[driven, 1]) <= limit * np.abs(commands[driven, 0]) * 1.01).all()
    assert not commands[:, 2].any()
    angles = np.array([message.position[list(message.name).index("left_steering_joint")] for message in joints])
    assert np.ptp(angles) > 0.1


def test_a_robot_that_crabs_is_sent_sideways(peer, start, tmp_path):
    (tmp_path / "rover.yaml").write_text(yaml.safe_dump(rover()))
    commands, _ = reached(peer, start, str(tmp_path / "rover.yaml"), (0.3, 2.0))
    assert commands[:, 2].max() > 0.3
