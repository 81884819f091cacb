"""RememberedTerrain: what a terrain source saw a moment ago, where it sees nothing now."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from monoforce_ros.motion import NANOSECOND, MotionState
from monoforce_ros.prediction.footing import clear_of, laid_under, support_points
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap
from monoforce_ros.terrain.terrain_map import CHANNELS

if TYPE_CHECKING:
    from monoforce_ros.prediction.terrain_sources import Observation, TerrainSource

_JUMP = 1.0
"""A robot that is further than this from where its velocity would have taken it has been moved, or its odometry [m]."""


@dataclass(frozen=True)
class _Memory:
    motion: MotionState
    terrain: TerrainMap
    seen: np.ndarray
    """When each cell was seen last [ns] ``[rows, columns]``; 0 where it never was."""
    travelled: np.ndarray
    """How far the robot has moved since [m]."""


class RememberedTerrain:
    """Fills what a source does not see with what it saw before, carried along by odometry.

    A camera that looks ahead sees neither the ground under the robot's nose nor the wall that it has just turned away
    from, and has seen both as the robot came. What is seen now always replaces what was seen before, and what was not
    seen again for a while is forgotten: people walk away.

    Args:
        source: that sees.
        robot: that stands on the ground.
        stiffness: of the ground under its wheels [N/m³].
        seconds: for which a cell is remembered.
        distance: that the robot may move until a cell is forgotten: odometry drifts [m].
    """

    def __init__(
        self, source: TerrainSource, robot: RobotModel, *, stiffness: float, seconds: float, distance: float = 6.0
    ):
        if not (seconds > 0.0 and distance > 0.0):
            raise ValueError(f"memory: got {seconds} s and {distance} m, expected more than 0")
        self._source, self._robot, self._stiffness = source, robot, stiffness
        self._seconds, self._distance = seconds, distance
        self._memory: _Memory | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """The source's."""
        return self._source.sensors

    @property
    def grid(self) -> Grid:
        """The source's."""
        return self._source.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map of what is seen now and what was seen before; errors are the source's."""
        now = self._source.terrain(observation, motion)
        seen = np.where(now.observed.numpy(), motion.stamp, 0)
        travelled = np.zeros(seen.shape)
        if self._memory is not None and self._belongs(self._memory.motion, motion):
            now, seen, travelled = self._joined(now, seen, self._memory, motion)
        self._memory = _Memory(motion, now, seen, travelled)
        return now

    @staticmethod
    def _belongs(before: MotionState, motion: MotionState) -> bool:
        """Whether a robot can have come from one place to the other."""
        elapsed = (motion.stamp - before.stamp) * NANOSECOND
        expected = before.position + before.rotation @ before.linear_velocity * elapsed
        return elapsed >= 0.0 and float(np.linalg.norm(motion.position - expected)) < _JUMP * max(1.0, elapsed)

    def _joined(
        self, now: TerrainMap, seen: np.ndarray, memory: _Memory, motion: MotionState
    ) -> tuple[TerrainMap, np.ndarray, np.ndarray]:
        grid = now.grid
        then_from_now = np.linalg.inv(memory.motion.odometry_from_terrain) @ motion.odometry_from_terrain
        # Both frames stand upright: a cell's place turns and moves, its height moves.
        places = np.stack(np.meshgrid(grid.x, grid.y), axis=-1) @ then_from_now[:2, :2].T + then_from_now[:2, 3]
        index = ((places - np.array(grid.origin)) / grid.resolution).astype(np.float32)
        column, row = index[..., 0], index[..., 1]

        def carried(values: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
            return cv2.remap(values, column, row, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)

        # Seconds since rather than stamps: they fit into a float.
        age = np.where(memory.seen > 0, (motion.stamp - memory.seen) * NANOSECOND, 1e6).astype(np.float32)
        # What was not seen then must not leak into what was.
        known = (memory.seen > 0).astype(np.float32)
        weight = carried(known)
        age = np.where(weight > 0.5, carried(age, cv2.INTER_NEAREST), 1e6)
        step = float(np.linalg.norm(motion.position - memory.motion.position))
        travelled = carried(memory.travelled.astype(np.float32), cv2.INTER_NEAREST) + step
        kept = (seen == 0) & (age < self._seconds) & (travelled < self._distance)
        if not kept.any():
            return now, seen, np.zeros(seen.shape)
        values = {}
        for name in CHANNELS:
            before = carried(getattr(memory.terrain, name).numpy() * known) / np.maximum(weight, 0.5)
            if name in ("height", "geometric_height"):
                before = before - np.float32(then_from_now[2, 3])
            values[name] = torch.where(torch.from_numpy(kept), torch.from_numpy(before), getattr(now, name))
        observed = now.observed | torch.from_numpy(kept)
        joined = replace(now, **values, observed=observed)
        support = support_points(self._robot, motion, self._stiffness)
        joined = clear_of(laid_under(joined, support), self._robot, motion)
        seen = np.where(kept, motion.stamp - (age / NANOSECOND).astype(np.int64), seen)
        return joined, seen, np.where(kept, travelled, 0.0)
