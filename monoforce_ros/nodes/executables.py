"""Entry points of the nodes' executables.

A node imports for seconds before rclpy handles signals. Until then SIGINT and SIGTERM end the process as they do later:
at once, with status 0 and without a traceback.
"""

from __future__ import annotations

import importlib
import signal
from types import FrameType

_ANSWERED_EARLY = ("predictor", "path_selector")
"""Nodes with nothing but ROS arguments on their command line, which is checked before torch is loaded."""


def _end(number: int, frame: FrameType | None) -> None:
    raise SystemExit(0)


def _run(name: str, arguments: list[str] | None) -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    if name in _ANSWERED_EARLY:
        early: int | None = importlib.import_module("monoforce_ros.nodes.process").answered(name, arguments)
        if early is not None:
            return early
    # The node replaces these handlers when it starts.
    status: int = importlib.import_module(f"monoforce_ros.nodes.{name}").main(arguments)
    return status


def predictor(arguments: list[str] | None = None) -> int:
    """Run the predictor."""
    return _run("predictor", arguments)


def path_selector(arguments: list[str] | None = None) -> int:
    """Run path_selector."""
    return _run("path_selector", arguments)


def simulator(arguments: list[str] | None = None) -> int:
    """Run the simulator."""
    return _run("simulator", arguments)


def bag_player(arguments: list[str] | None = None) -> int:
    """Run bag_player."""
    return _run("bag_player", arguments)


def bag_recorder(arguments: list[str] | None = None) -> int:
    """Run bag_recorder."""
    return _run("bag_recorder", arguments)
