"""Terrain from a lidar: heights interpolated between the returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.perception.ground_alignment import standing
from monoforce_ros.perception.observation import Observation
from monoforce_ros.physics import IdentityCache
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import (
    Grid,
    LidarSettings,
    TerrainDefaults,
    TerrainMap,
    terrain_from_cloud,
    without_overhead,
)


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
        posed, support = standing(self.robot, observation.flipper_angles, motion, self.material.stiffness)
        settings = replace(self.settings, headroom=self.robot.headroom)
        return terrain_from_cloud(
            usable_returns(observation.cloud, posed, motion, support, self.grid),
            self.grid,
            settings=settings,
            material=self.material,
            support=support,
        )


_LAST: IdentityCache[np.ndarray] = IdentityCache(2)
"""Usable returns of the last sweeps."""


def usable_returns(
    cloud: np.ndarray,
    robot: RobotModel,
    motion: MotionState,
    support: np.ndarray,
    grid: Grid,
) -> np.ndarray:
    """Returns of the ground and of objects on it: neither of the robot nor of what it passes under.

    Args:
        cloud: returns ``[n, 3]`` in the base frame [m].
        robot: its body, with its flippers as measured, and headroom.
        motion: its pose.
        support: points of the ground under its wheels ``[m, 3]`` in the terrain frame [m].
        grid: cells of the map.

    Returns:
        ``[k, 3]`` float64 in the terrain frame [m].
    """

    def found() -> np.ndarray:
        own = cloud[~robot.covers(cloud)].astype(np.float64)
        points = transform_points(motion.terrain_from_base, own[np.isfinite(own).all(axis=1)])
        limits = LidarSettings()
        return without_overhead(points, grid, support, robot.headroom, lowest=limits.lowest, highest=limits.highest)

    # An encoder and its fallback ask for those of the same sweep; how far their wheels sink in makes no difference.
    return _LAST.get((cloud, motion, robot), found, values=grid)
