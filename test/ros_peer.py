"""A ROS node of the tests: feeds a predictor in another process and collects what it publishes."""

import os
import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from monoforce_ros.bags import builders
from monoforce_ros.bags.types import type_store
from monoforce_ros.messages.decoding import stamp_of
from monoforce_ros.messages.message_types import message_class

OUTPUTS = {
    "/predicted/height_map": "nav_msgs/msg/GridCells",
    "/predicted/terrain": "sensor_msgs/msg/PointCloud2",
    "/predicted/path": "nav_msgs/msg/Path",
    "/predicted/contact_forces": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


_LATE = 20_000_000_000
"""How long ago the data of an output that comes late may have been sent [ns]."""


class Peer:
    """Publishes messages of the bag builders and keeps what comes back."""

    def __init__(self, environment: dict[str, str]):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = environment["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node("peer", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received: dict[str, list] = {topic: [] for topic in OUTPUTS}
        quality = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        for topic, name in OUTPUTS.items():
            kind = message_class(name)
            self.node.create_subscription(
                kind,
                topic,
                lambda data, topic=topic, kind=kind: self._keep(topic, deserialize_message(data, kind)),
                quality,
                raw=True,
            )
        self._publishers: dict[str, object] = {}
        self._since = 0
        self.now = 1_700_000_000_000_000_000
        self.clouds_sent: list[int] = []

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def publish(self, topic: str, message) -> None:
        name = message.__msgtype__
        if topic not in self._publishers:
            quality = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)
            self._publishers[topic] = self.node.create_publisher(message_class(name), topic, quality)
        self._publishers[topic].publish(bytes(type_store().serialize_cdr(message, name)))

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.executor.spin_once(timeout_sec=left)

    def until(self, condition, seconds: float = 15.0) -> bool:
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(timeout_sec=0.05)
        return True

    def _keep(self, topic: str, message) -> None:
        # Diagnostics are stamped by the node's own clock, everything else by the data it was made from. A stamp that
        # no data had lately, as zero, is kept: it is wrong, and tests look for that.
        if topic == "/diagnostics" or not self._since - _LATE <= stamp_in(message) < self._since:
            self.received[topic].append(message)

    def clear(self) -> None:
        """Forget what has come; what was made from data sent before may still come."""
        self._since = 0
        for messages in self.received.values():
            messages.clear()

    def begin(self) -> None:
        """Forget what has come, and from now on drop every output made from data sent before."""
        self.clear()
        self._since = self.now

    def settle(self, seconds: float = 0.5) -> None:
        """Wait until no prediction has come for a while: a busy machine makes the last ones late."""

        def heard() -> int:
            return sum(len(messages) for topic, messages in self.received.items() if topic != "/diagnostics")

        for _ in range(20):
            before = heard()
            self.spin(seconds)
            if heard() == before:
                return
        raise AssertionError("predictions do not cease although nothing is sent")

    def stamps(self, topic: str) -> list[int]:
        return [stamp_in(message) for message in self.received[topic]]

    def status(self, part: str) -> tuple[int, str] | None:
        """Level and text that the last diagnostics give for a part."""
        for array in reversed(self.received["/diagnostics"]):
            for status in array.status:
                if status.name == f"predictor: {part}":
                    return int.from_bytes(status.level, "little"), status.message
        return None

    def drive(self, seconds: float, *, cloud=None, odometry=None, command=None, speed: float = 0.5) -> None:
        """Feed a drive along x in real time: odometry at 50 Hz, commands at 20 Hz, a cloud at 5 Hz.

        ``cloud``, ``odometry`` and ``command`` take a stamp and return another message in place of the healthy one, or
        None to keep silent.
        """
        cloud = cloud or (lambda stamp: builders.point_cloud(stamp, "lidar", ground_cloud()))
        odometry = odometry or (
            lambda stamp: builders.odometry(stamp, "odom", "base_link", [1.0, 2.0, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)
        )
        command = command or (lambda stamp: builders.twist_stamped(stamp, "base_link", speed, 0.0))
        begin, start = time.monotonic(), self.now
        for step in range(round(seconds * 50)):
            self.now = start + step * 20_000_000
            # Like a robot's drivers: the cloud is stamped when it was taken and arrives before newer odometry.
            if step % 10 == 0 and (message := cloud(self.now)) is not None:
                self.publish("/points", message)
                self.clouds_sent.append(self.now)
            if (message := odometry(self.now)) is not None:
                self.publish("/odom", message)
            if step % 2 == 0 and (message := command(self.now)) is not None:
                self.publish("/cmd_vel", message)
            self.spin(max(0.0, begin + step * 0.02 - time.monotonic()))
        self.now += 20_000_000


def stamp_in(message) -> int:
    """Stamp of a message that has one, or whose first marker has [ns]."""
    return stamp_of(message.markers[0] if hasattr(message, "markers") else message)


def ground_cloud(seed: int = 0) -> np.ndarray:
    """Returns of level ground 0.13 m below base_link, seen by a lidar 0.65 m above it."""
    generator = np.random.default_rng(seed)
    radius, angle = generator.uniform(0.8, 8.0, 6000), generator.uniform(-np.pi, np.pi, 6000)
    ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6000, -0.1323 - 0.65)], axis=1)
    return ground.astype(np.float32)
