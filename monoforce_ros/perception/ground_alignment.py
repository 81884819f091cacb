"""Footing: what is known of the ground because the robot stands on it, put into maps that sensors made."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.physics import rest_depth
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_LAID_FROM, _LAID_TO = 0.15, 0.7
"""Distances from the wheels up to which a map is shifted to where the robot stands, and beyond which not [m]."""

_ALLOWED = 0.03
"""How far ground may reach above the lowest point of a wheel or track within a cell [m]."""


def support_points(robot: RobotModel, motion: MotionState, stiffness: float) -> np.ndarray:
    """Where the ground must be under the wheels of a robot that stands or drives on it, ``[m, 3]`` in terrain axes."""
    lowest = robot.points[robot.point_tangents[:, 0] < -0.97].numpy()
    points = transform_points(motion.terrain_from_base, lowest.astype(np.float64))
    points[:, 2] += rest_depth(robot, stiffness)
    return points


def aligned_to_ground(terrain: TerrainMap, support: np.ndarray) -> TerrainMap:
    """A predicted map that meets the ground under the robot's wheels, which is known better than any image tells.

    Heights are shifted to where those that carry meet the points ``[m, 3]`` on which the robot stands, less so with the
    distance from them. What stands above the ground is shifted along: its height is what vegetation holds the robot by.
    A robot that starts below a predicted surface would be thrown off it.
    """
    grid = terrain.grid
    rows, columns, inside = grid.cells(support[:, :2])
    if not inside.any():
        return terrain
    points = support[inside]
    short = points[:, 2] - terrain.height.numpy()[rows[inside], columns[inside]]
    # Nothing moves beyond this window; most of the map need not be looked at.
    (left, bottom), (right, top) = points[:, :2].min(axis=0) - _LAID_TO, points[:, :2].max(axis=0) + _LAID_TO
    across = slice(*np.searchsorted(grid.x, (left, right)))
    up = slice(*np.searchsorted(grid.y, (bottom, top)))
    x, y = np.meshgrid(grid.x[across], grid.y[up])
    away = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1])
    nearness = 1.0 / (away + 0.05) ** 2
    shift = (nearness * short).sum(axis=-1) / nearness.sum(axis=-1)
    share = np.clip((_LAID_TO - away.min(axis=-1)) / (_LAID_TO - _LAID_FROM), 0.0, 1.0)
    height = terrain.height.clone()
    moved = torch.from_numpy((shift * share).astype(np.float32))
    height[up, across] += moved
    visible = terrain.geometric_height.clone()
    visible[up, across] += moved
    return replace(terrain, height=height, geometric_height=visible)


def clear_of(terrain: TerrainMap, robot: RobotModel, motion: MotionState) -> TerrainMap:
    """A map of which nothing reaches into the robot that stands on it.

    No sensor sees the ground below a robot; what is filled in there from a wall nearby would push it from the start.
    Cells below it are lowered to its lower side; so are those next to it of which nothing was measured.
    """
    grid, pose = terrain.grid, motion.terrain_from_base
    (rear, right), (front, left) = (bound.cpu().double().numpy()[:2] for bound in robot.bounds)
    hull = robot.points[robot.point_drives < 0]
    belly = float(hull[:, 2].min()) if len(hull) else 0.0
    if abs(np.linalg.det(pose[:2, :2])) < 0.1:  # it lies on its side
        return terrain
    # Where each cell's vertical meets the plane of the hull's lower side, in the robot's axes.
    cells = np.stack(np.meshgrid(grid.x, grid.y), axis=-1) - pose[:2, 2] * belly
    along, aside = np.moveaxis(cells @ np.linalg.inv(pose[:2, :2]).T, -1, 0)
    inside = (along > rear) & (along < front) & (aside > right) & (aside < left)
    limit = np.where(inside, pose[2, 0] * along + pose[2, 1] * aside + pose[2, 2] * belly, np.inf)
    # Wheels and tracks reach lower; between their points and the cells' centres the ground may slope.
    points = transform_points(pose, robot.points.cpu().double().numpy())
    rows, columns, on_grid = grid.cells(points[:, :2])
    np.minimum.at(limit, (rows[on_grid], columns[on_grid]), points[on_grid, 2] + _ALLOWED)
    beside = cv2.erode(limit.astype(np.float32), np.ones((3, 3), np.uint8), borderValue=np.inf)
    limit = torch.from_numpy(np.where(terrain.observed.numpy(), limit, beside)).to(terrain.height)
    if not bool((terrain.height > limit).any()):
        return terrain
    return replace(terrain, height=torch.minimum(terrain.height, limit))
