"""Terrain from a lidar: heights interpolated between the returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.perception.ground_alignment import support_points
from monoforce_ros.perception.observation import Observation
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, terrain_from_cloud


@dataclass(frozen=True)
class LidarTerrain:
    """Heights interpolated from a lidar cloud (the paper's baseline [19])."""

    robot: RobotModel
    grid: Grid
    material: TerrainDefaults
    settings: LidarSettings = field(default_factory=LidarSettings)
    sensors: ClassVar[tuple[str, ...]] = ("lidar",)

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Interpolated map; raises ``TerrainError`` if too few returns lie on the grid."""
        if observation.cloud is None:
            raise ValueError("the lidar terrain source needs a point cloud, and the observation has none")
        cloud = observation.cloud[~self.robot.covers(observation.cloud)].astype(np.float64)
        return terrain_from_cloud(
            transform_points(motion.terrain_from_base, cloud),
            self.grid,
            settings=self.settings,
            material=self.material,
            support=support_points(self.robot, motion, self.material.stiffness),
        )
