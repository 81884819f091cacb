"""FlatTerrain: level ground under the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from monoforce_ros.core import MotionState
from monoforce_ros.perception.ground_alignment import lowest_support, support_points
from monoforce_ros.perception.observation import Observation
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap


@dataclass(frozen=True)
class FlatTerrain:
    """Level ground at the height of the wheels; needs no sensor."""

    robot: RobotModel
    grid: Grid
    material: TerrainDefaults
    sensors: ClassVar[tuple[str, ...]] = ()

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Level map; see :class:`TerrainSource`."""
        if observation.flipper_angles is None or not self.robot.flippers:
            height = float(support_points(self.robot, motion, self.material.stiffness)[:, 2].mean())
        else:
            height = lowest_support(self.robot, motion, observation.flipper_angles, self.material.stiffness)
        return TerrainMap.flat(self.grid, height=height, material=self.material)
