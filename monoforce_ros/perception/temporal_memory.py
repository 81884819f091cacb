"""TemporalMemory: fills currently unobserved cells with recent observations of a terrain source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from monoforce_ros.core import NANOSECOND, CameraModel, MotionState
from monoforce_ros.perception.clearance import clear_of_robot
from monoforce_ros.perception.ground_alignment import align_to_ground, standing
from monoforce_ros.perception.lidar import usable_returns
from monoforce_ros.perception.observation import DerivedTerrain, Observation, TerrainSource, used_sensors
from monoforce_ros.perception.trace import continues
from monoforce_ros.robots import RobotModel, is_lidar
from monoforce_ros.terrain import CHANNELS, Grid, LidarSettings, TerrainMap, cell_heights, interpolated

_SIGHT_TOLERANCE = 0.1
"""How far above a lidar's line of sight remembered ground may be [m]: a cell."""
_STORED_EVERY = 0.5
"""Time after which what a lidar sees is stored again where the robot stands [s]."""
_KEPT_WITHIN, _OBSTACLE_HEIGHT = 2.0, 0.25
"""An obstacle at least this high [m] that disappears within this distance of the robot [m] is kept: an encoder that
sees only a part of a wall does not recognise it."""


class TemporalMemory(DerivedTerrain):
    """A terrain source that adds earlier observations, moved along by odometry, to the current map.

    A forward-looking camera sees neither the ground under the robot's front nor a wall that the robot has just turned
    away from, but saw both on the way. New observations replace earlier ones, except where an obstacle nearby seems to
    have disappeared. Cells are forgotten some time after they were last observed, because people walk away.

    Args:
        source: source of the current maps.
        robot: the robot on the ground.
        stiffness: stiffness of the ground under its wheels [N/m³].
        retention_time: how long a cell is kept after it was last observed [s].
        retention_distance: distance travelled after which a cell is forgotten, since odometry drifts [m].
        blind_zone_only: fill only what lies nearer than all that is observed in its direction. A lidar looks all
            around, and what it sees behind a place shows that nothing stands there any more; what it cannot see below
            its lowest row of returns may still be there. Without a sweep all that it measured is kept. Only what it
            measured is remembered, and cells that images alone cover count as its blind zone.
    """

    def __init__(
        self,
        source: TerrainSource,
        robot: RobotModel,
        *,
        stiffness: float,
        retention_time: float,
        retention_distance: float = 6.0,
        blind_zone_only: bool = False,
    ):
        if not (retention_time > 0.0 and retention_distance > 0.0):
            raise ValueError(
                f"temporal memory: got a retention time of {retention_time} s and a distance of {retention_distance} "
                "m, expected more than 0"
            )
        super().__init__(source)
        self._robot, self._stiffness = robot, stiffness
        self._retention_time, self._retention_distance = retention_time, retention_distance
        self._blind_zone_only = blind_zone_only
        mounted = [float(pose[2, 3]) for name, pose in robot.sensors.items() if is_lidar(name)]
        self._lidar_height = max(mounted, default=float(robot.bounds[1][2]))
        self._near = np.hypot(*np.meshgrid(source.grid.x, source.grid.y)) < _KEPT_WITHIN
        self._memory = _Memory(source.grid)
        self._previous: MotionState | None = None
        self._cameras: dict[str, CameraModel] = {}

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The source's current map with earlier observations; raises the source's errors."""
        now = self._source.terrain(observation, motion)
        return self.recalled(now, observation, motion, swept="lidar" in used_sensors(self._source, observation))

    def recalled(
        self, now: TerrainMap, observation: Observation, motion: MotionState, *, swept: bool = True
    ) -> TerrainMap:
        """A current map of the source, or one made of it, with earlier observations.

        Args:
            now: the map.
            observation, motion: from which it was made.
            swept: whether a lidar's sweep was part of it, without which a memory of the blind zone learns nothing.
        """
        recalibrated = any(
            not camera.same(self._cameras.get(name, camera)) for name, camera in observation.cameras.items()
        )
        self._cameras |= observation.cameras
        # A wrong calibration put earlier observations in the wrong place.
        if self._previous is None or recalibrated or not continues(motion, self._previous):
            self._memory = _Memory(now.grid)
        else:
            self._memory.travelled += float(np.linalg.norm(motion.position - self._previous.position))
        self._previous = motion
        memory = self._memory
        memory.move_to(motion.position[:2])
        values, age, distance = memory.read(motion)
        fresh = (age < self._retention_time) & (distance < self._retention_distance)
        height, observed = now.height.numpy(), now.observed.numpy()
        posed, support = standing(self._robot, observation.flipper_angles, motion, self._stiffness)
        obstacle = np.zeros_like(fresh)
        if not self._blind_zone_only:
            obstacle = fresh & observed & self._near & (values[0] - height > _OBSTACLE_HEIGHT)
            kept = (fresh & ~observed) | obstacle
        else:
            # An obstacle in images counts all the same.
            above = height - np.maximum(values[0], np.median(support[:, 2]))
            kept = fresh & ~(observed & (above > _OBSTACLE_HEIGHT))
        measured = now
        if self._blind_zone_only and swept:
            # Images cover the blind zone, too, and may say nothing of it.
            measured = replace(now, observed=self._hit(observation, motion, posed, support, now))
            # What rose above the line of sight has gone: somebody walked by. Without a sweep nothing shows that it has.
            sight = measured.looked_over(self._lidar_height + float(motion.terrain_from_base[2, 3]))
            kept &= values[0] <= sight + _SIGHT_TOLERANCE
        seen = now.observed & ~torch.from_numpy(obstacle)
        if not self._blind_zone_only:
            memory.write(replace(now, observed=seen), motion)
        elif swept and memory.is_due(motion):
            # A row of returns hits single cells, which would be lost between those of the memory.
            nearby = torch.from_numpy(measured.measured_nearby(1.5 * now.grid.resolution))
            memory.write(replace(now, observed=nearby), motion)
        if not kept.any():
            return now
        joined = now.with_cells(torch.from_numpy(kept), dict(zip(CHANNELS, torch.from_numpy(values), strict=True)))
        return clear_of_robot(align_to_ground(joined, support), posed, motion)

    def _hit(
        self, observation: Observation, motion: MotionState, posed: RobotModel, support: np.ndarray, now: TerrainMap
    ) -> torch.Tensor:
        """Observed cells that the lidar's sweep measured, ``[rows, columns]`` bool."""
        if observation.cloud is None or "camera" not in self.sensors:
            return now.observed
        points = usable_returns(observation.cloud, posed, motion, support, now.grid)
        _, hit = cell_heights(points, now.grid, replace(LidarSettings(), headroom=self._robot.headroom))
        return now.observed & torch.from_numpy(hit)


class _Memory:
    """A map fixed in the odometry frame that covers the surroundings of the robot.

    Cells do not move, so that a value is resampled only when it is written and when it is read: resampling with every
    image would smooth walls away.
    """

    def __init__(self, grid: Grid):
        self.travelled = 0.0
        """Distance travelled by the robot so far [m]."""
        self._grid = grid
        # Contains the map around the robot for any heading.
        self._size = 2 * int(np.ceil(np.hypot(grid.rows, grid.columns) / 2.0)) + 2
        self._corner = np.zeros(2, np.int64)
        """Column and row of the first cell in the odometry frame."""
        self._values = np.zeros((len(CHANNELS), self._size, self._size), np.float32)
        self._written: tuple[int, float] | None = None
        """When the last observation was stored [ns], and the distance travelled until then [m]."""
        self._observed_at = np.zeros((self._size, self._size), np.int64)
        """Time of the last observation of each cell [ns]; 0 without any."""
        self._odometer = np.zeros((self._size, self._size))
        """Distance travelled at the last observation [m]."""

    def move_to(self, place: np.ndarray) -> None:
        """Centre the map on a position ``[2]`` in the odometry frame; cells that leave it are forgotten."""
        corner = np.rint(place / self._grid.resolution).astype(np.int64) - self._size // 2
        if (shift := corner - self._corner).any():
            unknown = np.zeros((self._size, self._size), bool)
            for axis, by in ((1, int(shift[0])), (0, int(shift[1]))):
                by = int(np.clip(by, -self._size, self._size))
                self._values = np.roll(self._values, -by, axis + 1)
                self._observed_at = np.roll(self._observed_at, -by, axis)
                self._odometer = np.roll(self._odometer, -by, axis)
                unknown = np.roll(unknown, -by, axis)
                entered = slice(self._size - by, None) if by > 0 else slice(0, -by)
                unknown[(slice(None), entered) if axis else (entered, slice(None))] = True
            self._observed_at[unknown] = 0
        self._corner = corner

    def is_due(self, motion: MotionState) -> bool:
        """Whether the robot has moved by a cell, or some time has passed, since the last observation was stored."""
        if self._written is None:
            return True
        stamp, travelled = self._written
        return (
            self.travelled - travelled >= self._grid.resolution
            or (motion.stamp - stamp) * NANOSECOND >= _STORED_EVERY
            or motion.stamp < stamp
        )

    def write(self, terrain: TerrainMap, motion: MotionState) -> None:
        """Store the observed cells of a map in the terrain frame of a motion."""
        self._written = motion.stamp, self.travelled
        grid, pose = terrain.grid, motion.odometry_from_terrain
        index = np.arange(self._size)
        places = (np.stack(np.meshgrid(index, index), axis=-1) + self._corner) * grid.resolution
        local = (places - pose[:2, 3]) @ pose[:2, :2]
        cells = ((local - np.array(grid.origin)) / grid.resolution).astype(np.float32)
        channels = np.stack([getattr(terrain, name).numpy() for name in CHANNELS])
        values, weight = _sampled(channels, terrain.observed.numpy(), cells)
        observed = weight > 0.5
        values[:2] += np.float32(pose[2, 3])
        self._values[:, observed] = values[:, observed]
        self._observed_at[observed], self._odometer[observed] = motion.stamp, self.travelled

    def read(self, motion: MotionState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stored values in the terrain frame of a motion.

        Returns:
            channels ``[5, rows, columns]``; time since each cell was observed [s] and distance travelled since then
            [m], each ``[rows, columns]`` and infinite without an observation.
        """
        grid, pose = self._grid, motion.odometry_from_terrain
        places = np.stack(np.meshgrid(grid.x, grid.y), axis=-1) @ pose[:2, :2].T + pose[:2, 3]
        cells = (places / grid.resolution - self._corner).astype(np.float32)
        values, weight = _sampled(self._values, self._observed_at > 0, cells)
        values[:2] -= np.float32(pose[2, 3])
        column, row = np.moveaxis(np.clip(np.rint(cells).astype(np.int64), 0, self._size - 1), -1, 0)
        known = (weight > 0.5) & (self._observed_at[row, column] > 0)
        age = np.where(known, (motion.stamp - self._observed_at[row, column]) * NANOSECOND, np.inf)
        return values, age, np.where(known, self.travelled - self._odometer[row, column], np.inf)


def _sampled(channels: np.ndarray, known: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Channels ``[C, H, W]`` interpolated between ``known`` cells at fractional columns and rows ``[h, w, 2]``, and the
    weight of known cells ``[h, w]``."""
    weight = interpolated(known, cells)
    found = [interpolated(np.where(known, values, 0.0), cells) / np.maximum(weight, 0.5) for values in channels]
    return np.stack(found), weight
