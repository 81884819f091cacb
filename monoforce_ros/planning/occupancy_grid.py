"""Occupancy: where a robot cannot drive, as Nav2 takes it: 0 free to 100 lethal, -1 unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from monoforce_ros.planning.goal_planner import LETHAL, UNKNOWN
from monoforce_ros.terrain import TerrainMap

_SLOPE_BASE = 0.5
"""Length over which a slope counts as one [m]."""


@dataclass(frozen=True)
class Occupancy:
    """A map whose axes are those of the odometry frame, for costmaps know no others."""

    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float]
    """x and y of the corner of cell (0, 0) in the odometry frame [m]."""
    height: float
    """Of the robot's base [m]."""
    data: np.ndarray
    """``[rows, columns]`` int8."""


def occupancy(
    terrain: TerrainMap, odometry_from_terrain: np.ndarray, *, slope_limit: float, step_limit: float
) -> Occupancy:
    """Costs of a terrain map's cells.

    Args:
        terrain: one map, whose height carries.
        odometry_from_terrain: its pose ``[4, 4]``, level.
        slope_limit: steepest slope [rad]; cells are the costlier the nearer they come to it.
        step_limit: highest step between neighbouring cells that wheels or tracks climb [m].
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
    # Half the span over three cells: the slope within a cell is not a step.
    span = maximum_filter(height, 3, mode="nearest") - minimum_filter(height, 3, mode="nearest")
    step = np.maximum(0.0, span - 2.0 * grid.resolution * np.tan(np.minimum(slope, 1.4)))
    share = np.maximum(slope / slope_limit, step / step_limit)
    cost = np.where(share >= 1.0, LETHAL, np.minimum(LETHAL - 1, np.rint(100.0 * share))).astype(np.int8)
    cost = np.where(terrain.measured_nearby(), cost, UNKNOWN).astype(np.int8)
    return _aligned(cost, terrain, odometry_from_terrain)


def _aligned(cost: np.ndarray, terrain: TerrainMap, pose: np.ndarray) -> Occupancy:
    """The map turned into the odometry frame's axes; each new cell takes the old one that it lies in."""
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
