"""Start and end of a node's process."""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def _spin(node: Node, executor: SingleThreadedExecutor) -> None:
    executor.spin()


def run_node[NodeType: Node](
    make_node: Callable[[], NodeType],
    arguments: list[str] | None = None,
    work: Callable[[NodeType, SingleThreadedExecutor], None] = _spin,
) -> int:
    """Spin a node until SIGINT or SIGTERM.

    Args:
        make_node: creates the node; called after rclpy is initialised.
        arguments: arguments of the command line.
        work: spins the node; the default only processes callbacks.

    Returns:
        exit status: 0 after a regular end, 1 if the node could not start (its ``ValueError`` or ``OSError`` is
        printed as one line).
    """
    rclpy.init(args=arguments)
    try:
        node = make_node()
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        work(node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A signal shuts the context down at once; a callback or the executor that uses it afterwards fails.
        if rclpy.ok():
            raise
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
