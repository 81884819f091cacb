"""Overhead: returns of ceilings, crowns and bridges, which a robot passes under; found from the ground under it."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.terrain.grid import Grid
from monoforce_ros.terrain.terrain_map import polar

_SLOPES = (0.2, 0.5)
"""Slopes across gaps between returns at which ground is sought, gentle first, so that ground behind a gap is found
before the ceiling over it. The last one, 27°, is about what robots climb."""
_ROUGHNESS = 0.2
"""Height differences of ground besides its slope [m]."""
_NEXT, _STEP = 0.25, 0.5
"""Neighbouring returns at most so far apart [m] are ground together if the height differs by no more than that [m]:
banks of up to 63° go on, ceilings over the foot of a wall do not."""
_MOST_ROUNDS = 12
_EDGE = 0.3
"""How far the top of a wall may be above its highest return [m]: rings of a lidar are apart."""


class GroundReference:
    """Height of the nearest ground of each cell, grown outwards from the ground under the robot.

    Args:
        lowest: lowest return of each cell ``[rows, columns]`` [m]; infinite without one.
        support: points of the ground under the wheels ``[m, 3]`` [m].
        grid: cells of the map.
    """

    def __init__(self, lowest: np.ndarray, support: np.ndarray, grid: Grid):
        self._lowest, self._resolution = lowest, grid.resolution
        self.known = np.zeros(lowest.shape, bool)
        """Cells whose lowest return, or the wheels, are on the ground ``[rows, columns]``."""
        self._heights = lowest.astype(np.float32)
        rows, columns, inside = grid.cells(support[:, :2])
        rows, columns = rows[inside], columns[inside]
        self._heights[rows, columns] = np.inf
        np.minimum.at(self._heights, (rows, columns), support[inside, 2].astype(np.float32))
        self.known[rows, columns] = True
        if inside.any():
            self._grow()
        else:
            self.height, self.distance = np.full(lowest.shape, -np.inf, np.float32), np.zeros(lowest.shape, np.float32)

    def _grow(self) -> None:
        hit = np.isfinite(self._lowest)
        for slope in _SLOPES:
            for _ in range(_MOST_ROUNDS):
                self._look_around()
                rise = self._lowest - self.height
                ground = rise <= slope * self.distance + _ROUGHNESS
                ground |= (self.distance <= _NEXT) & (rise <= _STEP)
                found = hit & ground & ~self.known
                if not found.any():
                    break
                self.known |= found
        self._look_around()

    def _look_around(self) -> None:
        """Height of the nearest ground [m] and how far away it is [m]."""
        away, labels = cv2.distanceTransformWithLabels(
            (~self.known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        heights = np.zeros(int(labels.max()) + 1, np.float32)
        heights[labels[self.known]] = self._heights[self.known]
        self.height, self.distance = heights[labels], away * self._resolution

    def headroom(self, cells: np.ndarray, z: np.ndarray) -> np.ndarray:
        """How far points at heights ``z`` [m] over flat indices of cells are above all that ground can reach [m]."""
        return z - (self.height + _SLOPES[-1] * self.distance).ravel()[cells]


def hanging_low(
    points: np.ndarray, grid: Grid, headroom: float, *, lowest: float, highest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Heights [m] and mask of cells ``[rows, columns]`` with returns above a gap of ``headroom``, the highest of each.

    Of points without overhead for a taller robot these are what it cannot pass under.
    """
    flat, z, floor, _ = _floors(points, grid, lowest, highest)
    over = _above_gaps(flat, z, floor, headroom)
    heights = np.full(grid.rows * grid.columns, -np.inf)
    np.maximum.at(heights, flat[over], z[over])
    mask = np.isfinite(heights)
    return np.where(mask, heights, 0.0).reshape(grid.rows, grid.columns), mask.reshape(grid.rows, grid.columns)


def without_overhead(
    points: np.ndarray, grid: Grid, support: np.ndarray, headroom: float, *, lowest: float, highest: float
) -> np.ndarray:
    """The points without those of what the robot passes under.

    A cell's returns are overhead if even the lowest is further above the nearest ground than the robot needs, allowing
    for a slope in between, and so are those above a gap of this height: a ceiling over a lidar's blind zone has no
    returns of the floor below it, and would be taken for ground. What lies behind a wall that rises as high is the top
    of it: a platform, a quay.

    Args:
        points: ``[n, 3]`` [m], z up.
        grid: cells of the map, with the robot at the origin of its frame; points off it are kept.
        support: points of the ground under the wheels ``[m, 3]`` [m]; without any on the map all points are kept.
        headroom: vertical gap that the robot passes under [m].
        lowest, highest: limits of the heights that a map takes [m]; points beyond are kept, and do not matter here.
    """
    flat, z, floor, inside = _floors(points, grid, lowest, highest)
    if not len(support) or not grid.cells(support[:, :2])[2].any() or not len(z):
        return points
    reference = GroundReference(floor.reshape(grid.rows, grid.columns), support, grid)
    high = (reference.headroom(np.arange(len(floor)), floor) > headroom) & np.isfinite(floor)
    above = _above_gaps(flat, z, floor, headroom)
    if high.any():
        top = np.full(len(floor), -np.inf)
        carried = ~above & ~high[flat]
        np.maximum.at(top, flat[carried], z[carried])
        high &= floor > _tops_before(top, grid) + _EDGE
    over = above | high[flat]
    keep = np.ones(len(points), bool)
    keep[np.flatnonzero(inside)[over]] = False
    # Rows by a mask: four times as fast as by an index of two axes.
    return points.compress(keep, axis=0)


def _floors(
    points: np.ndarray, grid: Grid, lowest: float, highest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flat cells and heights of the points on the map ``[k]``, the lowest of each cell ``[rows · columns]``, infinite
    without one, and which points these are ``[n]`` bool."""
    rows, columns, inside = grid.cells(points[:, :2])
    inside &= (points[:, 2] > lowest) & (points[:, 2] < highest)
    flat, z = (rows * grid.columns + columns)[inside], points[inside, 2]
    floor = np.full(grid.rows * grid.columns, np.inf)
    np.minimum.at(floor, flat, z)
    return flat, z, floor, inside


def by_cell_and_height(cells: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Order ``[n]`` of points by cell, and by height within each.

    One key in double precision is sorted ten times as fast as two. It tells heights of a map of 12.8 m in cells of
    0.1 m apart that differ by 10⁻¹¹ m or more, and those of the largest grid by 10⁻⁸ m; nearer ones come in any order.

    Args:
        cells: flat index of the cell of each point ``[n]``, up to 2²⁴.
        z: finite heights ``[n]`` [m].
    """
    if not len(z):
        return np.zeros(0, np.int64)
    low = float(z.min())
    # More than the heights' range, so that no cell reaches into the next one; a power of two multiplies exactly.
    span = 2.0 ** (np.floor(np.log2(max(float(z.max()) - low, 1.0))) + 1.0)
    return np.argsort(cells * span + (z - low))


def beyond_gap(cells: np.ndarray, z: np.ndarray, headroom: float) -> np.ndarray:
    """Points above a gap of ``headroom`` in their cell, ``[n]`` bool; sorted by cell, and by height within each."""
    first = np.r_[True, cells[1:] != cells[:-1]]
    gaps = np.cumsum(np.r_[False, ~first[1:] & (np.diff(z) > headroom)])
    return gaps > gaps[np.flatnonzero(first)][np.cumsum(first) - 1]


def _tops_before(top: np.ndarray, grid: Grid) -> np.ndarray:
    """Height of the highest of what stands nearer to the origin in the direction of each cell, ``[rows · columns]``."""
    distance, sector = polar(grid)
    ring = (distance / grid.resolution).astype(int).ravel()
    sector = sector.ravel()
    highest = np.full((int(sector.max()) + 1, int(ring.max()) + 2), -np.inf)
    # One further: what stands in the cell itself is not before it. Pairs of indices take four times as long.
    np.maximum.at(highest.ravel(), sector * highest.shape[1] + ring + 1, top)
    beside = np.max([np.roll(highest, by, axis=0) for by in (-1, 0, 1)], axis=0)
    return np.maximum.accumulate(beside, axis=1)[sector, ring]


def _above_gaps(cells: np.ndarray, z: np.ndarray, floor: np.ndarray, headroom: float) -> np.ndarray:
    """Points above a gap of ``headroom`` in their cell, ``[n]`` bool."""
    result = np.zeros(len(z), bool)
    high = np.zeros(len(floor), bool)
    high[cells[z > floor[cells] + headroom]] = True
    index = np.flatnonzero(high[cells])
    if not len(index):
        return result
    order = index[by_cell_and_height(cells[index], z[index])]
    result[order] = beyond_gap(cells[order], z[order], headroom)
    return result
