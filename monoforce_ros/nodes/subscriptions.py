"""Subscriptions whose message type is told by what is published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo


class AdaptiveSubscription:
    """Subscribes to a topic as soon as someone publishes one of several message types on it.

    Robots publish ``Twist`` or ``TwistStamped``, ``Image`` or ``CompressedImage``, under whatever name; asking the
    graph saves users a parameter that they would get wrong. The graph is asked twice a second until a publisher shows,
    and again when the publishers' type or quality has changed.

    Args:
        node: the node that subscribes.
        topic: name of the topic, resolved as ROS does.
        types: message classes by type name, the preferred ones first.
        callback: takes each message.
        depth: length of the queue.
        reliability: ``reliable``, ``best_effort``, or ``auto``: reliable where every publisher offers it, since large
            best-effort messages get lost easily, else best effort, which works with every publisher.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        types: dict[str, type],
        callback: Callable[[Any], None],
        *,
        depth: int,
        reliability: str = "auto",
    ):
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._types = types
        self._callback = callback
        self._depth = depth
        self._reliability = reliability
        self._subscription = None
        self._subscribed: tuple[str, ReliabilityPolicy] | None = None
        self.wrong_type = ""
        self._timer = node.create_timer(0.5, self._look)
        self._look()

    @property
    def publishers(self) -> int:
        """How many publishers the topic has now."""
        return self._node.count_publishers(self.topic)

    def _look(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        offered = {info.topic_type for info in publishers}
        usable = [name for name in self._types if name in offered]
        self.wrong_type = "" if usable or not offered else ", ".join(sorted(offered))
        if not usable:
            return
        wanted = usable[0], self._choose(publishers)
        if self._subscribed == wanted:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscribed = wanted
        quality = QoSProfile(depth=self._depth, reliability=wanted[1], durability=DurabilityPolicy.VOLATILE)
        self._subscription = self._node.create_subscription(self._types[wanted[0]], self.topic, self._callback, quality)

    def _choose(self, publishers: list[TopicEndpointInfo]) -> ReliabilityPolicy:
        if self._reliability == "auto":
            reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
        else:
            reliable = self._reliability == "reliable"
        return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
