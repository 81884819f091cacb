"""Start and end of a node's process."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from monoforce_ros.nodes.arguments import (
    check_parameter_files,
    command_line,
    idle_remappings,
    parameter_files,
    refuse_given_parameters,
    refuse_other_nodes,
    refuse_stray_arguments,
)
from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.parameter_files import read_sections
from monoforce_ros.nodes.parameters import parameter_help
from monoforce_ros.nodes.schema import read_schema, schema_path

_LONGEST_WAIT = 0.1
"""Time after which a signal is noticed at the latest while no callback runs [s]."""
_SET_UP = 2.0
"""Time after which a node has all its topics [s]: the simulator adds one with each first message."""


class Signals:
    """SIGINT and SIGTERM of this process, instead of rclpy's own handling of them.

    rclpy lets Python raise ``KeyboardInterrupt`` wherever it is. Inside its C++ part, which takes a message or waits,
    that becomes a ``RuntimeError`` or a segmentation fault. Here a node at work only learns that it shall end, between
    two callbacks.
    """

    def __init__(self) -> None:
        self.received = False
        self._deferred = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # While a node starts, and for those who cannot wait: at once.
        at_once = self.received or not self._deferred
        self.received = True
        if at_once:
            raise KeyboardInterrupt

    def defer(self) -> None:
        """From now on the first signal is only noted."""
        self._deferred = True

    @property
    def running(self) -> bool:
        """Whether neither a signal nor anything else has ended the node."""
        return rclpy.ok() and not self.received

    def spin(self, executor: SingleThreadedExecutor) -> None:
        """Process callbacks until a signal comes."""
        self.defer()
        while self.running:
            executor.spin_once(timeout_sec=_LONGEST_WAIT)


def run_node[NodeType: Node](
    make_node: Callable[[], NodeType],
    arguments: list[str] | None = None,
    work: Callable[[NodeType, SingleThreadedExecutor, Signals], None] | None = None,
    *,
    at_the_end: Callable[[NodeType], None] | None = None,
) -> int:
    """Spin a node until SIGINT or SIGTERM.

    Args:
        make_node: creates the node; called after rclpy is initialised.
        arguments: arguments of the command line.
        work: spins the node while :attr:`Signals.running`; the default only processes callbacks.
        at_the_end: called at the end, also on SIGINT and SIGTERM, while the node can still publish.

    Returns:
        exit status: 0 after a regular end, 1 if the node could not start (its ``ValueError`` or ``OSError``, or an
        error in the command line, is printed as one line).
    """
    words = command_line(arguments)
    signals = Signals()
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
        if not signals.running:
            return 0
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        for warning in warnings:
            node.get_logger().warning(warning)
        _watch_remappings(words, node)
        signals.defer()
        if work is None:
            signals.spin(executor)
        else:
            work(node, executor, signals)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # What a callback or the executor does with a context that was shut down fails.
        if rclpy.ok():
            raise
    finally:
        if at_the_end is not None and node is not None and rclpy.ok():
            # A second signal is for those who cannot wait.
            with suppress(KeyboardInterrupt):
                at_the_end(node)
        for end in (executor and executor.shutdown, node and node.destroy_node, rclpy.try_shutdown):
            with suppress(KeyboardInterrupt):
                if end:
                    end()
    return 0


def _watch_remappings(words: list[str], node: Node) -> None:
    """Warn about remappings that rename nothing, once the node has all its topics."""
    if not {"-r", "--remap"} & set(words):
        return

    def check() -> None:
        if getattr(node, "configured", True):
            timer.cancel()
            for warning in idle_remappings(words, node):
                node.get_logger().warning(warning)

    timer = node.create_timer(_SET_UP, check, clock=STEADY)


def answered(name: str, arguments: list[str] | None = None) -> int | None:
    """Exit status of a command line that starts no node, because it asks for help or is wrong; else None.

    It needs no more than the schema: a node that loads torch is spared that.

    Args:
        name: name of the executable and of its schema.
        arguments: arguments of the command line.
    """
    words, entries = command_line(arguments), read_schema(schema_path(name))
    if {"-h", "--help"} & set(words):
        print(parameter_help(name, entries))
        return 0
    try:
        names = [name for entry in entries for name in (entry.name, entry.formerly) if name]
        refuse_stray_arguments(words, names)
        refuse_given_parameters(words, name, names)
        for path in parameter_files(words):
            read_sections(path)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return None


def run_schema_node[NodeType: Node](
    name: str,
    make_node: Callable[[], NodeType],
    arguments: list[str] | None = None,
    *,
    at_the_end: Callable[[NodeType], None] | None = None,
) -> int:
    """Run a node whose command line holds nothing but ROS arguments, or print its parameters for ``--help``.

    Args:
        name: name of the executable and of its schema.
        make_node: creates the node.
        arguments: arguments of the command line.
        at_the_end: as :func:`run_node`.

    Returns:
        exit status, as :func:`run_node`; 1 also for an argument that is not ROS's.
    """
    status = answered(name, arguments)
    return run_node(make_node, arguments, at_the_end=at_the_end) if status is None else status


def initialise(arguments: list[str] | None, signals: SignalHandlerOptions = SignalHandlerOptions.NO) -> None:
    """Initialise rclpy, by default without its handling of signals (see :class:`Signals`).

    What it cannot parse in the command line becomes a ``ValueError``.
    """
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
