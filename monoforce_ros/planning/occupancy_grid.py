"""Occupancy: traversability costs of a terrain map as in Nav2: 0 free to 100 lethal, -1 unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import (
    distance_transform_edt,
    generate_binary_structure,
    maximum_filter,
    minimum_filter,
    uniform_filter,
)

from monoforce_ros.planning.goal_planner import LETHAL, UNKNOWN
from monoforce_ros.terrain import Grid, TerrainMap

_SLOPE_BASE = 0.5
"""Length over which slopes are measured [m]."""
_CROSS = generate_binary_structure(2, 1)
"""A cell and its neighbours along both axes."""
_BLIND_SPOT = 1.5
"""Reach of the blind spot around a robot [m]: a lidar 0.8 m high, whose lowest ring looks 28° down, sees no nearer
ground."""


GRADED = LETHAL - 2
"""Largest cost of a cell that is not lethal: Nav2 reads the value between as inscribed in an obstacle."""


@dataclass(frozen=True)
class AlignedGrid:
    """Cells along the axes of the odometry frame that cover a map at any heading.

    Their number depends on the map's size alone, and their corners lie on multiples of the resolution: a costmap that
    follows such grids need not be resized, and its cells do not shift.
    """

    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float]
    """x and y of the corner of cell (0, 0) in the odometry frame [m]."""
    height: float
    """z of the robot's base in the odometry frame [m]."""
    rows: np.ndarray
    """Row of the map at each cell ``[n, n]``."""
    columns: np.ndarray
    """Column of the map at each cell ``[n, n]``."""
    inside: np.ndarray
    """Whether each cell lies on the map ``[n, n]``."""

    @classmethod
    def around(cls, grid: Grid, odometry_from_terrain: np.ndarray) -> AlignedGrid:
        """The grid for a map with pose ``[4, 4]``, level."""
        left, right, bottom, top = grid.extent
        # The circle about the robot through the furthest corner, and a cell for the robot's place within its own.
        reach = np.hypot(max(-left, right), max(-bottom, top))
        half = int(np.ceil(reach / grid.resolution)) + 1
        place = odometry_from_terrain[:2, 3]
        low = np.floor(place / grid.resolution) - half
        x = (low[0] + np.arange(2 * half) + 0.5) * grid.resolution
        y = (low[1] + np.arange(2 * half) + 0.5) * grid.resolution
        there = np.stack(np.meshgrid(x, y), axis=-1) - place
        rows, columns, inside = grid.cells(there @ odometry_from_terrain[:2, :2])
        origin = float(low[0] * grid.resolution), float(low[1] * grid.resolution)
        return cls(grid.resolution, origin, float(odometry_from_terrain[2, 3]), rows, columns, inside)

    def resampled(self, values: np.ndarray, outside: float) -> np.ndarray:
        """Values of the map's cells ``[rows, columns]`` at these cells, by nearest neighbour ``[n, n]``."""
        return np.where(self.inside, values[self.rows, self.columns], outside).astype(values.dtype)


@dataclass(frozen=True)
class Occupancy:
    """Costs of the cells of an aligned grid."""

    grid: AlignedGrid
    data: np.ndarray
    """Costs ``[rows, columns]`` int8."""

    @property
    def resolution(self) -> float:
        """Edge of a cell [m]."""
        return self.grid.resolution

    @property
    def origin(self) -> tuple[float, float]:
        """x and y of the corner of cell (0, 0) in the odometry frame [m]."""
        return self.grid.origin

    @property
    def height(self) -> float:
        """z of the robot's base in the odometry frame [m]."""
        return self.grid.height


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
    cells = max(1, round(_SLOPE_BASE / grid.resolution))
    # Beyond the border ground goes on as it rises there.
    around = min(cells, *(count - 1 for count in height.shape))
    continued = np.pad(height, around, mode="reflect", reflect_type="odd")
    inside = slice(around, -around or None)
    smooth = uniform_filter(continued, cells, mode="nearest")
    slope = np.arctan(np.hypot(*np.gradient(smooth, grid.resolution)))[inside, inside]
    # The height range over three cells along both axes, minus the contribution of the slope, which is at most that of
    # its steepest direction. Corners of a square of cells are further apart: with them a diagonal slope were a step.
    highest = maximum_filter(height, footprint=_CROSS, mode="nearest")
    span = highest - minimum_filter(height, footprint=_CROSS, mode="nearest")
    step = np.maximum(0.0, span - 2.0 * grid.resolution * np.tan(np.minimum(slope, 1.4)))
    share = np.maximum(slope / slope_limit, step / step_limit)
    cost = np.where(share >= 1.0, LETHAL, np.minimum(GRADED, np.rint(100.0 * share))).astype(np.int8)
    # Behind an edge from which the ground drops nothing is measured; a wall stays one.
    known = terrain.measured_nearby() & ~(terrain.extrapolated() & (cost < LETHAL))
    cost = np.where(known, cost, UNKNOWN).astype(np.int8)
    aligned = AlignedGrid.around(grid, odometry_from_terrain)
    return Occupancy(aligned, aligned.resampled(cost, UNKNOWN))


SLOWEST = 20
"""Speed limit on a lethal cell, in per cent of the largest speed: a robot that got there has to leave again. Not 0,
which Nav2 reads as no limit."""


def speed_mask(found: Occupancy) -> np.ndarray:
    """Speed limits in per cent of the largest speed for Nav2's speed filter ``[rows, columns]`` int8; 0 is no limit.

    The limit falls linearly with the cost, to :data:`SLOWEST` on lethal cells. The filter accepts no unknown cells: in
    the blind spot beneath the robot the limit is that of the nearest known cell, and unknown ground beyond it is
    :data:`SLOWEST`.
    """
    known = found.data >= 0
    cost = np.where(known, found.data, LETHAL)
    if known.any():
        distance, (rows, columns) = distance_transform_edt(~known, return_indices=True)
        cost = np.where(distance * found.resolution <= _BLIND_SPOT, found.data[rows, columns], cost)
    limit = np.rint(100.0 - (100.0 - SLOWEST) * np.minimum(cost, LETHAL) / LETHAL)
    return np.where(cost <= 0, 0, limit).astype(np.int8)
