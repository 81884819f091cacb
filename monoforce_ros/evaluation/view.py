"""PredictionView: the parts of a prediction for figures, from this process or from a node's messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.messages import MessageError, stamp_of
from monoforce_ros.prediction import FORCE_LENGTH, Prediction, contact_points, force_steps, usable_steps
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

LARGEST_DRAWN_FORCE = 0.5
"""Length up to which forces are drawn, over the robot's weight: twice the load of each of four wheels at rest.

Impacts, and maps that cut through a wheel at the start, give forces that would cover the picture."""


@dataclass(frozen=True)
class PredictionView:
    """A prediction in its terrain frame (origin at the robot, x along its heading, z up)."""

    motion: MotionState
    terrain: TerrainMap
    times: np.ndarray
    """Time of each pose of the path [s], ``[n]``."""
    positions: np.ndarray
    """``[n, 3]`` [m]."""
    rotations: np.ndarray
    """``[n, 3, 3]``."""
    contact_points: np.ndarray
    """Loaded contact points at some times along the path, ``[k, 3]`` [m]."""
    contact_forces: np.ndarray
    """Contact forces over the robot's weight, ``[k, 3]`` [-]."""

    @property
    def drawn_forces(self) -> np.ndarray:
        """Contact forces for pictures, ``[k, 3]`` [-]: larger ones are shortened to :data:`LARGEST_DRAWN_FORCE`."""
        size = np.linalg.norm(self.contact_forces, axis=1, keepdims=True)
        return self.contact_forces * np.minimum(1.0, LARGEST_DRAWN_FORCE / np.maximum(size, 1e-12))

    @classmethod
    def of_prediction(cls, prediction: Prediction, robot: RobotModel) -> PredictionView:
        """View of a prediction made in this process."""
        steps = usable_steps(prediction)
        to_terrain = np.linalg.inv(prediction.motion.odometry_from_terrain)
        contacts = [contact_points(prediction, robot, step) for step in force_steps(prediction)]
        points, forces = (np.concatenate(parts) for parts in zip(*contacts, strict=True))
        return cls(
            motion=prediction.motion,
            terrain=prediction.terrain,
            times=prediction.rollout.times.double().numpy()[:steps],
            positions=prediction.rollout.position[0].double().numpy()[:steps],
            rotations=prediction.rollout.rotation[0].double().numpy()[:steps],
            contact_points=transform_points(to_terrain, points),
            contact_forces=forces @ to_terrain[:3, :3].T / (float(robot.mass.mean()) * 9.81),
        )

    @classmethod
    def of_messages(cls, terrain: Any, path: Any, contact_forces: Any, motion: MotionState) -> PredictionView:
        """View of the messages that a predictor node published for one stamp.

        Args:
            terrain: PointCloud2 of ``predicted/terrain``.
            path: Path of ``predicted/path``.
            contact_forces: MarkerArray of ``predicted/contact_forces``.
            motion: measured state at the messages' stamp.

        Raises:
            MessageError: a message lacks the expected content.
        """
        to_terrain = np.linalg.inv(motion.odometry_from_terrain)
        poses = [entry.pose for entry in path.poses]
        orientations = np.array([[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses])
        lines = next((m for m in contact_forces.markers if m.ns == "contact_forces"), None)
        if lines is None:
            raise MessageError("contact forces: no marker in the namespace contact_forces")
        ends = transform_points(to_terrain, _points(lines.points)).reshape(-1, 2, 3)
        return cls(
            motion=motion,
            terrain=_terrain_of_cloud(terrain, to_terrain),
            times=np.array([stamp_of(entry) - stamp_of(path) for entry in path.poses]) * 1e-9,
            positions=transform_points(to_terrain, _points(p.position for p in poses)),
            rotations=to_terrain[:3, :3] @ Rotation.from_quat(orientations).as_matrix(),
            contact_points=ends[:, 0],
            contact_forces=(ends[:, 1] - ends[:, 0]) / FORCE_LENGTH,
        )


def _points(vectors: Iterable[Any]) -> np.ndarray:
    return np.array([[v.x, v.y, v.z] for v in vectors], float).reshape(-1, 3)


def _terrain_of_cloud(cloud: Any, to_terrain: np.ndarray) -> TerrainMap:
    """The map that a node published as a cloud of its cells, row by row."""
    names = [entry.name for entry in cloud.fields]
    values = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, len(names)).astype(np.float64)
    column = dict(zip(names, values.T, strict=True))
    local = transform_points(to_terrain, values[:, :3])
    # x increases along a row and jumps back at the start of the next one.
    columns = int(np.argmax(np.diff(local[:, 0]) < 0)) + 1
    if columns < 2 or len(values) % columns:
        raise MessageError(f"terrain: {len(values)} points do not form the rows of a grid")
    rows = len(values) // columns
    resolution = float(local[columns - 1, 0] - local[0, 0]) / (columns - 1)
    grid = Grid(rows, columns, round(resolution, 4), (float(local[0, 0]), float(local[0, 1])))

    def channel(data: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(data.astype(np.float32)).reshape(rows, columns)

    return TerrainMap(
        height=channel(local[:, 2]),
        geometric_height=channel(column["geometric_height"] + to_terrain[2, 3]),
        stiffness=channel(column["stiffness"]),
        damping=channel(column["damping"]),
        friction=channel(column["friction"]),
        observed=channel(column["observed"]) > 0.5,
        grid=grid,
    )
