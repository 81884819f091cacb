"""The installed predictor with steered robots: steering angles, and commands to move sideways."""

from itertools import pairwise

import numpy as np
import pytest
import yaml
from test_steering import rover

from monoforce_ros.bags import builders
from monoforce_ros.messages import message_class
from monoforce_ros.robots import load_robot

OK, ERROR = 0, 2
ANGLE, SPEED = 0.25, 1.0


@pytest.fixture(scope="module")
def predictor(start, peer):
    process = start(
        "predictor", "--ros-args", "-p", "robot:=rally_car", "-p", "terrain_source:=flat", "-p", "horizon:=3.0",
        "-p", "data_timeout:=1.0",
    )  # fmt: skip
    process.wait_for("predicting 3 s ahead for rally_car")
    assert peer.until(lambda: peer.node.count_subscribers("/diagnostics") > 0)
    return process


def drive(peer, seconds, command):
    def odometry(stamp):
        return builders.odometry(stamp, "odom", "base_link", [0.0, 0.0, 0.2], [0, 0, 0, 1], [SPEED, 0, 0], [0] * 3)

    peer.drive(seconds, odometry=odometry, cloud=lambda stamp: None, command=command)


@pytest.mark.skipif(
    message_class("ackermann_msgs/msg/AckermannDriveStamped") is None,
    reason="ackermann_msgs is not installed (make interfaces builds it)",
)
def test_steering_commands_bend_the_path_as_a_bicycle(peer, predictor):
    steered = load_robot("rally_car").steered
    peer.begin()
    for _ in range(8):
        drive(peer, 1.0, lambda stamp: builders.ackermann_drive(stamp, "base_link", SPEED, ANGLE))
        if len(peer.received["/predicted/path"]) > 5:
            break
    assert peer.received["/predicted/path"], (peer.status("commands"), predictor.output[-3000:])
    assert peer.until(lambda: peer.status("commands") == (OK, "receiving commands"), 5.0), peer.status("commands")
    poses = peer.received["/predicted/path"][-1].poses
    yaw = [2.0 * np.arctan2(p.pose.orientation.z, p.pose.orientation.w) for p in poses]
    way = sum(
        np.hypot(b.pose.position.x - a.pose.position.x, b.pose.position.y - a.pose.position.y)
        for a, b in pairwise(poses)
    )
    # The steering turns first, and tyres slip a little.
    assert (yaw[-1] - yaw[0]) / way == pytest.approx(np.tan(ANGLE) / steered.wheelbase, rel=0.15)

    drive(peer, 1.0, lambda stamp: builders.ackermann_drive(stamp, "base_link", SPEED, float("nan")))
    level, text = peer.status("commands")
    assert level == ERROR and "got speed 1.0, steering angle nan; expected finite numbers" in text
    # The next test hears no other predictor, and sends commands of another type.
    assert predictor.stop() == 0
    peer.node.destroy_publisher(peer._publishers.pop("/cmd_vel"))


def test_a_rover_that_crabs_is_predicted_to_move_sideways(peer, start, tmp_path):
    (tmp_path / "rover.yaml").write_text(yaml.safe_dump(rover()))
    process = start(
        "predictor", "--ros-args", "-p", f"robot:={tmp_path}/rover.yaml", "-p", "terrain_source:=flat", "-p",
        "horizon:=2.0", "-r", "__node:=crabbing", "-p", "candidates:=8",
    )  # fmt: skip
    process.wait_for("predicting 2 s ahead for rover")

    def sideways(stamp):
        message = builders.twist_stamped(stamp, "base_link", 0.3, 0.0)
        message.twist.linear.y = 0.3
        return message

    peer.begin()
    for _ in range(10):
        peer.drive(1.0, cloud=lambda stamp: None, command=sideways)
        if len(peer.received["/predicted/path"]) > 5:
            break
    poses = peer.received["/predicted/path"][-1].poses
    moved = [getattr(poses[-1].pose.position, axis) - getattr(poses[0].pose.position, axis) for axis in "xy"]
    # The wheels first turn by 45°.
    assert moved[1] > 0.35, (moved, peer.status("commands"), process.output[-1500:])
    assert moved[0] == pytest.approx(moved[1], abs=0.15)
    assert process.stop() == 0
