"""CommandOutput: publishes velocity commands in the message type that the base listens to."""

from __future__ import annotations

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from rclpy.publisher import Publisher

from monoforce_ros.nodes.subscriptions import other_listeners

STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
_CLASSES = {STAMPED: TwistStamped, PLAIN: Twist}
_CHOICES = {"twist_stamped": STAMPED, "twist": PLAIN}


class CommandOutput:
    """Publishes ``TwistStamped`` or ``Twist``.

    Fast DDS allows a process one type per topic. Where listeners expect both, ``Twist`` is published: nodes that adapt,
    as this package's do, start with ``TwistStamped``, so that a listener to ``Twist`` is one that needs it.

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
        self._listened: set[str] = set()
        self._timer = node.create_timer(0.5, self._update)
        self._update()

    @property
    def deaf(self) -> str:
        """Why no other node hears the commands; empty if one does."""
        if self.type in self._listened:
            return ""
        if self._listened:
            return f"{self.topic}: its listeners expect {', '.join(sorted(self._listened))}"
        return f"nothing listens to {self.topic}"

    def publish(self, speed: float, yaw_rate: float, frame_id: str) -> None:
        """Publish forward speed [m/s] and yaw rate [rad/s]."""
        if self._publisher is None:
            return
        twist = Twist()
        twist.linear.x, twist.angular.z = speed, yaw_rate
        if self.type == PLAIN:
            self._publisher.publish(twist)
            return
        message = TwistStamped(twist=twist)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = frame_id
        self._publisher.publish(message)

    def _update(self) -> None:
        self._listened = other_listeners(self._node, self.topic)
        # While nobody listens, the last type stays: a base that restarts asks for the same one.
        wanted = next((kind for kind in (PLAIN, STAMPED) if kind in self._listened), self.type or STAMPED)
        wanted = self._fixed or wanted
        if wanted == self.type:
            return
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
        self.type, self._publisher = "", None
        try:
            self._publisher = self._node.create_publisher(_CLASSES[wanted], self.topic, 10)
        except RuntimeError as error:
            # The middleware may still be removing the publisher of the other type: the next call tries again.
            self._node.get_logger().debug(f"{self.topic}: {error}")
            return
        self.type = wanted
