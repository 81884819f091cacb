"""Sweep: lidar points as network input, by cell of the map."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.encoder.config import HEIGHT_CHANNELS, EncoderConfig
from monoforce_ros.terrain import Grid, LidarSettings, cell_quantiles, horizontal_scatter, interpolated_ground

LOWEST, HIT, TOP, STANDING, BETWEEN = 0, 2, 5, 6, 7
"""Channels: the lowest point; the mask of cells with points; the height of the ground and of objects on it, and its
mask; this height interpolated over the whole map."""
_REACH = 0.25
"""Half-width of the square around a cell whose points tell a surface from leaves [m]: as deep as a lidar sees into a
hedge."""
_UPPER = 0.1
"""Height over the lowest point of the square from which a point counts [m]: the ground before a wall is none of it."""
_SCATTER_UNIT = 0.1
"""Unit of the scatter as an input [m]."""
_FEWEST = 3
"""Points that have a scatter."""


def cell_extremes(points: np.ndarray, ground: float, config: EncoderConfig) -> np.ndarray:
    """Lowest and highest point of each cell relative to ``ground`` [m], 0 without a point, and the mask of cells with
    points; ``[3, rows, columns]``."""
    return _extremes(*_placed(points, ground, config), config.grid)


def sweep_features(
    points: np.ndarray, ground: float, config: EncoderConfig, support: np.ndarray | None = None
) -> np.ndarray:
    """Features of a sweep ``[8, rows, columns]``: :func:`cell_extremes`, scatter and number of the upper points nearby,
    the height of the ground and of objects on it with its mask, and this height interpolated through the contacts.

    Leaves return a lidar's pulses from various depths, a wall from one plane, whatever they look like. The scatter is
    the standard deviation of points along the horizontal direction in which they vary least: millimetres on walls,
    posts and trunks, decimetres in vegetation (Lalonde et al., "Natural terrain classification using three-dimensional
    ladar data for ground robot mobility", 2006, distinguish them so in three dimensions).

    Args:
        points: ``[n, 3]`` in the terrain frame [m].
        ground: height of the ground under the robot [m].
        config: configuration of the encoder.
        support: contact points of the wheels ``[m, 3]`` in the terrain frame [m].
    """
    grid = config.grid
    placed, flat = _placed(points, ground, config)
    extremes = _extremes(placed, flat, grid)
    lowest = np.where(extremes[HIT] > 0, extremes[0], np.inf).astype(np.float32)
    reach = max(1, round(_REACH / grid.resolution))
    window = (2 * reach + 1, 2 * reach + 1)
    floor = cv2.erode(lowest, np.ones(window, np.uint8), borderValue=np.inf).ravel()
    upper = placed[:, 2] > floor[flat] + _UPPER
    thinnest, count = horizontal_scatter(placed.compress(upper, axis=0), flat[upper], reach, grid)
    scatter = np.where(count >= _FEWEST, thinnest, 0.0) / _SCATTER_UNIT
    top, standing = _standing(placed, extremes, config)
    between = np.zeros_like(top)
    if standing.any():
        contacts = np.zeros((0, 3)) if support is None else support - np.array([0.0, 0.0, ground])
        between = interpolated_ground(top, standing, contacts, grid)
    return np.concatenate([extremes, [scatter, np.log1p(count), top, standing, between]])


def _standing(placed: np.ndarray, extremes: np.ndarray, config: EncoderConfig) -> tuple[np.ndarray, np.ndarray]:
    """Height of what stands on the ground in each cell [m], and the mask of cells with it.

    On the ground the height is that of the lidar map, whose quantile noise affects less than the highest point; of what
    rises from it, the highest point, but below gaps: a robot passes under branches.
    """
    limits = LidarSettings(lowest=config.lowest, highest=config.highest)
    (usual, highest), standing = cell_quantiles(placed, config.grid, limits, (limits.quantile, 1.0))
    low, high, _ = extremes
    return np.where(high - low > _UPPER, highest, usual), standing


def _placed(points: np.ndarray, ground: float, config: EncoderConfig) -> tuple[np.ndarray, np.ndarray]:
    """Points on the map, relative to ``ground``, and their cells."""
    grid = config.grid
    raised = np.asarray(points, float) - np.array([0.0, 0.0, ground])
    rows, columns, inside = grid.cells(raised[:, :2])
    inside &= (raised[:, 2] > config.lowest) & (raised[:, 2] < config.highest)
    return raised.compress(inside, axis=0), (rows * grid.columns + columns)[inside]


def _extremes(placed: np.ndarray, flat: np.ndarray, grid: Grid) -> np.ndarray:
    low, high = np.full(grid.rows * grid.columns, np.inf), np.full(grid.rows * grid.columns, -np.inf)
    np.minimum.at(low, flat, placed[:, 2])
    np.maximum.at(high, flat, placed[:, 2])
    hit = np.isfinite(low)
    stacked = np.stack([np.where(hit, low, 0.0), np.where(hit, high, 0.0), hit])
    return stacked.reshape(HEIGHT_CHANNELS, grid.rows, grid.columns)
