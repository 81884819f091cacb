"""Rest: depth to which a robot sinks into level ground under its weight."""

from __future__ import annotations

from monoforce_ros.robots import RobotModel


def rest_depth(robot: RobotModel, stiffness: float, *, gravity: float = 9.81) -> float:
    """Penetration [m] of the lowest driven point at which level ground of ``stiffness`` [N/m³] supports the robot.

    Solves ``Σ k A_i (δ - d_i)₊ = M g`` for δ, where d_i is the height of point i above the lowest one, by bisection.
    """
    driven = robot.point_drives >= 0
    gaps = (robot.points[driven][:, 2] - robot.points[driven][:, 2].min()).double()
    areas = robot.point_areas[driven].double()
    weight = float(robot.mass.double().mean()) * gravity
    low, high = 0.0, 1.0
    for _ in range(60):
        depth = 0.5 * (low + high)
        force = float((stiffness * areas * (depth - gaps).clamp_min(0.0)).sum())
        low, high = (depth, high) if force < weight else (low, depth)
    return high
