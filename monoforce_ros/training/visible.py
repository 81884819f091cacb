"""Visible terrain H_g*: height maps from the lidar sweeps of a recording, accumulated along its measured poses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from monoforce_ros.bags import Recording
from monoforce_ros.core import MotionTrack, StaleDataError
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, accumulate, terrain_from_cloud

_LARGEST_GAP = 0.2
"""Between poses around a sweep [s]; others are skipped."""


def visible_terrain(
    recording: Recording,
    motion: MotionTrack,
    robot: RobotModel,
    grid: Grid,
    odometry_from_terrain: np.ndarray,
    *,
    start: int,
    stop: int,
    material: TerrainDefaults = TerrainDefaults(),  # noqa: B008
    settings: LidarSettings = LidarSettings(),  # noqa: B008
) -> TerrainMap:
    """H_g*: the surface measured by the lidar between two times.

    Args:
        recording: recording; only its clouds are read, one at a time.
        motion: measured poses of the sweeps, preferably smoothed.
        robot: robot; sweep points on its body are removed.
        grid: grid of the map.
        odometry_from_terrain: pose ``[4, 4]`` of the map's frame.
        start, stop: times of the sweeps [ns].
        material: stiffness, damping and friction of the map.
        settings: settings of the mapping.

    Raises:
        TerrainError: no sweep hit the grid.
        BagError: a cloud cannot be read or the pose of the lidar is unknown.
    """
    sweeps = _placed_sweeps(recording, motion, robot, grid, odometry_from_terrain, start, stop)
    return terrain_from_cloud(accumulate(sweeps), grid, settings=settings, material=material)


def split_maps(
    recording: Recording, motion: MotionTrack, robot: RobotModel, grid: Grid
) -> tuple[TerrainMap, tuple[TerrainMap, TerrainMap]]:
    """Map of a whole recording in the odometry frame, and two maps from alternate sweeps only.

    The split maps show the same ground with independent noise, so their difference measures the map's uncertainty.
    """
    start, stop = int(motion.stamps[0]), int(motion.stamps[-1])
    sweeps = list(_placed_sweeps(recording, motion, robot, grid, np.eye(4), start, stop))
    whole, even, odd = (
        terrain_from_cloud(accumulate(part), grid) for part in (sweeps, sweeps[0::2], sweeps[1::2] or sweeps)
    )
    return whole, (even, odd)


def _placed_sweeps(
    recording: Recording,
    motion: MotionTrack,
    robot: RobotModel,
    grid: Grid,
    odometry_from_terrain: np.ndarray,
    start: int,
    stop: int,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points of each sweep that fall on the grid, in the base frame, and the base's pose on the map."""
    inverse = np.linalg.inv(odometry_from_terrain)
    low, high = grid.extent[0::2], grid.extent[1::2]
    for frame, points, frame_id in recording.clouds_between(start, stop):
        try:
            state = motion.at(frame.stamp, maximum_gap=_LARGEST_GAP)
        except StaleDataError:
            continue
        pose = recording.sensor_pose(frame_id, robot.base_frame, robot.sensors, frame.stamp)
        points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
        points = points[~robot.covers(points)]
        placed = inverse @ state.odometry_from_base
        xy = (points @ placed[:3, :3].T + placed[:3, 3])[:, :2]
        on_map = (xy[:, 0] > low[0]) & (xy[:, 0] < high[0]) & (xy[:, 1] > low[1]) & (xy[:, 1] < high[1])
        yield points[on_map], placed
