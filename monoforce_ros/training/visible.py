"""Visible terrain of a drive: its lidar sweeps, joined along the measured poses, as a height map."""

from __future__ import annotations

import numpy as np

from monoforce_ros.bags import Recording
from monoforce_ros.motion import MotionTrack, StaleDataError
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, accumulate, terrain_from_cloud

_LARGEST_GAP = 0.2


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
    """H_g*: what the lidar saw of the ground between two times.

    Args:
        recording: the drive; only its clouds are read, one at a time.
        motion: measured, best smoothed: a sweep is placed where the robot was.
        robot: whose own body is taken out of the sweeps.
        grid: of the map.
        odometry_from_terrain: pose ``[4, 4]`` of the map's frame.
        start, stop: times of the sweeps [ns].
        material: of the map.
        settings: of the map.

    Raises:
        TerrainError: no sweep hit the grid.
        BagError: a cloud cannot be read or the lidar's pose is unknown.
    """
    inverse = np.linalg.inv(odometry_from_terrain)
    low, high = grid.extent[0::2], grid.extent[1::2]

    def sweeps():
        for frame, points, frame_id in recording.clouds_between(start, stop):
            try:
                state = motion.at(frame.stamp, maximum_gap=_LARGEST_GAP)
            except StaleDataError:
                continue
            pose = recording.sensor_pose(frame_id, robot.base_frame, robot.sensors)
            points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
            points = points[~robot.covers(points)]
            placed = inverse @ state.odometry_from_base
            there = points @ placed[:3, :3].T + placed[:3, 3]
            on_map = (there[:, 0] > low[0]) & (there[:, 0] < high[0]) & (there[:, 1] > low[1]) & (there[:, 1] < high[1])
            yield points[on_map], placed

    return terrain_from_cloud(accumulate(sweeps()), grid, settings=settings, material=material)
