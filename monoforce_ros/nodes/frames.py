"""TransformListener: the transforms on /tf and /tf_static, without waiting for any."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from monoforce_ros.core import TransformTree
from monoforce_ros.messages import MessageError, decoding, message_class

TRANSFORMS = "tf2_msgs/msg/TFMessage"


class TransformListener:
    """Keeps the newest transform of every frame on ``/tf`` and ``/tf_static``.

    tf2's own listener keeps a history and needs tf2_ros; the newest transforms suffice for frames fixed on the robot
    and for slowly corrected ones such as ``map`` to ``odom``. Without the package tf2_msgs there are none.

    Args:
        node: the node that subscribes; its executor calls the listener. Remappings such as ``/tf:=tf`` apply.
    """

    def __init__(self, node: Node):
        self.tree = TransformTree()
        self._node = node
        kind = message_class(TRANSFORMS)
        self.available = kind is not None
        """Whether transforms can be received at all."""
        if kind is None:
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscriptions = (
            node.create_subscription(kind, "/tf", self._on_transforms, QoSProfile(depth=100)),
            node.create_subscription(kind, "/tf_static", self._on_transforms, latched),
        )

    def _on_transforms(self, message: Any) -> None:
        try:
            found = decoding.decode_transforms(message)
        except MessageError as error:
            self._node.get_logger().warning(f"/tf: {error}", throttle_duration_sec=10.0)
            return
        for (parent, child), matrix in found.items():
            self.tree.add(parent, child, matrix)
