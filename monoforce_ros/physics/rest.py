"""Rest: depth to which a robot sinks into level ground under its weight."""

from __future__ import annotations

from typing import overload

import numpy as np

from monoforce_ros.robots import RobotModel


@overload
def rest_depth(robot: RobotModel, stiffness: float, *, gravity: float = 9.81) -> float: ...
@overload
def rest_depth(robot: RobotModel, stiffness: np.ndarray, *, mass: np.ndarray, gravity: float = 9.81) -> np.ndarray: ...
def rest_depth(
    robot: RobotModel, stiffness: float | np.ndarray, *, mass: np.ndarray | None = None, gravity: float = 9.81
) -> float | np.ndarray:
    """Penetration [m] of the lowest driven point at which level ground of ``stiffness`` [N/m³] supports the robot.

    Solves ``Σ k A_i (δ - d_i)₊ = M g`` for δ, where d_i is the height of point i above the lowest one. The left side is
    linear between one point's contact and the next one's.

    Args:
        robot: its points, and its mass unless that is given.
        stiffness: of the ground [N/m³], a number or ``[N]``.
        mass: that the ground carries [kg], like ``stiffness``.
        gravity: [m/s²].
    """
    driven = robot.point_drives >= 0
    heights = robot.points[driven][:, 2].double().cpu().numpy()
    order = np.argsort(heights, kind="stable")
    gaps = heights[order] - heights[order[0]]
    areas = robot.point_areas[driven].double().cpu().numpy()[order]
    carrying, volumes = np.cumsum(areas), np.cumsum(areas * gaps)
    # Volume that the points displace when the next one touches.
    touching = carrying[:-1] * gaps[1:] - volumes[:-1]
    carried = float(robot.mass.double().mean()) if mass is None else mass
    needed = np.asarray(carried) * gravity / np.asarray(stiffness)
    last = np.searchsorted(touching, needed)
    depth = (needed + volumes[last]) / carrying[last]
    return float(depth) if mass is None and np.ndim(stiffness) == 0 else depth
