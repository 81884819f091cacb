"""Terrain evidence: supporting heights where the robot drove, and what the map leaves uncertain of the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter

from monoforce_ros.core import MotionTrack, transform_points
from monoforce_ros.discrepancy.areas import reach_of
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.wheel_motion import runs
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap
from monoforce_ros.training import traced_heights

_FULL_WITHIN, _REACH = 0.5, 1.5
"""Distance from the driven cells within which the traced ground replaces the visible one, and at which it has faded out
[m]: predictions that leave the measured path by half a robot's width still find the supporting ground."""
_SMOOTHING = 0.1
"""Standard deviation of the smoothing of the traced correction [m]: a cell."""


def traced_terrain(motion: MotionTrack, robot: RobotModel, grid: Grid) -> TerrainMap:
    """The ground as the wheels traced it, for a recording without a map: heights under the driven path.

    Args:
        motion: smoothed poses of the base frame, whose z axis is against gravity.
        robot: its wheels or tracks.
        grid: cells in the odometry frame.
    """
    level = torch.full((grid.rows, grid.columns), float(np.median(motion.positions[:, 2])))
    traced = supporting_terrain(TerrainMap.from_height(level, grid), motion, robot, reach=np.inf)
    return TerrainMap.from_height(traced.height, grid)


def supporting_terrain(
    visible: TerrainMap, motion: MotionTrack, robot: RobotModel, *, reach: float = _REACH
) -> TerrainMap:
    """The map with the ground that carried the robot in place of the visible one where it drove.

    A lidar sees the top of vegetation, the wheels trace the ground below. ``geometric_height`` stays the visible one,
    so that their difference is the height of the vegetation. Near the path the difference is extrapolated, since wheels
    that leave the measured path by a few centimetres must not meet a step; it fades out with the distance.

    Args:
        visible: map in the odometry frame.
        motion: smoothed poses of the base frame.
        robot: its wheels or tracks.
        reach: distance from the path at which the difference has faded out [m]; infinite: it does not fade.
    """
    grid = visible.grid
    heights, traced = traced_heights(motion, robot, np.eye(4), grid, float(visible.stiffness.median()))
    if not traced.any():
        return visible
    change = np.where(traced, heights - visible.height.double().numpy(), 0.0)
    distance, nearest = distance_transform_edt(~traced, sampling=grid.resolution, return_indices=True)
    spread = gaussian_filter(change[nearest[0], nearest[1]], _SMOOTHING / grid.resolution)
    fading = 1.0 if np.isinf(reach) else np.clip((reach - distance) / (reach - _FULL_WITHIN), 0.0, 1.0)
    spread = np.where(traced, change, spread) * fading
    height = visible.height + torch.from_numpy(spread.astype(np.float32))
    return replace(visible, height=height)


def off_map_stretches(evidence: Evidence, robot: RobotModel) -> np.ndarray:
    """Start and end of each stretch in which any part of the robot may be off the map, ``[n, 2]`` int64 [ns].

    Beyond its edge a map says nothing: heights there would be those of the edge.
    """
    terrain, motion = evidence.terrain, evidence.smoothed.motion
    if terrain is None or evidence.odometry_from_terrain is None or not len(motion):
        return np.zeros((0, 2), np.int64)
    places = transform_points(np.linalg.inv(evidence.odometry_from_terrain), motion.positions)[:, :2]
    left, right, bottom, top = terrain.grid.extent
    low, high = np.array([left, bottom]) + reach_of(robot), np.array([right, top]) - reach_of(robot)
    off = ((places < low) | (places > high)).any(axis=1)
    found = []
    for part in evidence.smoothed.stretches:
        stamps = motion.stamps[part]
        # Between two poses the robot is where either of them says: the stretch reaches to the neighbours.
        found += [
            (stamps[max(first - 1, 0)], stamps[min(last + 1, len(stamps) - 1)]) for first, last in runs(off[part])
        ]
    return np.array(found, np.int64).reshape(-1, 2)


def terrain_uncertainty(
    robot: RobotModel, data: EvidenceWindows, split: tuple[TerrainMap, TerrainMap] | None
) -> np.ndarray:
    """Residuals that errors of the map cause in each window with a perfect robot model, ``[W, K, C]``.

    It has two parts, both measured on the maps at hand. Predictions on maps from every other sweep differ by twice the
    effect of the whole map's noise. And predictions on the map at half its resolution differ by as much as the map's
    own resolution leaves open, if errors are of first order in the cell size (Richardson). Half of the squares is that
    of the window, half that of all windows, for a single difference is a poor estimate of a standard deviation.
    Zero on level ground.
    """
    shape = (len(data.starts), len(data.samples), len(data.components))
    if data.terrain is None:
        return np.zeros(shape)

    def predicted(terrain: TerrainMap) -> np.ndarray:
        return np.nan_to_num(Predictions(robot, replace(data, terrain=terrain)).residuals([()])[0])

    reference = predicted(data.terrain)
    parts = [predicted(coarsened(data.terrain)) - reference]
    if split is not None:
        parts.append(0.5 * (predicted(split[0]) - predicted(split[1])))
    squares = np.zeros(shape)
    for part in parts:
        # Robust: a single window with a spurious step under a wheel must not raise the uncertainty of all others.
        common = np.quantile(np.abs(part), 0.683, axis=0)
        squares += 0.5 * part**2 + 0.5 * common**2
    return np.sqrt(squares)


def coarsened(terrain: TerrainMap) -> TerrainMap:
    """The map with heights averaged over two by two cells, on the same grid."""

    def halved(values: torch.Tensor) -> torch.Tensor:
        rows, columns = values.shape
        even = torch.nn.functional.pad(values[None, None], (0, columns % 2, 0, rows % 2), mode="replicate")
        small = torch.nn.functional.avg_pool2d(even, 2)
        large = torch.nn.functional.interpolate(small, scale_factor=2, mode="bilinear", align_corners=False)
        return large[0, 0, :rows, :columns]

    return replace(terrain, height=halved(terrain.height), geometric_height=halved(terrain.geometric_height))
