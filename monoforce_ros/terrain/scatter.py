"""Scatter: how thin what returns a lidar's pulses is, seen from above: millimetres of walls, decimetres of leaves."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.terrain.grid import Grid


def horizontal_scatter(points: np.ndarray, cells: np.ndarray, reach: int, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of points along the horizontal direction in which they vary least, in squares of cells.

    Args:
        points: ``[n, 2]`` or ``[n, 3]`` [m], relative to about the map's centre: sums of squares keep their digits.
        cells: flat index of the cell of each point ``[n]``.
        reach: half-width of the squares [cells].
        grid: cells of the map.

    Returns:
        the standard deviation ``[rows, columns]`` [m], 0 without points; the number of points of each square.
    """
    x, y = points[:, 0], points[:, 1]
    sums = [_summed(cells, values, reach, grid) for values in (np.ones_like(x), x, y, x * x, y * y, x * y)]
    count = sums[0]
    mean_x, mean_y, xx, yy, xy = (values / np.maximum(count, 1.0) for values in sums[1:])
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(least, 0.0)), count


def _summed(cells: np.ndarray, values: np.ndarray, reach: int, grid: Grid) -> np.ndarray:
    """Sums over squares of cells, ``[rows, columns]``."""
    window = (2 * reach + 1, 2 * reach + 1)
    counted = np.bincount(cells, values, grid.rows * grid.columns).reshape(grid.rows, grid.columns)
    return cv2.boxFilter(counted, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
