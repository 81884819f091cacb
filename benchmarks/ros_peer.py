"""A benchmark's own ROS node, beside the installed executables that it measures."""

from __future__ import annotations

import os
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor


class Peer:
    """A node that hears and says; one thread.

    Args:
        name: of the node.
        environment: variables that put it into the ROS domain of what it talks to.
    """

    def __init__(self, name: str, environment: dict[str, str]):
        os.environ |= environment
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def spin_once(self, seconds: float) -> None:
        """Wait so long at the most for one message."""
        self._executor.spin_once(timeout_sec=seconds)

    def spin(self, seconds: float) -> None:
        """Listen for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(0.1, left))

    def close(self) -> None:
        """End the node."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
