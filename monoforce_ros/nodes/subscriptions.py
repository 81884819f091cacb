"""Subscriptions that follow the message type, reliability and durability of their topic's publishers."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from monoforce_ros.nodes.clocks import STEADY


def command_types(*, steering_angles: bool) -> dict[str, type]:
    """Message classes of velocity commands by type name, in order of preference.

    Args:
        steering_angles: also ``AckermannDriveStamped``, where its package is installed.
    """
    types: dict[str, type] = {"geometry_msgs/msg/TwistStamped": TwistStamped, "geometry_msgs/msg/Twist": Twist}
    if steering_angles:
        try:
            ackermann = importlib.import_module("ackermann_msgs.msg")
        except ImportError:
            return types
        types["ackermann_msgs/msg/AckermannDriveStamped"] = ackermann.AckermannDriveStamped
    return types


@dataclass(frozen=True)
class _Offer:
    """What a subscription asks for."""

    type: str
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy


class AdaptiveSubscription:
    """Subscribes at once, and again as soon as publishers turn out to offer another type or quality of service.

    Robots publish ``Twist`` or ``TwistStamped``, ``Image`` or ``CompressedImage``, under any name; detecting the type
    saves users a parameter. The ROS graph is queried twice a second, so that a change of the publishers' type,
    reliability or durability is followed.

    Args:
        node: the node that subscribes.
        topic: name of the topic, resolved as ROS does.
        types: message classes by type name, in order of preference.
        callback: called with each message.
        depth: depth of the queue.
        reliability: ``reliable``, ``best_effort``, or ``auto``: reliable if every publisher offers it, as large
            best-effort messages are easily lost, otherwise best effort, which works with every publisher.
        follow_listeners: of several possible types, take the one that other nodes listen to. For commands: a base that
            listens to one type shows which one is meant.
        raw: whether the callback gets serialised messages.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        types: Mapping[str, type],
        callback: Callable[[Any], None],
        *,
        depth: int,
        reliability: str = "auto",
        follow_listeners: bool = False,
        raw: bool = False,
    ):
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        self._types = types
        self._callback = callback
        self._depth = depth
        self._reliability = reliability
        self._follow_listeners = follow_listeners
        self._raw = raw
        self._subscription: Subscription | None = None
        self._subscribed: _Offer | None = None
        self.wrong_type = ""
        """Types on the topic if none of them is usable."""
        self.publisher_names: tuple[str, ...] = ()
        """Fully qualified name of the node of each publisher on the topic, half a second ago at the latest."""
        self._timer = node.create_timer(0.5, self._update, clock=STEADY)
        self._update()

    @property
    def publishers(self) -> int:
        """Number of publishers on the topic."""
        return self._node.count_publishers(self.topic)

    @property
    def latched(self) -> bool:
        """Whether the subscription asks for the last message that was sent before it."""
        return self._subscribed is not None and self._subscribed.durability == DurabilityPolicy.TRANSIENT_LOCAL

    @property
    def silence_cause(self) -> str:
        """Why there are no messages, as far as the ROS graph shows."""
        if self.wrong_type:
            return f"{self.topic} has the unsupported type {self.wrong_type}"
        if not (count := self.publishers):
            return f"{self.topic}: no publisher"
        return f"{self.topic}: {count} publisher{'s' if count > 1 else ''}, no messages"

    def _update(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        self.publisher_names = tuple(sorted(full_name(info) for info in publishers))
        offered = {info.topic_type for info in publishers}
        usable = [name for name in self._types if name in offered]
        self.wrong_type = "" if usable or not offered else ", ".join(sorted(offered))
        if self.wrong_type:
            return
        wanted = _Offer(self._select_type(usable), self._select_reliability(publishers), _durability(publishers))
        if not publishers and self._subscribed is not None:
            # A publisher that is gone may come back: nothing but its type can have changed.
            wanted = _Offer(wanted.type, self._subscribed.reliability, self._subscribed.durability)
        if self._subscribed == wanted:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribed = None
        quality = QoSProfile(depth=self._depth, reliability=wanted.reliability, durability=wanted.durability)
        try:
            self._subscription = self._node.create_subscription(
                self._types[wanted.type], self.topic, self._callback, quality, raw=self._raw
            )
        except RuntimeError as error:
            # A process has one type per topic, and the middleware may still be removing the former subscription: the
            # next call tries again.
            self._node.get_logger().debug(f"{self.topic}: {error}")
            return
        self._subscribed = wanted

    def _select_type(self, offered: list[str]) -> str:
        """The type to subscribe to, of those that publishers offer, or of all if there are none."""
        possible = offered or ([self._subscribed.type] if self._subscribed else list(self._types))
        if not self._follow_listeners:
            return possible[0]
        possible = offered or list(self._types)
        listened = other_listeners(self._node, self.topic)
        wanted = [name for name in possible if name in listened]
        # Nodes that adapt, as this one does, start with the first type: a listener to the last one chose it.
        return wanted[-1] if wanted else possible[0]

    def _select_reliability(self, publishers: list[TopicEndpointInfo]) -> ReliabilityPolicy:
        if self._reliability == "auto":
            # Before there are publishers, best effort receives from each that may come.
            reliable = bool(publishers) and all(
                p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers
            )
        else:
            reliable = self._reliability == "reliable"
        return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def _durability(publishers: list[TopicEndpointInfo]) -> DurabilityPolicy:
    """Transient local if every publisher offers it, for the last message sent before the subscription."""
    latched = bool(publishers) and all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE


def full_name(info: TopicEndpointInfo) -> str:
    """Fully qualified name of an endpoint's node."""
    return f"{info.node_namespace}/{info.node_name}".replace("//", "/")


def other_listeners(node: Node, topic: str) -> set[str]:
    """Message types that other nodes subscribe to on a topic."""
    own = node.get_name(), node.get_namespace()
    return {
        info.topic_type
        for info in node.get_subscriptions_info_by_topic(topic)
        if (info.node_name, info.node_namespace) != own
    }
