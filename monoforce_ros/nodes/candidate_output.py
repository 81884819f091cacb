"""CandidateOutput: candidate commands rolled out on each prediction's map, and what the node publishes of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from monoforce_ros.messages import planning as messages
from monoforce_ros.planning import CandidateSettings, CostWeights, Limits, assess, fan_of_arcs, occupancy
from monoforce_ros.planning.candidates import held
from monoforce_ros.planning.costs import TERMS
from monoforce_ros.prediction import Prediction, Predictor


class CandidateOutput:
    """Compares a fan of commands with each prediction.

    Raises:
        ValueError: a setting is out of its range.
    """

    def __init__(self, node: Node, predictor: Predictor, settings: SimpleNamespace):
        self._node, self._predictor, self._settings = node, predictor, settings
        self._fan = fan_of_arcs(
            CandidateSettings(settings.candidates, tuple(settings.candidate_speeds), settings.candidate_yaw_rate)
        )
        self._weights = CostWeights(**{name: getattr(settings, f"weight_{name}") for name in TERMS})
        self._limits = Limits(**{name: getattr(settings, f"limit_{name}") for name in TERMS})
        self._feasible = 0
        self._publishers = {
            "candidates": node.create_publisher(MarkerArray, "predicted/candidates", 1),
            "candidate_costs": node.create_publisher(PointCloud2, "predicted/candidate_costs", 1),
            "best_path": node.create_publisher(Path, "predicted/best_path", 1),
            "occupancy": node.create_publisher(OccupancyGrid, "predicted/occupancy", 1),
        }

    @property
    def figures(self) -> dict[str, str]:
        """For the diagnostics."""
        return {"feasible candidates": f"{self._feasible} of {len(self._fan)}"}

    def publish(self, prediction: Prediction, before: np.ndarray, frame_id: str) -> None:
        """Roll out every candidate on the prediction's map and publish what each costs.

        Args:
            prediction: whose map and start state all share.
            before: commands that led to now ``[history, 2]``.
            frame_id: of the odometry.
        """
        motion, terrain, settings = prediction.motion, prediction.terrain, self._settings
        twists = held(self._fan, before, self._predictor.steps)
        rolled = self._predictor.roll_out(terrain, [motion] * len(self._fan), twists)
        asked = torch.from_numpy(twists[:, self._predictor.history :]).float()
        found = assess(rolled, terrain, self._predictor.robot, asked, weights=self._weights, limits=self._limits)
        grid = occupancy(
            terrain, motion.odometry_from_terrain, slope_limit=settings.slope_limit, step_limit=settings.step_limit
        )
        data = {
            "candidates": messages.candidate_markers(motion, rolled, found, frame_id),
            "candidate_costs": messages.candidate_costs(motion, rolled, self._fan, found, frame_id),
            "occupancy": messages.occupancy_grid(motion.stamp, grid, frame_id),
        }
        if found.best is not None:
            data["best_path"] = messages.best_path(motion, rolled, found.best, frame_id, settings.path_time_step)
        self._feasible = int(found.feasible.sum())
        if self._node.context.ok():
            for name, message in data.items():
                self._publishers[name].publish(message)
