"""Geometry of a prediction in the odometry frame, for messages and figures: map cells, poses, contact forces."""

from __future__ import annotations

import numpy as np

from monoforce_ros.core import transform_points
from monoforce_ros.prediction.predictor import Prediction
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

FORCE_LENGTH = 1.0
"""Length of the arrow of a force equal to the robot's weight [m]."""
FORCE_INTERVAL = 0.5
"""Time between the poses at which forces are drawn [s]."""


def cell_points(terrain: TerrainMap, odometry_from_terrain: np.ndarray) -> np.ndarray:
    """Positions of the map's cells on its surface, in the odometry frame [m], ``[rows · columns, 3]``."""
    x, y = np.meshgrid(terrain.grid.x, terrain.grid.y)
    points = np.stack([x, y, terrain.height.double().numpy()], axis=-1).reshape(-1, 3)
    return transform_points(odometry_from_terrain, points)


def usable_steps(prediction: Prediction) -> int:
    """Number of poses before the rollout leaves the map."""
    outside = np.flatnonzero(~prediction.rollout.inside[0].numpy())
    return int(outside[0]) if len(outside) else len(prediction.rollout.times)


def force_steps(prediction: Prediction) -> np.ndarray:
    """Steps at which contact forces are drawn, one every :data:`FORCE_INTERVAL`."""
    times = prediction.rollout.times.double().numpy()
    stride = max(1, round(FORCE_INTERVAL / (times[1] - times[0])))
    return np.arange(0, max(1, min(usable_steps(prediction), len(times) - 1)), stride)


def contact_points(prediction: Prediction, robot: RobotModel, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Loaded contact points ``[k, 3]`` [m] during a step, and the forces on them ``[k, 3]`` [N], in the odometry frame.

    Raises:
        ValueError: the prediction was made without forces.
    """
    result, transform = prediction.rollout, prediction.motion.odometry_from_terrain
    if result.normal_forces is None or result.forces is None:
        raise ValueError("contact points: the rollout has no contact forces; predict with `with_forces=True`")
    slot = step // result.force_every
    loaded = (result.normal_forces[0, slot] > 1.0).numpy()
    body = robot.points.double().numpy()[loaded]
    points = body @ result.rotation[0, step].double().numpy().T + result.position[0, step].double().numpy()
    forces = result.forces[0, slot].double().numpy()[loaded]
    return transform_points(transform, points), forces @ transform[:3, :3].T
