"""GapOutput: what the node says of how far its predictions have been off."""

from __future__ import annotations

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.nodes import candidate_messages as messages
from monoforce_ros.nodes.health import OK, WARN, Health
from monoforce_ros.prediction import HORIZONS, GapSummary, LiveGap, Prediction, Predictor

PART = "live gap"


class GapOutput:
    """Compares earlier predictions with what the robot did, and publishes the running error."""

    def __init__(self, node: Node, predictor: Predictor, health: Health):
        self._node, self._health = node, health
        self._gap = LiveGap(predictor)
        self._began_anew = False
        self._publisher = node.create_publisher(Float32MultiArray, "predicted/live_gap", 1)

    def clear(self) -> None:
        """Forget everything, for time began anew; may be called from any thread."""
        self._began_anew = True

    def update(self, prediction: Prediction, motion: MotionTrack, commands: CommandTrack) -> None:
        """Keep a prediction; compare an earlier one whose time has passed."""
        if self._began_anew:
            self._began_anew = False
            self._gap.clear()
        self._gap.remember(prediction)
        if self._gap.compare(motion, commands) is None:
            return
        found = self._gap.summary()
        where = f", most when {found.worst}" if found.worst else ""
        if found.excessive:
            message = (
                f"predictions are {found.position[1]:.2f} m off after 2 s{where}; record a bag and run `diagnose` to "
                "see what the model is missing"
            )
            self._health.report(PART, WARN, message, reason="excessive", **_figures(found))
        else:
            size = f"{found.position[1]:.2f} m off after 2 s" if np.isfinite(found.position[1]) else "not known at 2 s"
            self._health.report(PART, OK, f"predictions are {size}{where}", reason="ok", **_figures(found))
        if self._node.context.ok():
            self._publisher.publish(messages.live_gap(found))


def _figures(found: GapSummary) -> dict[str, str]:
    figures = {"compared predictions": str(found.count)}
    for i, horizon in enumerate(HORIZONS):
        if np.isfinite(found.position[i]):
            figures[f"median error at {horizon:g} s [m]"] = f"{found.position[i]:.3f}"
            figures[f"of which noise at {horizon:g} s [m]"] = f"{found.floor[i]:.3f}"
            figures[f"median heading error at {horizon:g} s [deg]"] = f"{np.degrees(found.heading[i]):.1f}"
    return figures
