"""TransformListener: the transforms on /tf and /tf_static, without waiting for any."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from monoforce_ros.core import FrameError, TransformHistory, TransformTree
from monoforce_ros.messages import MessageError, decoding, message_class, missing_package

TRANSFORMS = "tf2_msgs/msg/TFMessage"
TRANSFORMS_PATIENCE = 2.0
"""Time after the first odometry in which a missing transform is no error [s]: /tf_static takes as long to be
discovered."""


class TransformListener:
    """Keeps the newest transform of every frame on ``/tf`` and ``/tf_static``.

    tf2's own listener needs tf2_ros; the newest transforms suffice for frames fixed on the robot and for slowly
    corrected ones such as ``map`` to ``odom``. Without the package tf2_msgs there are none.

    Args:
        node: the node that subscribes; its executor calls the listener. Remappings such as ``/tf:=tf`` apply.
        history: also keeps earlier transforms here, for transforms at a stamp.
    """

    def __init__(self, node: Node, history: TransformHistory | None = None):
        self.tree = TransformTree()
        self._history = history
        self._node = node
        # Steady time of the last arrival [s] of transforms that are not static.
        self._arrivals: dict[tuple[str, str], float] = {}
        kind = message_class(TRANSFORMS)
        self.unavailable = "" if kind is not None else f"/tf cannot be read: {missing_package(TRANSFORMS)}"
        """Why no transforms can be received; empty where they can."""
        if kind is None:
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscriptions = (
            node.create_subscription(kind, "/tf", self._on_transforms, QoSProfile(depth=100)),
            node.create_subscription(kind, "/tf_static", self._on_static_transforms, latched),
        )

    def explained(self, error: FrameError) -> str:
        """An error about frames, and that transforms cannot be received if that is the reason."""
        return f"{error}. {self.unavailable}" if self.unavailable else str(error)

    def silence(self, target: str, source: str) -> tuple[str, float]:
        """The transform between two frames that has been silent the longest, in words, and for how long [s].

        Static transforms are never silent; without others it is an empty text and 0 s.
        """
        path = [edge for edge in self.tree.path(target, source) if edge in self._arrivals]
        if not path:
            return "", 0.0
        parent, child = min(path, key=lambda edge: self._arrivals[edge])
        return f"{parent} → {child}", time.monotonic() - self._arrivals[parent, child]

    def _on_static_transforms(self, message: Any) -> None:
        self._on_transforms(message, static=True)

    def _on_transforms(self, message: Any, *, static: bool = False) -> None:
        try:
            found = decoding.decode_transforms(message)
        except MessageError as error:
            self._node.get_logger().warning(f"/tf: {error}", throttle_duration_sec=10.0)
            return
        if len(found) < len({(entry.header.frame_id, entry.child_frame_id) for entry in message.transforms}):
            text = "/tf: a transform is not finite, or its quaternion is zero; it is left out"
            self._node.get_logger().warning(text, throttle_duration_sec=10.0)
        for (parent, child), matrix in found.items():
            self.tree.add(parent, child, matrix)
            edge = parent.lstrip("/"), child.lstrip("/")
            if static:
                self._arrivals.pop(edge, None)
            else:
                self._arrivals[edge] = time.monotonic()
        if self._history is None:
            return
        for entry in message.transforms:
            frames = entry.header.frame_id.lstrip("/"), entry.child_frame_id.lstrip("/")
            if frames in found:
                self._history.add(*frames, found[frames], None if static else decoding.stamp_of(entry))
