"""A prediction in the odometry frame: cells of its map, the poses on it, and the forces that carry the robot."""

from __future__ import annotations

import numpy as np

from monoforce_ros.core import transform_points
from monoforce_ros.prediction.predictor import Prediction
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

FORCE_LENGTH = 1.0
"""Length of the arrow of a force as large as the robot's weight [m]."""


FORCE_INTERVAL = 0.5
"""Time between the poses at which forces are drawn [s]."""


def cell_points(terrain: TerrainMap, odometry_from_terrain: np.ndarray) -> np.ndarray:
    """Positions ``[rows · columns, 3]`` of the map's cells, at their height, in the odometry frame [m]."""
    x, y = np.meshgrid(terrain.grid.x, terrain.grid.y)
    points = np.stack([x, y, terrain.height.double().numpy()], axis=-1).reshape(-1, 3)
    return transform_points(odometry_from_terrain, points)


def usable_steps(prediction: Prediction) -> int:
    """Number of leading poses of the rollout that lie on the map."""
    outside = np.flatnonzero(~prediction.rollout.inside[0].numpy())
    return int(outside[0]) if len(outside) else len(prediction.rollout.times)


def force_steps(prediction: Prediction) -> np.ndarray:
    """Steps at which contact forces are drawn."""
    times = prediction.rollout.times.double().numpy()
    stride = max(1, round(FORCE_INTERVAL / (times[1] - times[0])))
    return np.arange(0, max(1, min(usable_steps(prediction), len(times) - 1)), stride)


def contact_points(prediction: Prediction, robot: RobotModel, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Points ``[k, 3]`` [m] that carry load during a step, and the forces on them ``[k, 3]`` [N], odometry frame."""
    result, transform = prediction.rollout, prediction.motion.odometry_from_terrain
    slot = step // result.force_every
    loaded = (result.normal_forces[0, slot] > 1.0).numpy()
    body = robot.points.double().numpy()[loaded]
    points = body @ result.rotation[0, step].double().numpy().T + result.position[0, step].double().numpy()
    forces = result.forces[0, slot].double().numpy()[loaded]
    return transform_points(transform, points), forces @ transform[:3, :3].T
