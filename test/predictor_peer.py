"""A ROS node of the tests that feeds a predictor in another process and collects its outputs."""

import time

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_peer import Peer

from monoforce_ros.bags import builders, type_store
from monoforce_ros.messages import message_class, stamp_of

OUTPUTS = {
    "/predicted/height_map": "nav_msgs/msg/GridCells",
    "/predicted/terrain": "sensor_msgs/msg/PointCloud2",
    "/predicted/path": "nav_msgs/msg/Path",
    "/predicted/contact_forces": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}

_LATE = 20_000_000_000
"""Largest age of the input data of a delayed output [ns]."""


class PredictorPeer(Peer):
    """Publishes messages of the bag builders and keeps the predictor's outputs."""

    def __init__(self, environment: dict[str, str]):
        variables = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")
        super().__init__("peer", {name: environment[name] for name in variables})
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

    def publish(self, topic: str, message) -> None:
        name = message.__msgtype__
        if topic not in self._publishers:
            quality = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)
            self._publishers[topic] = self.node.create_publisher(message_class(name), topic, quality)
        self._publishers[topic].publish(bytes(type_store().serialize_cdr(message, name)))

    def until(self, condition, seconds: float = 15.0) -> bool:
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self.spin_once(0.05)
        return True

    def _keep(self, topic: str, message) -> None:
        # Diagnostics carry the time of the node's clock, other outputs the stamp of their input data. Outputs with a
        # stamp that no recent input had, such as zero, are kept, so that tests can detect wrong stamps.
        if topic == "/diagnostics" or not self._since - _LATE <= stamp_in(message) < self._since:
            self.received[topic].append(message)

    def clear(self) -> None:
        """Forget all outputs; outputs of earlier data may still arrive."""
        self._since = 0
        for messages in self.received.values():
            messages.clear()

    def begin(self) -> None:
        """Forget all outputs, and from now on ignore outputs of data sent before."""
        self.clear()
        self._since = self.now

    def settle(self, seconds: float = 0.5) -> None:
        """Wait until no output has arrived for ``seconds``: a busy machine delays the last ones."""

        def count() -> int:
            return sum(len(messages) for topic, messages in self.received.items() if topic != "/diagnostics")

        for _ in range(20):
            before = count()
            self.spin(seconds)
            if count() == before:
                return
        raise AssertionError("predictions continue although nothing is sent")

    def stamps(self, topic: str) -> list[int]:
        return [stamp_in(message) for message in self.received[topic]]

    def status(self, part: str) -> tuple[int, str] | None:
        """Level and message of a part in the latest diagnostics."""
        for array in reversed(self.received["/diagnostics"]):
            for status in array.status:
                if status.name == f"predictor: {part}":
                    return int.from_bytes(status.level, "little"), status.message
        return None

    def drive(self, seconds: float, *, cloud=None, odometry=None, command=None, speed: float = 0.5) -> None:
        """Publish a drive along x in real time: odometry at 50 Hz, commands at 25 Hz, clouds at 5 Hz.

        ``cloud``, ``odometry`` and ``command`` take a stamp and return a message that replaces the default one, or None
        for no message.
        """
        cloud = cloud or (lambda stamp: builders.point_cloud(stamp, "lidar", ground_cloud()))
        odometry = odometry or (
            lambda stamp: builders.odometry(stamp, "odom", "base_link", [1.0, 2.0, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)
        )
        command = command or (lambda stamp: builders.twist_stamped(stamp, "base_link", speed, 0.0))
        begin, start = time.monotonic(), self.now
        for step in range(round(seconds * 50)):
            self.now = start + step * 20_000_000
            # As on a robot, the cloud has the stamp of its measurement and arrives before newer odometry.
            if step % 10 == 0 and (message := cloud(self.now)) is not None:
                self.publish("/points", message)
                self.clouds_sent.append(self.now)
            if (message := odometry(self.now)) is not None:
                self.publish("/odom", message)
            if step % 2 == 0 and (message := command(self.now)) is not None:
                self.publish("/cmd_vel", message)
            # At least one message is handled in each step, however late it is: else a busy machine hears nothing.
            self.spin_once(0.0)
            self.spin(max(0.0, begin + step * 0.02 - time.monotonic()))
        self.now += 20_000_000


def stamp_in(message) -> int:
    """Stamp [ns] of a message, or of its first marker."""
    return stamp_of(message.markers[0] if hasattr(message, "markers") else message)


def ground_cloud(seed: int = 0) -> np.ndarray:
    """Lidar points of level ground 0.13 m below base_link, from a lidar 0.65 m above base_link."""
    generator = np.random.default_rng(seed)
    radius, angle = generator.uniform(0.8, 8.0, 6000), generator.uniform(-np.pi, np.pi, 6000)
    ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6000, -0.1323 - 0.65)], axis=1)
    return ground.astype(np.float32)
