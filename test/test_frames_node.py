"""The installed predictor on a robot whose frames have a prefix, in a namespace with a /tf of its own."""

import numpy as np
import pytest
from conftest import Process
from predictor_peer import ground_cloud
from rclpy.qos import DurabilityPolicy, QoSProfile

from monoforce_ros.bags import builders, type_store
from monoforce_ros.core import pose_matrix
from monoforce_ros.messages import message_class

OFFSET = [0.2, 0.0, 0.1323, 0.0, 0.0, 0.0]
"""Of base_link in base_footprint."""


@pytest.fixture(scope="module")
def tf_type():
    kind = message_class("tf2_msgs/msg/TFMessage")
    if kind is None:
        pytest.skip("tf2_msgs is not installed (make interfaces builds it)")
    return kind


class Feed:
    """Publishes a standing robot's odometry of base_footprint and its clouds, and keeps the predicted paths."""

    def __init__(self, peer, prefix: str):
        self.peer, self.prefix, self.paths = peer, prefix, []
        kind = message_class("nav_msgs/msg/Path")
        peer.node.create_subscription(kind, f"/{prefix}/predicted/path", self.paths.append, QoSProfile(depth=10))

    def until(self, condition, seconds: float) -> bool:
        for step in range(round(seconds * 20)):
            self.peer.now += 50_000_000
            stamp, prefix = self.peer.now, self.prefix
            frames = f"{prefix}/odom", f"{prefix}/base_footprint"
            odometry = builders.odometry(stamp, *frames, [1.0, 2.0, 0.0], [0, 0, 0, 1], [0] * 3, [0] * 3)
            if step % 4 == 0:
                self.peer.publish(f"/{prefix}/points", builders.point_cloud(stamp, f"{prefix}/lidar", ground_cloud()))
            self.peer.publish(f"/{prefix}/odom", odometry)
            self.peer.spin(0.05)
            if condition():
                return True
        return False

    def status(self, part: str) -> tuple[int, str]:
        for array in reversed(self.peer.received["/diagnostics"]):
            for entry in array.status:
                if entry.name == f"{self.prefix}/predictor: {part}":
                    return int.from_bytes(entry.level, "little"), entry.message
        return -1, ""


def start_position(path) -> list[float]:
    place = path.poses[0].pose.position
    return [place.x, place.y, place.z]


def test_an_offset_is_asked_for_and_applied_once_tf_has_it(peer, start, tf_type):
    process = start(
        "predictor", "--ros-args", "-r", "__ns:=/robot1", "-r", "/tf:=tf", "-r", "/tf_static:=tf_static",
        "-p", "horizon:=1.0",
    )  # fmt: skip
    process.wait_for("predicting 1 s ahead for husky", 120.0)
    feed = Feed(peer, "robot1")
    assert feed.until(lambda: "odometry describes the frame" in feed.status("odometry")[1], 15.0), feed.status(
        "odometry"
    )
    level, text = feed.status("odometry")
    assert level == 2 and "'robot1/base_footprint'" in text and "no transform has" in text
    assert not feed.paths, "something was predicted from a pose that is known to be wrong"
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = peer.node.create_publisher(tf_type, "/robot1/tf_static", latched)
    message = builders.transforms(peer.now, "robot1/base_footprint", {"robot1/base_link": pose_matrix(OFFSET)})
    publisher.publish(bytes(type_store().serialize_cdr(message, message.__msgtype__)))
    assert feed.until(lambda: len(feed.paths) >= 2, 15.0), (feed.status("odometry"), feed.status("prediction"))
    # The path is that of base_link, in the odometry frame with its prefix.
    assert feed.paths[-1].header.frame_id == "robot1/odom"
    np.testing.assert_allclose(start_position(feed.paths[-1]), [1.2, 2.0, 0.1323], atol=1e-6)
    assert feed.until(lambda: feed.status("odometry") == (0, "receiving odometry"), 5.0), feed.status("odometry")
    assert process.stop() == 0


@pytest.mark.parametrize("node", ["predictor", "path_selector"])
def test_transforms_that_come_just_after_the_odometry_are_waited_for_without_an_error(peer, start, tf_type, node):
    prefix = f"late_{node}"
    source = ["-p", "terrain_source:=flat"] if node == "predictor" else []
    transforms = "-r", "/tf:=tf", "-r", "/tf_static:=tf_static"
    process = start(node, "--ros-args", "-r", f"__ns:=/{prefix}", *transforms, *source)
    # Later than anything that counts from the start of the node.
    process.wait_for("odometry: no messages for", 120.0)
    feed = Feed(peer, prefix)
    feed.until(lambda: False, 1.0)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = peer.node.create_publisher(tf_type, f"/{prefix}/tf_static", latched)
    message = builders.transforms(peer.now, f"{prefix}/base_footprint", {f"{prefix}/base_link": pose_matrix(OFFSET)})
    publisher.publish(bytes(type_store().serialize_cdr(message, message.__msgtype__)))
    assert feed.until(lambda: "receiving odometry" in process.output, 15.0), process.output
    assert "the offset between them is unknown" not in process.output
    assert process.stop() == 0


def test_an_offset_may_be_a_parameter(peer, start):
    process = start(
        "predictor", "--ros-args", "-r", "__ns:=/robot2", "-p", "horizon:=1.0",
        "-p", "odometry_child_pose:=[-0.2, 0.0, -0.1323, 0.0, 0.0, 0.0]",
    )  # fmt: skip
    process.wait_for("predicting 1 s ahead for husky", 120.0)
    feed = Feed(peer, "robot2")
    assert feed.until(lambda: len(feed.paths) >= 2, 20.0), (feed.status("odometry"), feed.status("prediction"))
    np.testing.assert_allclose(start_position(feed.paths[-1]), [1.2, 2.0, 0.1323], atol=1e-6)
    assert process.stop() == 0


def test_a_pose_of_another_size_is_refused(start):
    process = start("predictor", "--ros-args", "-p", "odometry_child_pose:=[1.0, 2.0]")
    assert process.wait() == 1
    assert "odometry_child_pose: got 2 values, expected a list of 6 numbers" in process.output


def test_without_tf2_msgs_the_nodes_say_that_tf_is_not_read(peer, executables, ros_environment, tmp_path):
    blocked = tmp_path / "tf2_msgs"
    blocked.mkdir()
    (blocked / "__init__.py").write_text("raise ImportError\n")
    environment = dict(ros_environment, PYTHONPATH=f"{tmp_path}:{ros_environment.get('PYTHONPATH', '')}")
    command = [str(executables / "predictor"), "--ros-args", "-p", "terrain_source:=flat", "-r", "__ns:=/bare"]
    process = Process(command, tmp_path / "predictor.log", environment)
    try:
        process.wait_for(
            "/tf cannot be read: the package tf2_msgs is not installed (sudo apt install ros-jazzy-tf2-msgs"
        )
        feed = Feed(peer, "bare")
        assert feed.until(lambda: "the offset between them is unknown" in feed.status("odometry")[1], 20.0)
        assert "`make interfaces`" in feed.status("odometry")[1]
    finally:
        process.stop()
