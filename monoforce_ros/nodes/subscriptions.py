"""Subscriptions that detect the message type of their topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo


class AdaptiveSubscription:
    """Subscribes to a topic as soon as one of several message types is published on it.

    Robots publish ``Twist`` or ``TwistStamped``, ``Image`` or ``CompressedImage``, under any name; detecting the type
    saves users a parameter. The ROS graph is queried twice a second, so that a change of the publishers' type or
    reliability is followed.

    Args:
        node: the node that subscribes.
        topic: name of the topic, resolved as ROS does.
        types: message classes by type name, in order of preference.
        callback: called with each message.
        depth: depth of the queue.
        reliability: ``reliable``, ``best_effort``, or ``auto``: reliable if every publisher offers it, as large
            best-effort messages are easily lost, otherwise best effort, which works with every publisher.
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
        self._subscription: Subscription | None = None
        self._subscribed: tuple[str, ReliabilityPolicy] | None = None
        self.wrong_type = ""
        """Types on the topic if none of them is usable."""
        self._timer = node.create_timer(0.5, self._update)
        self._update()

    @property
    def publishers(self) -> int:
        """Number of publishers on the topic."""
        return self._node.count_publishers(self.topic)

    def _update(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        offered = {info.topic_type for info in publishers}
        usable = [name for name in self._types if name in offered]
        self.wrong_type = "" if usable or not offered else ", ".join(sorted(offered))
        if not usable:
            return
        wanted = usable[0], self._select_reliability(publishers)
        if self._subscribed == wanted:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscribed = wanted
        quality = QoSProfile(depth=self._depth, reliability=wanted[1], durability=DurabilityPolicy.VOLATILE)
        self._subscription = self._node.create_subscription(self._types[wanted[0]], self.topic, self._callback, quality)

    def _select_reliability(self, publishers: list[TopicEndpointInfo]) -> ReliabilityPolicy:
        if self._reliability == "auto":
            reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
        else:
            reliable = self._reliability == "reliable"
        return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
