"""FlipperOutput: passes the best candidate's flipper angles on to the flippers' controllers."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

TOPIC = "predicted/flipper_angles"


class FlipperOutput:
    """Forwards :data:`TOPIC` of the predictor to a topic of commands, if there is one.

    Args:
        node: node that subscribes and publishes.
        topic: topic of the commands; the empty string forwards nothing.
        timeout: time after which angles are too old [s].
    """

    def __init__(self, node: Node, topic: str, timeout: float):
        self._timeout, self._arrival = timeout, 0.0
        self._newest: JointState | None = None
        self._publisher = None
        if topic:
            self._publisher = node.create_publisher(JointState, topic, 1)
            self._subscription = node.create_subscription(JointState, TOPIC, self._on_angles, 1)

    def _on_angles(self, message: JointState) -> None:
        usable = message.name and len(message.name) == len(message.position) and np.isfinite(message.position).all()
        self._newest = message if usable else None
        self._arrival = time.monotonic()

    def forward(self) -> None:
        """Publish the newest angles, unless they are too old. Called only while the robot is driven."""
        if self._publisher is None or self._newest is None or time.monotonic() - self._arrival > self._timeout:
            return
        self._publisher.publish(self._newest)
