"""Lidar cloud → terrain map: heights of the cells with returns, interpolated in between (the paper's [19])."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from monoforce_ros.terrain.grid import Grid
from monoforce_ros.terrain.overhead import beyond_gap, by_cell_and_height
from monoforce_ros.terrain.scatter import horizontal_scatter
from monoforce_ros.terrain.terrain_map import TerrainDefaults, TerrainMap, polar


@dataclass(frozen=True)
class LidarSettings:
    """Parameters of the conversion from cloud to height map."""

    lowest: float = -4.0
    """Returns further below the robot are ignored as errors [m]."""
    highest: float = 3.0
    """Returns further above the robot are ignored as harmless [m]."""
    headroom: float = 0.9
    """Vertical gap that the robot passes under; returns above such a gap are ignored [m]."""
    quantile: float = 0.75
    """Quantile of a cell's returns that is its height: above the median, so that edges of obstacles count [-]."""
    minimum_cells: int = 20
    """Smallest number of observed cells of a map."""

    def __post_init__(self):
        if not self.lowest < self.highest:
            raise ValueError(f"lowest: got {self.lowest} m, expected less than highest = {self.highest} m")
        if not 0.0 <= self.quantile <= 1.0:
            raise ValueError(f"quantile: got {self.quantile}, expected 0 to 1")


_NEARBY = 0.5
"""Radius of the search for the ground of a cell [m]; slopes up to 45° are allowed within it."""


_TALL = 0.5
"""Height above the ground that carries the robot [m] from which something nearby is a wall: more than the shipped
robots climb (1.45 wheel radii, of the Warthog 0.44 m). Lower things may be grass, between whose edges the robot would
stand."""
_BLIND = 2.0
"""Distance from the robot within which a lidar on it may not see the foot of a wall [m]: one 1 m up, whose lowest ring
points 25° down, sees ground from there on."""


_FACE = 0.2
"""Height of a cell's returns above its lowest from which they may be a wall, not a slope, which rises by no more than
its cell is wide [m]."""
_THIN, _THIN_WITHIN, _FEWEST_OF_A_FACE = 0.035, 0.25, 10
"""Scatter of surfaces that are thin seen from above [m], within such a distance [m], and returns that tell it. Leaves
within it scatter by 0.14 m, and a lidar's noise by 0.02 to 0.03 m."""


class TerrainError(ValueError):
    """The measurements do not suffice for a map."""


def terrain_from_cloud(
    points: np.ndarray,
    grid: Grid,
    *,
    settings: LidarSettings = LidarSettings(),
    material: TerrainDefaults = TerrainDefaults(),  # noqa: B008
    support: np.ndarray | None = None,
) -> TerrainMap:
    """Terrain map of a lidar cloud.

    Args:
        points: returns ``[n, 3]`` [m] in the terrain frame, without those from the robot's body.
        grid: cells of the map.
        settings: parameters of the conversion.
        material: material of all cells.
        support: ground contact points ``[m, 3]`` [m] of the robot. They determine ``height`` in their cells, which the
            lidar does not see; ``geometric_height`` and ``observed`` stay unchanged.

    Returns:
        float32 map; cells without a return have interpolated heights and are False in ``observed``.

    Raises:
        TerrainError: too few cells have returns.
    """
    (heights, lowest), observed = cell_quantiles(points, grid, settings, (settings.quantile, 0.0))
    require_cells(int(observed.sum()), len(points), grid, settings)
    visible = fill_holes(heights, observed)
    if support is None:
        ground = visible
    else:
        faces = observed & (heights - lowest > _FACE)
        feet = heights
        if faces.any():
            feet = np.where(faces & _thin(points, lowest, faces, grid, settings), lowest, heights)
        ground = interpolated_ground(heights, observed, support, grid, feet)
    return TerrainMap.from_height(
        torch.from_numpy(ground.astype(np.float32)),
        grid,
        geometric_height=torch.from_numpy(visible.astype(np.float32)),
        observed=torch.from_numpy(observed),
        material=material,
    )


def require_cells(count: int, returns: int, grid: Grid, settings: LidarSettings = LidarSettings()) -> None:
    """Raise ``TerrainError`` if ``returns`` of a lidar hit too few cells of a map."""
    if count < settings.minimum_cells:
        raise TerrainError(
            f"the cloud's {returns} returns hit {count} cells of the {grid.extent[1]:.1f} m map, "
            f"expected at least {settings.minimum_cells}: is the lidar's frame right, is it covered?"
        )


def _thin(points: np.ndarray, lowest: np.ndarray, faces: np.ndarray, grid: Grid, settings: LidarSettings) -> np.ndarray:
    """Cells ``[rows, columns]`` of ``faces`` where what rises above the ground is a surface, and no vegetation."""
    reach = max(1, round(_THIN_WITHIN / grid.resolution))
    near = cv2.dilate(faces.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).ravel() > 0
    rows, columns, inside = grid.cells(points[:, :2])
    flat = rows * grid.columns + columns
    inside &= near[np.where(inside, flat, 0)]
    flat, place = flat[inside], points[inside]
    rising = (place[:, 2] > lowest.ravel()[flat] + 0.5 * _FACE) & (place[:, 2] < settings.highest)
    scatter, count = horizontal_scatter(place[rising], flat[rising], reach, grid)
    return (count >= _FEWEST_OF_A_FACE) & (scatter < _THIN)


def interpolated_ground(
    heights: np.ndarray, observed: np.ndarray, support: np.ndarray, grid: Grid, feet: np.ndarray | None = None
) -> np.ndarray:
    """Ground between cells whose heights are known, through the robot's contact points.

    Args:
        heights: height of each cell ``[rows, columns]`` [m].
        observed: cells whose height is known.
        support: ground contact points ``[m, 3]`` [m] of the robot, whose cells take their height; may be empty.
        grid: cells of the map.
        feet: heights ``[rows, columns]`` [m] between which ground is interpolated as well, and taken where it is lower:
            those of the foot of a wall, which a blind zone before it would otherwise make a ramp. The robot is at the
            origin of the map's frame.
    """
    rows, columns, inside = grid.cells(support[:, :2])
    if not inside.any():
        return fill_holes(heights, observed)
    known, where = heights.copy(), observed.copy()
    rows, columns = rows[inside], columns[inside]
    known[rows, columns] = np.inf
    np.minimum.at(known, (rows, columns), support[inside, 2])
    where[rows, columns] = True
    ground = fill_holes(known, where)
    # A wall nearby casts a blind zone before it: interpolated, its height would begin below the robot.
    if (tall := observed & _tall_nearby(heights, support[inside], grid)).any():
        ground = np.where(where, ground, np.minimum(ground, fill_holes(known, where & ~tall)))
    if feet is not None and (faces := observed & (feet < heights)).any():
        known = np.where(faces, np.minimum(feet, known), known)
        # Behind a face its top is the neighbour, not its foot.
        distance, sector = polar(grid)
        nearest = np.full(int(sector.max()) + 1, np.inf)
        np.minimum.at(nearest, sector[faces], distance[faces])
        # A face seen in every second direction goes on between them; where there is none nothing changes.
        nearest = np.min([np.roll(nearest, by) for by in (-1, 0, 1)], axis=0)
        before = ~where & (distance < np.where(np.isinf(nearest), 0.0, nearest)[sector])
        ground = np.where(before, np.minimum(ground, fill_holes(known, where)), ground)
    return ground


def _tall_nearby(heights: np.ndarray, support: np.ndarray, grid: Grid) -> np.ndarray:
    """Cells ``[rows, columns]`` near a robot at rest on support points, of walls, trunks and banks."""
    x, y = np.meshgrid(grid.x, grid.y)
    columns = np.column_stack([support[:, :2], np.ones(len(support))])
    # Of the least slope through the points, if they lie on a line.
    plane = np.linalg.lstsq(columns, support[:, 2], rcond=1e-3)[0]
    level = plane[0] * x + plane[1] * y + plane[2]
    middle = support[:, :2].mean(axis=0)
    return (heights - level > _TALL) & (np.hypot(x - middle[0], y - middle[1]) < _BLIND)


def cell_heights(points: np.ndarray, grid: Grid, settings: LidarSettings) -> tuple[np.ndarray, np.ndarray]:
    """Height of each cell with returns, ``[rows, columns]`` [m], and the mask of these cells."""
    heights, observed = cell_quantiles(points, grid, settings, (settings.quantile,))
    return heights[0], observed


def cell_quantiles(
    points: np.ndarray, grid: Grid, settings: LidarSettings, quantiles: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles of the heights of each cell's returns, ``[quantiles, rows, columns]`` [m], and the mask of cells with
    returns; those above a gap, which the robot passes under, do not count."""
    z = points[:, 2]
    rows, columns, inside = grid.cells(points[:, :2])
    inside &= (z > settings.lowest) & (z < settings.highest)
    flat, z = (rows * grid.columns + columns)[inside], z[inside]
    heights = np.zeros((len(quantiles), grid.rows * grid.columns))
    observed = np.zeros((grid.rows, grid.columns), bool)
    shape = (len(quantiles), grid.rows, grid.columns)
    if not len(z):
        return heights.reshape(shape), observed
    order = by_cell_and_height(flat, z)
    flat, z = flat[order], z[order]
    # Within a cell, only returns below the first gap belong to the ground.
    ground = ~beyond_gap(flat, z, settings.headroom)
    flat, z = flat[ground], z[ground]
    starts = np.flatnonzero(np.r_[True, flat[1:] != flat[:-1]])
    standing = stands_on_ground(z[starts], flat[starts], grid, settings)
    counts = np.diff(np.r_[starts, len(flat)])
    for row, quantile in zip(heights, quantiles, strict=True):
        position = starts + (counts - 1) * quantile
        below = np.floor(position).astype(np.int64)
        above = np.minimum(below + 1, starts + counts - 1)
        values = z[below] + (position - below) * (z[above] - z[below])
        row[flat[starts][standing]] = values[standing]
    observed.ravel()[flat[starts][standing]] = True
    return heights.reshape(shape), observed


def stands_on_ground(lowest: np.ndarray, cells: np.ndarray, grid: Grid, settings: LidarSettings) -> np.ndarray:
    """Which cells' lowest returns belong to the ground or to objects on it, rather than to an overhanging crown.

    A crown without returns from the ground below it lies far above the lowest return nearby; objects on the ground have
    returns at their foot.
    """
    floor = np.full((grid.rows, grid.columns), np.inf, np.float32)
    floor.ravel()[cells] = lowest
    reach = max(1, round(_NEARBY / grid.resolution))
    nearby = cv2.erode(floor, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=np.inf)
    return lowest <= nearby.ravel()[cells] + settings.headroom + _NEARBY


def fill_holes(heights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Interpolate smoothly into cells that are not ``known``; known cells keep their value.

    A pyramid of weighted averages (push–pull, Gortler et al. 1996): each hole takes its value from the finest level at
    which it has neighbours, so that narrow gaps are filled locally and wide ones by the trend around them.
    """
    levels = [(np.where(known, heights, 0.0).astype(np.float32), known.astype(np.float32))]
    while min(levels[-1][0].shape) > 1 and (levels[-1][1] < 1.0).any():
        weighted, weight = levels[-1]
        coarser_weight = cv2.pyrDown(weight, borderType=cv2.BORDER_REFLECT_101)
        coarser = cv2.pyrDown(weighted * weight, borderType=cv2.BORDER_REFLECT_101)
        value = np.where(coarser_weight > 1e-6, coarser / np.maximum(coarser_weight, 1e-6), 0.0)
        # A coarse cell with data in a quarter of its area counts fully.
        levels.append((value.astype(np.float32), np.minimum(1.0, 4.0 * coarser_weight).astype(np.float32)))
    filled = levels[-1][0]
    for value, weight in reversed(levels[:-1]):
        coarse = cv2.pyrUp(filled, dstsize=(value.shape[1], value.shape[0]))
        filled = weight * value + (1.0 - weight) * coarse
    return np.where(known, heights, filled)
