"""Drive loads: how much each drive carries of the robot that stands, beside what the robot of its file would.

A motor loses speed in proportion to its torque, not to that torque's share of the wheel's load: under a payload the
drives that carry more of it pull more, and lose more speed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.robots import RobotModel

_LEAST = 0.1
"""Smallest load, as a share: a robot that leans so much stands on other points than this assumes."""


def drive_loads(robot: RobotModel, mass: Tensor, centre_of_mass: Tensor) -> Tensor:
    """Load of each drive on level ground as a share of what it would be of the robot's file with a centred mass.

    A rigid body on equal springs under all wheels and tracks has loads that are linear in place: with points p of mean
    m and covariance S, and the centre of mass at c, they are in proportion to 1 + (c - m)' S⁻¹ (p - m).

    Args:
        robot: as in its file.
        mass: of the robot with what it carries, ``[B]`` [kg].
        centre_of_mass: of that in the base frame, ``[B, 3]`` [m].

    Returns:
        ``[B, D]``, at least 0.1.
    """
    mean, inverse, places = _stance.get((robot.points, robot.point_drives, robot.point_areas), lambda: _standing(robot))
    lean = (centre_of_mass[:, :2] - mean) @ inverse
    shares = 1.0 + lean @ (places - mean).T
    return ((mass / robot.mass)[:, None] * shares).clamp_min(_LEAST)


def _standing(robot: RobotModel) -> tuple[Tensor, Tensor, Tensor]:
    """Mean ``[2]``, inverse covariance ``[2, 2]`` of the points of wheels and tracks, and means by drive ``[D, 2]``."""
    points, drives, areas = robot.points[:, :2], robot.point_drives, robot.point_areas
    weights = areas * (drives >= 0)
    mean = (weights[:, None] * points).sum(0) / weights.sum()
    away = points - mean
    covariance = (weights[:, None, None] * away[:, :, None] * away[:, None]).sum(0) / weights.sum()
    covariance = covariance + 1e-6 * torch.eye(2, dtype=points.dtype, device=points.device)
    places = []
    for drive in range(len(robot.drive_offsets)):
        own = areas * (drives == drive)
        places.append((own[:, None] * points).sum(0) / own.sum().clamp_min(1e-9) if own.any() else mean)
    return mean, torch.linalg.inv(covariance), torch.stack(places)


_stance: IdentityCache[tuple[Tensor, Tensor, Tensor]] = IdentityCache()
