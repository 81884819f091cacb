"""Subscriptions whose message type is told by what is published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile


class AdaptiveSubscription:
    """Subscribes to a topic as soon as someone publishes one of several message types on it.

    Robots publish ``Twist`` or ``TwistStamped``, ``Image`` or ``CompressedImage``, under whatever name; asking the
    graph saves users a parameter that they would get wrong. The graph is asked twice a second until a publisher shows,
    and again when the publishers' type has changed.
    """

    def __init__(
        self, node: Node, topic: str, types: dict[str, type], callback: Callable[[Any], None], qos: QoSProfile
    ):
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._types = types
        self._callback = callback
        self._qos = qos
        self._subscription = None
        self._subscribed_type = ""
        self.wrong_type = ""
        self._timer = node.create_timer(0.5, self._look)
        self._look()

    @property
    def publishers(self) -> int:
        """How many publishers the topic has now."""
        return self._node.count_publishers(self.topic)

    def _look(self) -> None:
        offered = {info.topic_type for info in self._node.get_publishers_info_by_topic(self.topic)}
        usable = [name for name in self._types if name in offered]
        self.wrong_type = "" if usable or not offered else ", ".join(sorted(offered))
        if not usable or self._subscribed_type in usable:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscribed_type = usable[0]
        self._subscription = self._node.create_subscription(
            self._types[usable[0]], self.topic, self._callback, self._qos
        )
