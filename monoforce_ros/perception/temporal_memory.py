"""TemporalMemory: what a terrain source saw a moment ago, where it sees nothing now."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from monoforce_ros.core import NANOSECOND, CameraModel, MotionState
from monoforce_ros.perception.ground_alignment import aligned_to_ground, clear_of, support_points
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import CHANNELS, Grid, TerrainMap

_LOST_WITHIN, _STANDS = 2.0, 0.25
"""What stood out by so much [m] is not believed to be gone from within this distance of the robot [m]: an encoder that
sees no more than a piece of a wall does not know it for one."""
_JUMP = 1.0
"""A robot that is further than this from where its velocity would have taken it has been moved, or its odometry [m]."""


class TemporalMemory:
    """Fills what a source does not see with what it saw before, carried along by odometry.

    A camera that looks ahead sees neither the ground under the robot's nose nor the wall that it has just turned away
    from, and has seen both as the robot came. What is seen now replaces what was seen before, unless something that
    stood out nearby seems to be gone; and what was not seen again for a while is forgotten: people walk away.

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
        self._near = np.hypot(*np.meshgrid(source.grid.x, source.grid.y)) < _LOST_WITHIN
        self._memory: _Memory | None = None
        self._before: MotionState | None = None
        self._cameras: dict[str, CameraModel] = {}

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
        changed = any(
            not _same(camera, self._cameras.get(name, camera)) for name, camera in observation.cameras.items()
        )
        self._cameras |= observation.cameras
        # What was seen through a calibration that turned out wrong was seen in the wrong place.
        if self._before is None or changed or not _follows(motion, self._before):
            self._memory = _Memory(now.grid)
        else:
            self._memory.travelled += float(np.linalg.norm(motion.position - self._before.position))
        self._before = motion
        memory = self._memory
        memory.move_to(motion.position[:2])
        values, age, since = memory.read(motion)
        fresh = (age < self._seconds) & (since < self._distance)
        lost = fresh & now.observed.numpy() & self._near & (values[0] - now.height.numpy() > _STANDS)
        kept = (fresh & ~now.observed.numpy()) | lost
        memory.write(replace(now, observed=now.observed & ~torch.from_numpy(lost)), motion)
        if not kept.any():
            return now
        known = torch.from_numpy(kept)
        joined = replace(
            now,
            observed=now.observed | known,
            **{
                name: torch.where(known, torch.from_numpy(value).to(now.height), getattr(now, name))
                for name, value in zip(CHANNELS, values, strict=True)
            },
        )
        support = support_points(self._robot, motion, self._stiffness)
        return clear_of(aligned_to_ground(joined, support), self._robot, motion)


def _same(camera: CameraModel, other: CameraModel) -> bool:
    """Whether two calibrations see the same."""
    return (
        (camera.width, camera.height, camera.distortion_model) == (other.width, other.height, other.distortion_model)
        and np.array_equal(camera.matrix, other.matrix)
        and np.array_equal(camera.distortion, other.distortion)
    )


def _follows(motion: MotionState, before: MotionState) -> bool:
    """Whether a robot can have come from one place to the other."""
    elapsed = (motion.stamp - before.stamp) * NANOSECOND
    expected = before.position + before.rotation @ before.linear_velocity * elapsed
    return elapsed >= 0.0 and float(np.linalg.norm(motion.position - expected)) < _JUMP * max(1.0, elapsed)


class _Memory:
    """A map that stands still in the odometry frame and covers what is around the robot.

    Cells keep their place, so that a value is resampled once when it is written and once when it is read, however long
    it is kept: resampled with each image, walls would melt.
    """

    def __init__(self, grid: Grid):
        self.travelled = 0.0
        """By the robot, all in all [m]."""
        self._grid = grid
        # Whichever way the map around the robot is turned, it lies within.
        self._size = 2 * int(np.ceil(np.hypot(grid.rows, grid.columns) / 2.0)) + 2
        self._corner: np.ndarray | None = None
        self._values = np.zeros((len(CHANNELS), self._size, self._size), np.float32)
        self._seen = np.zeros((self._size, self._size), np.int64)
        """When each cell was seen last [ns]; 0 where it never was."""
        self._odometer = np.zeros((self._size, self._size))
        """How far the robot had travelled then [m]."""

    def move_to(self, place: np.ndarray) -> None:
        """Cover what is around a place ``[2]`` in the odometry frame; what falls off is forgotten."""
        corner = np.rint(place / self._grid.resolution).astype(np.int64) - self._size // 2
        if self._corner is not None and (shift := corner - self._corner).any():
            gone = np.zeros((self._size, self._size), bool)
            for axis, by in ((1, int(shift[0])), (0, int(shift[1]))):
                by = int(np.clip(by, -self._size, self._size))
                self._values = np.roll(self._values, -by, axis + 1)
                self._seen, self._odometer = np.roll(self._seen, -by, axis), np.roll(self._odometer, -by, axis)
                gone = np.roll(gone, -by, axis)
                entered = slice(self._size - by, None) if by > 0 else slice(0, -by)
                gone[(slice(None), entered) if axis else (entered, slice(None))] = True
            self._seen[gone] = 0
        self._corner = corner

    def write(self, terrain: TerrainMap, motion: MotionState) -> None:
        """Keep the observed cells of a map in the terrain frame of a motion."""
        grid, pose = terrain.grid, motion.odometry_from_terrain
        index = np.arange(self._size)
        places = (np.stack(np.meshgrid(index, index), axis=-1) + self._corner) * grid.resolution
        local = (places - pose[:2, 3]) @ pose[:2, :2]
        cells = ((local - np.array(grid.origin)) / grid.resolution).astype(np.float32)
        channels = np.stack([getattr(terrain, name).numpy() for name in CHANNELS])
        values, weight = _sampled(channels, terrain.observed.numpy(), cells)
        seen = weight > 0.5
        values[:2] += np.float32(pose[2, 3])
        self._values[:, seen] = values[:, seen]
        self._seen[seen], self._odometer[seen] = motion.stamp, self.travelled

    def read(self, motion: MotionState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Channels in the terrain frame of a motion ``[5, rows, columns]``, how long ago each cell was seen [s] and how
        far the robot has travelled since [m], ``[rows, columns]``; both infinite where it never was."""
        grid, pose = self._grid, motion.odometry_from_terrain
        places = np.stack(np.meshgrid(grid.x, grid.y), axis=-1) @ pose[:2, :2].T + pose[:2, 3]
        cells = (places / grid.resolution - self._corner).astype(np.float32)
        values, weight = _sampled(self._values, self._seen > 0, cells)
        values[:2] -= np.float32(pose[2, 3])
        column, row = np.moveaxis(np.clip(np.rint(cells).astype(np.int64), 0, self._size - 1), -1, 0)
        known = (weight > 0.5) & (self._seen[row, column] > 0)
        age = np.where(known, (motion.stamp - self._seen[row, column]) * NANOSECOND, np.inf)
        return values, age, np.where(known, self.travelled - self._odometer[row, column], np.inf)


def _sampled(channels: np.ndarray, known: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Channels ``[C, H, W]`` at fractional columns and rows ``[h, w, 2]`` from ``known`` cells alone; their weight."""

    def at(values: np.ndarray) -> np.ndarray:
        return cv2.remap(
            values.astype(np.float32), cells[..., 0], cells[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=0.0,
        )  # fmt: skip

    weight = at(known)
    return np.stack([at(np.where(known, values, 0.0)) / np.maximum(weight, 0.5) for values in channels]), weight
