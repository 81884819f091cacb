"""SeenObstacles: what motion stereo shows to stand on the ground, added to maps of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from monoforce_ros.core import MotionState
from monoforce_ros.perception.clearance import clear_of_robot
from monoforce_ros.perception.fusion import lowered_where_compliant
from monoforce_ros.perception.ground_alignment import standing
from monoforce_ros.perception.motion_stereo import MeasuredPoints, MotionStereo
from monoforce_ros.perception.observation import DerivedTerrain, Observation, TerrainSource, used_sensors
from monoforce_ros.perception.obstacle_memory import ObstacleMemory
from monoforce_ros.perception.standing_points import standing_on
from monoforce_ros.perception.trace import continues
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

_BESIDE = 3
"""Cells around one in which an encoder may have put what stands there: images tell it no place to the cell."""


class SeenObstacles:
    """Adds to a map what images from several places show to stand on the ground.

    One image says too little of depth to show walls; a robot that moves has images from several known places, whose
    parallax measures it (:class:`MotionStereo`). Where nothing was measured a map stays as it is, the same object.

    Args:
        robot: the robot on the ground.
        stiffness: of the ground that carries it [N/m³].
        grid: cells of the maps.
    """

    def __init__(self, robot: RobotModel, stiffness: float, grid: Grid):
        self._robot, self._stiffness, self._grid = robot, stiffness, grid
        self._stereo, self._memory = MotionStereo(), ObstacleMemory(grid)
        self._previous: MotionState | None = None
        self.measured: list[MeasuredPoints] = []
        """Points measured in the last images, of each camera."""

    def follow(self, observation: Observation, motion: MotionState) -> None:
        """Keep the images of an observation for later ones."""
        self._stereo.keep(observation, motion)

    def added(
        self, terrain: TerrainMap, predicted: TerrainMap, observation: Observation, motion: MotionState
    ) -> TerrainMap:
        """A map of an observation with what stands on the ground.

        Args:
            terrain: the map.
            predicted: an encoder's map, which tells what is soft: hedges stop no robot.
            observation, motion: from which both were made, in order of time.
        """
        posed, support = standing(self._robot, observation.flipper_angles, motion, self._stiffness)
        ground = float(support[:, 2].mean())
        self.measured = self._stereo.points(observation, motion, ground)
        if self._previous is not None and not continues(motion, self._previous):
            self._memory.forget()
        self._previous = motion
        seen = standing_on(self.measured, motion.terrain_from_base, ground, self._robot.headroom, self._grid)
        heights = self._memory.recalled(seen.heights, seen.sight, motion, ground)
        found = np.isfinite(heights)
        if not found.any():
            return terrain
        stands = torch.from_numpy(found)
        surface = torch.from_numpy(np.where(found, heights + ground, 0.0)).to(terrain.height)
        higher = stands & (surface > terrain.geometric_height)
        carries = lowered_where_compliant(surface, _beside(predicted), torch.minimum(predicted.height, terrain.height))
        raised = replace(
            terrain,
            geometric_height=torch.where(higher, surface, terrain.geometric_height),
            height=torch.where(higher, torch.maximum(carries, terrain.height), terrain.height),
            observed=terrain.observed | stands,
        )
        cleared = clear_of_robot(raised, posed, motion)
        # Elsewhere the ground is not rigid: grass around the wheels stays.
        return replace(
            cleared,
            geometric_height=torch.where(stands, cleared.geometric_height, terrain.geometric_height),
            height=torch.where(stands, cleared.height, terrain.height),
        )


def _beside(predicted: TerrainMap) -> TerrainMap:
    """A predicted map with the largest H_d nearby in each cell."""
    decrease = predicted.geometric_height - predicted.height
    largest = functional.max_pool2d(decrease[None, None], 2 * _BESIDE + 1, 1, _BESIDE)[0, 0]
    return replace(predicted, geometric_height=predicted.height + largest)


class ObstacleTerrain(DerivedTerrain):
    """A source of maps of images, with :class:`SeenObstacles`."""

    def __init__(self, source: TerrainSource, obstacles: SeenObstacles):
        super().__init__(source)
        self._obstacles = obstacles

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The source's map with what stands on the ground, unless a lidar measured it; raises the source's errors."""
        found = self._source.terrain(observation, motion)
        if "lidar" in used_sensors(self._source, observation):
            self._obstacles.follow(observation, motion)
            return found
        return self._obstacles.added(found, found, observation, motion)
