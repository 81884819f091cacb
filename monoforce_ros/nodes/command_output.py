"""CommandOutput: publishes velocity commands in the message type that the base listens to."""

from __future__ import annotations

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from rclpy.publisher import Publisher

from monoforce_ros.nodes.subscriptions import other_listeners

STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
_CLASSES = {STAMPED: TwistStamped, PLAIN: Twist}
_CHOICES = {"twist_stamped": (STAMPED,), "twist": (PLAIN,)}


class CommandOutput:
    """Publishes ``TwistStamped``, ``Twist``, or both if different nodes listen to different ones.

    Args:
        node: the node that publishes.
        topic: name of the topic.
        kind: ``twist``, ``twist_stamped``, or ``auto``: what other nodes listen to, checked twice a second.
    """

    def __init__(self, node: Node, topic: str, kind: str):
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._fixed = _CHOICES.get(kind, ())
        self._publishers: dict[str, Publisher] = {}
        self._listened: set[str] = set()
        self._timer = node.create_timer(0.5, self._update)
        self._update()

    @property
    def types(self) -> tuple[str, ...]:
        """Message types that are published."""
        return tuple(self._publishers)

    @property
    def deaf(self) -> str:
        """Why no other node hears the commands; empty if one does."""
        if self._listened & set(self._publishers):
            return ""
        if self._listened:
            return f"{self.topic}: its listeners expect {', '.join(sorted(self._listened))}"
        return f"nothing listens to {self.topic}"

    def publish(self, speed: float, yaw_rate: float, frame_id: str) -> None:
        """Publish forward speed [m/s] and yaw rate [rad/s]."""
        twist = Twist()
        twist.linear.x, twist.angular.z = speed, yaw_rate
        for kind, publisher in self._publishers.items():
            if kind == PLAIN:
                publisher.publish(twist)
                continue
            message = TwistStamped(twist=twist)
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.header.frame_id = frame_id
            publisher.publish(message)

    def _update(self) -> None:
        self._listened = other_listeners(self._node, self.topic)
        wanted = self._fixed or tuple(kind for kind in _CLASSES if kind in self._listened)
        # While nobody listens, the last type stays: a base that restarts asks for the same one.
        wanted = wanted or self.types or (STAMPED,)
        for kind in set(self._publishers) - set(wanted):
            self._node.destroy_publisher(self._publishers.pop(kind))
        for kind in wanted:
            if kind not in self._publishers:
                self._publishers[kind] = self._node.create_publisher(_CLASSES[kind], self.topic, 10)
