"""CommandOutput: publishes velocity commands in the message type that the base listens to."""

from __future__ import annotations

from collections.abc import Sequence

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration, Infinite
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import LivelinessPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.subscriptions import full_name

STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
_CLASSES = {STAMPED: TwistStamped, PLAIN: Twist}
_CHOICES = {"twist_stamped": STAMPED, "twist": PLAIN}
_QUALITY = QoSProfile(
    depth=10, deadline=Infinite, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Infinite
)
"""Reliable and volatile: a base that starts later must not receive an old command. The rest are the defaults, as the
ROS graph shows them; unstated, they could not be compared."""
_WATCHERS = ("bag_recorder", "rosbag2_recorder", "_ros2cli_", "foxglove_bridge", "rosbridge_websocket", "rqt_gui_")
"""Beginnings of the names of nodes that only watch: recorders, ``ros2 topic echo``, bridges to viewers."""
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""What ROS calls a node that is no ROS node, or whose name it has not received yet."""


class CommandOutput:
    """Publishes ``TwistStamped`` or ``Twist``.

    Fast DDS allows a process one type per topic. Where listeners expect both, ``Twist`` is published: nodes that adapt,
    as this package's do, start with ``TwistStamped``, so that a listener to ``Twist`` is one that needs it.

    Predictors and bag recorders listen to commands, too, but move nothing: they do not count as listeners.

    Args:
        node: the node that publishes.
        topic: name of the topic.
        kind: ``twist``, ``twist_stamped``, or ``auto``: what other nodes listen to, checked twice a second.
    """

    def __init__(self, node: Node, topic: str, kind: str):
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._fixed = _CHOICES.get(kind, "")
        self.type = ""
        """Message type that is published; empty while it changes."""
        self._publisher: Publisher | None = None
        self._moves = False
        """Whether the last command was to move."""
        self._leaving = False
        """Whether listeners of the present type are being stopped, for another type comes next."""
        # Fully qualified node names with the types that they expect.
        self._listened: set[tuple[str, str]] = set()
        self._bystanders: list[str] = []
        # Fully qualified names of listeners that this publisher's quality of service does not reach, with the reason.
        self._unreached: dict[str, str] = {}
        self._rivals: set[str] = set()
        self._reported = ""
        self._timer = node.create_timer(0.5, self._update, clock=STEADY)
        self._update()

    @property
    def deaf(self) -> str:
        """Why no other node hears the commands; empty if one does."""
        kinds = {kind for _, kind in self._listened}
        if self.type in kinds:
            return ""
        if kinds:
            expected, names = ", ".join(sorted(kinds)), ", ".join(sorted({name for name, _ in self._listened}))
            return f"{self.topic}: its listeners expect {expected} ({names})"
        if self._unreached:
            causes = "; ".join(f"{name}: {reason}" for name, reason in sorted(self._unreached.items()))
            return f"{self.topic}: its listener asks for a quality of service that is not offered ({causes})"
        only = f" but {', '.join(self._bystanders)}, which cannot move the robot" if self._bystanders else ""
        return f"nothing listens to {self.topic}{only}"

    @property
    def listeners(self) -> str:
        """Fully qualified names of the nodes that hear the commands, other than those that only watch."""
        return ", ".join(sorted({name for name, kind in self._listened if kind == self.type})) or "no node"

    @property
    def unreached(self) -> str:
        """Nodes that listen on the topic and do not hear the commands, with the reason."""
        other = {name: f"expects {kind}" for name, kind in self._listened if kind != self.type}
        return "; ".join(f"{name}: {reason}" for name, reason in sorted((other | self._unreached).items()))

    @property
    def rivals(self) -> str:
        """Fully qualified names of the other nodes that publish on the topic."""
        return ", ".join(sorted(self._rivals))

    def publish(self, command: Sequence[float], frame_id: str) -> None:
        """Publish forward speed [m/s], yaw rate [rad/s] and, if there are three, the speed to the left [m/s].

        Shortly before the type changes, it is a stop whatever is given.
        """
        if self._publisher is None:
            return
        if self._leaving:
            command = (0.0, 0.0)
        self._moves = any(command)
        twist = Twist()
        twist.linear.x, twist.angular.z = command[:2]
        if len(command) > 2:
            twist.linear.y = command[2]
        if self.type == PLAIN:
            self._publisher.publish(twist)
            return
        message = TwistStamped(twist=twist)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = frame_id
        self._publisher.publish(message)

    def flush(self, seconds: float) -> None:
        """Wait until reliable listeners have received everything, at most ``seconds``."""
        if self._publisher is not None:
            self._publisher.wait_for_all_acked(Duration(seconds=seconds))

    def _update(self) -> None:
        self._listened, self._unreached, bystanders = set(), {}, set()
        own = self._node.get_fully_qualified_name()
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        self._rivals = {full_name(info) for info in publishers if info.node_name != _UNKNOWN} - {own}
        for info in self._node.get_subscriptions_info_by_topic(self.topic):
            unnamed = info.node_name == _UNKNOWN
            name = "a node without a name" if unnamed else full_name(info)
            if name == own:
                continue
            compatible, reason = qos_check_compatible(_QUALITY, info.qos_profile)
            if not unnamed and self._is_bystander(info.node_name, info.node_namespace):
                bystanders.add(name)
            elif compatible == QoSCompatibility.ERROR:
                self._unreached[name] = reason.replace("ERROR: ", " ").strip(" ;")
            else:
                self._listened.add((name, info.topic_type))
        self._bystanders = sorted(bystanders)
        self._report_unreached()
        expected = {kind for _, kind in self._listened}
        # While nobody listens, the last type stays: a base that restarts asks for the same one.
        wanted = next((kind for kind in (PLAIN, STAMPED) if kind in expected), self.type or STAMPED)
        wanted = self._fixed or wanted
        if wanted == self.type:
            self._leaving = False
            return
        if self._publisher is not None:
            if self._stops_first():
                return
            self._report_change(wanted)
            self.flush(0.2)
            self._node.destroy_publisher(self._publisher)
        self.type, self._publisher = "", None
        try:
            self._publisher = self._node.create_publisher(_CLASSES[wanted], self.topic, _QUALITY)
        except RuntimeError as error:
            # The middleware may still be removing the publisher of the other type: the next call tries again.
            self._node.get_logger().debug(f"{self.topic}: {error}")
            return
        self.type = wanted

    def _report_unreached(self) -> None:
        """Warn of nodes that do not hear the commands while others do: one of them may be the base."""
        hears = any(kind == self.type for _, kind in self._listened)
        if hears and (text := self.unreached) and text != self._reported:
            advice = "if one of these is the base, set `command_type`, or its subscription's quality of service"
            self._node.get_logger().warning(f"{self.topic} is heard by {self.listeners}, but not by {text}: {advice}")
        self._reported = self.unreached if hears else ""

    def _stops_first(self) -> bool:
        """Whether a base that the present type moves must be stopped before another is published.

        It may hold its last command. One that listens with best effort acknowledges nothing, and what this process
        still holds when the publisher is destroyed is lost: stops are published until the next call.
        """
        self._leaving = self._moves
        if self._leaving:
            self.publish((0.0, 0.0), "")
        return self._leaving

    def _report_change(self, wanted: str) -> None:
        """Warn of nodes that hear the present type: from now on another one is published."""
        if hearing := ", ".join(sorted(name for name, kind in self._listened if kind == self.type)):
            self._node.get_logger().warning(
                f"{self.topic}: from now on {wanted} is published, for a node listens to it; {hearing} expects "
                f"{self.type} and no longer hears the commands: set `command_type` to choose"
            )

    def _is_bystander(self, name: str, namespace: str) -> bool:
        """Whether a node listens to commands only to predict or to record.

        A predictor may have any name: what it publishes shows what it is.
        """
        if name.startswith(_WATCHERS):
            return True
        try:
            published = self._node.get_publisher_names_and_types_by_node(name, namespace)
        except NodeNameNonExistentError:
            # It has just ended.
            return False
        # Some of its topics may be remapped; candidates alone may also come from a node that drives the base.
        outputs = {topic.rpartition("/predicted/")[2] for topic, _ in published if "/predicted/" in topic}
        return len(outputs) > 1 or "path" in outputs
