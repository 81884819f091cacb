"""MonitorOutput: publishes the running error of past predictions."""

from __future__ import annotations

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.nodes import candidate_messages as messages
from monoforce_ros.nodes.health import OK, WARN, Health
from monoforce_ros.prediction import HORIZONS, GapSummary, LiveGap, Prediction, Predictor

PART = "live gap"


class MonitorOutput:
    """Compares past predictions with the measured motion, and publishes and reports the running error."""

    def __init__(self, node: Node, predictor: Predictor, health: Health, command_timeout: float):
        self._node, self._health = node, health
        self._gap = LiveGap(predictor, command_timeout)
        self._clear_requested = False
        self._publisher = node.create_publisher(Float32MultiArray, "predicted/live_gap", 1)

    @property
    def command_timeout(self) -> float:
        """Age from which on a command no longer acts [s]."""
        return self._gap.command_timeout

    @command_timeout.setter
    def command_timeout(self, seconds: float) -> None:
        self._gap.command_timeout = seconds

    def clear(self) -> None:
        """Discard everything after a backward time jump; may be called from any thread."""
        self._clear_requested = True

    def update(self, prediction: Prediction, motion: MotionTrack, commands: CommandTrack) -> None:
        """Keep a prediction, and compare a past one whose horizon has elapsed."""
        if self._clear_requested:
            self._clear_requested = False
            self._gap.clear()
        self._gap.remember(prediction)
        if self._gap.compare(motion, commands) is None:
            return
        found = self._gap.summary()
        where = f", largest when {found.worst}" if found.worst else ""
        if found.excessive:
            message = (
                f"predictions are {found.position[1]:.2f} m off after 2 s{where}; record a bag and run `diagnose` to "
                "find the missing effect"
            )
            self._health.report(PART, WARN, message, reason="excessive", **_figures(found))
        else:
            message = f"predictions are {found.position[1]:.2f} m off after 2 s{where}"
            if not np.isfinite(found.position[1]):
                message = "no prediction compared at 2 s yet"
            self._health.report(PART, OK, message, reason="ok", **_figures(found))
        if self._node.context.ok():
            self._publisher.publish(messages.live_gap(found))


def _figures(found: GapSummary) -> dict[str, str]:
    figures = {"compared predictions": str(found.count)}
    for i, horizon in enumerate(HORIZONS):
        if np.isfinite(found.position[i]):
            figures[f"median error at {horizon:g} s [m]"] = f"{found.position[i]:.3f}"
            figures[f"noise floor at {horizon:g} s [m]"] = f"{found.floor[i]:.3f}"
            figures[f"median heading error at {horizon:g} s [deg]"] = f"{np.degrees(found.heading[i]):.1f}"
    return figures
