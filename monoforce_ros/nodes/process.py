"""Start and end of a node's process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from monoforce_ros.nodes.arguments import (
    check_parameter_files,
    command_line,
    parameter_files,
    refuse_other_nodes,
    refuse_stray_arguments,
)
from monoforce_ros.nodes.parameter_files import read_sections
from monoforce_ros.nodes.parameters import parameter_help
from monoforce_ros.nodes.schema import read_schema, schema_path


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
        exit status: 0 after a regular end, 1 if the node could not start (its ``ValueError`` or ``OSError``, or an
        error in the command line, is printed as one line).
    """
    words = command_line(arguments)
    node: NodeType | None = None
    executor: SingleThreadedExecutor | None = None
    try:
        try:
            initialise(arguments)
            node = make_node()
            full_name = node.get_fully_qualified_name()
            refuse_other_nodes(words, full_name)
            warnings = check_parameter_files(words, full_name)
        except (ValueError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        if not rclpy.ok():
            return 0
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        for warning in warnings:
            node.get_logger().warning(warning)
        work(node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A signal shuts the context down at once; what the node, a callback or the executor does with it then fails.
        if rclpy.ok():
            raise
    finally:
        # The signal that ended the context may reach Python a moment later.
        for end in (executor and executor.shutdown, node and node.destroy_node, rclpy.try_shutdown):
            with suppress(KeyboardInterrupt):
                if end:
                    end()
    return 0


def run_schema_node[NodeType: Node](
    name: str, make_node: Callable[[], NodeType], arguments: list[str] | None = None
) -> int:
    """Run a node whose command line holds nothing but ROS arguments, or print its parameters for ``--help``.

    Args:
        name: name of the executable and of its schema.
        make_node: creates the node.
        arguments: arguments of the command line.

    Returns:
        exit status, as :func:`run_node`; 1 also for an argument that is not ROS's.
    """
    words, entries = command_line(arguments), read_schema(schema_path(name))
    if {"-h", "--help"} & set(words):
        print(parameter_help(name, entries))
        return 0
    try:
        refuse_stray_arguments(words, (entry.name for entry in entries))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return run_node(make_node, arguments)


def initialise(arguments: list[str] | None, signals: SignalHandlerOptions | None = None) -> None:
    """Initialise rclpy; what it cannot parse in the command line becomes a ``ValueError``."""
    for path in parameter_files(command_line(arguments)):
        read_sections(path)
    try:
        rclpy.init(args=arguments, signal_handler_options=signals)
    except RuntimeError as error:
        # rcl's messages end with the place in its source code.
        reason = str(error).partition(", at /")[0]
        raise ValueError(
            f"the ROS arguments cannot be read: {reason}; expected -p NAME:=VALUE or -r FROM:=TO after --ros-args"
        ) from error
