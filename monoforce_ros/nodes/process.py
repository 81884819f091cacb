"""Starting and ending a node's process."""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def run_node(
    make_node: Callable[[], Node],
    arguments: list[str] | None = None,
    work: Callable[[Node, SingleThreadedExecutor], None] = lambda node, executor: executor.spin(),
) -> int:
    """Spin a node until SIGINT or SIGTERM.

    Args:
        make_node: makes it, once ROS is there.
        arguments: of the command line.
        work: spins it, where it has more to do than to wait for callbacks.

    Returns:
        exit status: 0 after an ordinary end, 1 where the node could not start (its ``ValueError`` or ``OSError`` is
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
        # A signal ends the context at once; what a callback or the executor asks of it after that fails.
        if rclpy.ok():
            raise
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
