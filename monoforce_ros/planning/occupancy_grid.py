"""Occupancy: traversability costs of a terrain map as in Nav2: 0 free to 100 lethal, -1 unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from monoforce_ros.planning.goal_planner import LETHAL, UNKNOWN
from monoforce_ros.terrain import TerrainMap

_SLOPE_BASE = 0.5
"""Length over which slopes are measured [m]."""


@dataclass(frozen=True)
class Occupancy:
    """A grid of costs, aligned with the axes of the odometry frame as costmaps require."""

    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float]
    """x and y of the corner of cell (0, 0) in the odometry frame [m]."""
    height: float
    """z of the robot's base in the odometry frame [m]."""
    data: np.ndarray
    """Costs ``[rows, columns]`` int8."""


def occupancy(
    terrain: TerrainMap, odometry_from_terrain: np.ndarray, *, slope_limit: float, step_limit: float
) -> Occupancy:
    """Costs of a terrain map's cells.

    Args:
        terrain: a single map.
        odometry_from_terrain: its pose ``[4, 4]``, level.
        slope_limit: steepest feasible slope [rad]; the cost grows in proportion to the slope.
        step_limit: highest feasible step between neighbouring cells [m]; the cost grows in proportion to the step.

    Raises:
        ValueError: a limit is out of its range.
    """
    if not (0.01 <= slope_limit < 1.5 and 0.001 <= step_limit <= 5.0):
        raise ValueError(
            f"occupancy limits: got a slope of {slope_limit} rad and a step of {step_limit} m, expected 0.01 to 1.5 "
            "rad and 0.001 to 5 m"
        )
    grid = terrain.grid
    height = terrain.height.detach().cpu().double().numpy()
    smooth = uniform_filter(height, max(1, round(_SLOPE_BASE / grid.resolution)), mode="nearest")
    slope = np.arctan(np.hypot(*np.gradient(smooth, grid.resolution)))
    # The height range over three cells, minus the contribution of the slope.
    span = maximum_filter(height, 3, mode="nearest") - minimum_filter(height, 3, mode="nearest")
    step = np.maximum(0.0, span - 2.0 * grid.resolution * np.tan(np.minimum(slope, 1.4)))
    share = np.maximum(slope / slope_limit, step / step_limit)
    cost = np.where(share >= 1.0, LETHAL, np.minimum(LETHAL - 1, np.rint(100.0 * share))).astype(np.int8)
    cost = np.where(terrain.measured_nearby(), cost, UNKNOWN).astype(np.int8)
    return _aligned(cost, terrain, odometry_from_terrain)


def _aligned(cost: np.ndarray, terrain: TerrainMap, pose: np.ndarray) -> Occupancy:
    """The map resampled along the axes of the odometry frame by nearest neighbour."""
    grid = terrain.grid
    left, right, bottom, top = grid.extent
    corners = np.array([[left, bottom], [left, top], [right, bottom], [right, top]]) @ pose[:2, :2].T + pose[:2, 3]
    low = np.floor(corners.min(axis=0) / grid.resolution)
    high = np.ceil(corners.max(axis=0) / grid.resolution)
    columns, rows = (high - low).astype(int)
    x = (low[0] + np.arange(columns) + 0.5) * grid.resolution
    y = (low[1] + np.arange(rows) + 0.5) * grid.resolution
    there = np.stack(np.meshgrid(x, y), axis=-1) - pose[:2, 3]
    row, column, inside = grid.cells(there @ pose[:2, :2])
    data = np.where(inside, cost[row, column], UNKNOWN).astype(np.int8)
    return Occupancy(grid.resolution, (low[0] * grid.resolution, low[1] * grid.resolution), float(pose[2, 3]), data)
