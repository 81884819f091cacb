"""EnsembleOutput: publishes the uncertainty of each prediction, from an ensemble of rollouts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from monoforce_ros.nodes import candidate_messages as messages
from monoforce_ros.prediction import EnsembleSettings, Prediction, Predictor, spread


class EnsembleOutput:
    """Rolls out an ensemble of each prediction.

    Raises:
        ValueError: a setting is out of its range.
    """

    def __init__(self, node: Node, predictor: Predictor, settings: SimpleNamespace):
        self._node, self._predictor = node, predictor
        self._settings = EnsembleSettings()
        self.apply(settings)
        self._table = node.create_publisher(PointCloud2, "predicted/path_spread", 1)
        self._band = node.create_publisher(MarkerArray, "predicted/path_band", 1)

    def apply(self, settings: SimpleNamespace) -> None:
        """Apply settings that may have changed while the node runs."""
        scale = settings.ensemble_scale * EnsembleSettings.scale
        self._settings = replace(self._settings, members=settings.ensemble, scale=scale)
        self._time_step = settings.path_time_step

    def publish(self, prediction: Prediction, twists: np.ndarray, frame_id: str) -> None:
        """Publish the spread of a prediction under its commands ``[history + T, 2]``."""
        found = spread(self._predictor, prediction, twists, self._settings)
        if self._node.context.ok():
            self._table.publish(messages.spread_table(prediction, found, frame_id, self._time_step))
            self._band.publish(messages.spread_band(prediction, found, frame_id, self._time_step))
