"""Ground alignment: corrections of terrain maps by the ground contact of the robot, whose pose is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import ConvexHull

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.physics import IdentityCache, rest_depth
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_FULL_WITHIN, _NONE_BEYOND = 0.15, 0.7
"""Distances from the support points up to which heights are fully corrected, and beyond which not at all [m]."""

_AROUND = (0.8, 2.5)
"""Distances of the ground around the robot that is compared with the ground under its wheels [m]: beyond what is
corrected, and within twice the length of most robots."""
_APART = 0.6
"""Height difference on three of four sides beyond which the ground around a robot is none that carries it [m]: on a
mound with sides of 23° it is as much, in a ditch only on two sides."""
_FEWEST_RETURNS = 20
"""Returns that say something of one side: their fifth is four."""
_ON_THE_GROUND = 0.02
"""How far above the lowest facet of its tracks a point of a robot on its flippers may be to touch the ground [m]."""
_FOOT = 0.05
"""Height up to which the lowest points of a robot may touch uneven ground [m]."""
_LEAST_DOWN = 0.2
"""Vertical component of the normal of a facet that may carry a robot: steeper ones are its sides."""
_AT_THE_BOTTOM = -0.97
"""Largest forward component of the surface's direction of motion at the bottom of a wheel, which rolls backwards."""


def support_points(robot: RobotModel, motion: MotionState, stiffness: float) -> np.ndarray:
    """Points ``[m, 3]`` [m] on the ground under the wheels of a robot at rest on it, in terrain axes.

    Args:
        robot: its wheels or tracks.
        motion: the robot's pose.
        stiffness: stiffness of the ground [N/m³]; the wheels sink in by the rest depth.
    """
    points = transform_points(motion.terrain_from_base, lowest_points(robot))
    points[:, 2] += rest_depth(robot, stiffness)
    return points


def posed_robot(robot: RobotModel, flipper_angles: np.ndarray | None) -> RobotModel:
    """A robot with its flippers as measured ``[F]`` [rad]; NaN, or None: as in its file."""
    if flipper_angles is None or not robot.flippers or robot.flipper_angles is None:
        return robot
    at_rest = robot.flipper_angles.double().cpu().numpy()
    return robot.posed(torch.from_numpy(np.where(np.isfinite(flipper_angles), flipper_angles, at_rest)))


_STANDING: IdentityCache[tuple[RobotModel, np.ndarray]] = IdentityCache(8)
"""What an encoder, its fallback, their comparison and the memory all ask for at one time."""


def standing(
    robot: RobotModel, flipper_angles: np.ndarray | None, motion: MotionState, stiffness: float
) -> tuple[RobotModel, np.ndarray]:
    """A robot with its flippers as measured, and the ground under it as of :func:`support_points`.

    What carries a robot on its flippers is the facet of the convex hull of its tracks that lies below its centre of
    mass.

    Args:
        robot: as in its file.
        flipper_angles: see :func:`posed_robot`.
        motion: its pose.
        stiffness: of the ground [N/m³].
    """

    def found() -> tuple[RobotModel, np.ndarray]:
        posed = posed_robot(robot, flipper_angles)
        if posed is robot:
            return robot, support_points(robot, motion, stiffness)
        return posed, _carrying(posed, motion) + np.array([0.0, 0.0, rest_depth(robot, stiffness)])

    return _STANDING.get((robot, motion, flipper_angles), found, values=stiffness)


def _carrying(posed: RobotModel, motion: MotionState) -> np.ndarray:
    """Points of the tracks of a robot on its flippers that touch the ground ``[m, 3]``, in terrain axes [m]."""
    tracks = posed.points[posed.point_drives >= 0].double().cpu().numpy()
    points = transform_points(motion.terrain_from_base, tracks)
    centre = transform_points(motion.terrain_from_base, posed.centre_of_mass.double().cpu().numpy()[None])[0]
    planes = ConvexHull(points).equations
    planes = planes[planes[:, 2] < -_LEAST_DOWN]
    # The lower hull is the largest of the planes of its facets.
    heights = -(planes[:, :2] @ centre[:2] + planes[:, 3]) / planes[:, 2]
    plane = planes[int(np.argmax(heights))]
    return points[points @ plane[:3] + plane[3] > -_ON_THE_GROUND]


def stands(robot: RobotModel, rotation: np.ndarray) -> bool:
    """Whether a robot may stand on its wheels or tracks: its centre of mass is above what they touch on a plane.

    One that leans further tips over, and wheels on its upper side are in the air.

    Args:
        robot: its points and centre of mass.
        rotation: of the base ``[3, 3]`` in a frame with z up.
    """
    down = -rotation[2]
    if down[2] >= 0.0:
        return False
    points, centre = (values.double().cpu().numpy() for values in (robot.points, robot.centre_of_mass))
    lowest = points[:, 2].min()
    feet = points[points[:, 2] < lowest + _FOOT, :2]
    foot = centre[:2] + down[:2] * (lowest - centre[2]) / down[2]
    return bool(((foot >= feet.min(axis=0)) & (foot <= feet.max(axis=0))).all())


def ground_around(cloud: np.ndarray, robot: RobotModel, motion: MotionState, stiffness: float) -> float:
    """How far the ground around a robot lies above (positive) or below its wheels on three or four sides [m].

    0.0 where it is about as high, or where the lidar sees fewer sides. Grass and other things above it have gaps:
    the lower fifth of the returns counts where they are above the wheels, the upper fifth where they are below.

    Args:
        cloud: returns in the base frame ``[n, 3]`` [m].
        robot: its wheels or tracks.
        motion: its pose.
        stiffness: of the ground [N/m³].
    """
    support = support_points(robot, motion, stiffness)
    middle = support.mean(axis=0)
    near = cloud[np.hypot(cloud[:, 0], cloud[:, 1]) < 2.0 * _AROUND[1]]
    away = transform_points(motion.terrain_from_base, near.astype(np.float64)) - middle
    distance = np.hypot(away[:, 0], away[:, 1])
    away = away[(distance > _AROUND[0]) & (distance < _AROUND[1])]
    side = np.floor(np.arctan2(away[:, 1], away[:, 0]) / (0.5 * np.pi) + 0.5).astype(int) % 4
    sides = [away[side == number, 2] for number in range(4) if (side == number).sum() >= _FEWEST_RETURNS]
    for sign in (1.0, -1.0):
        least = sorted((float(np.quantile(sign * heights, 0.2)) for heights in sides), reverse=True)
        if len(least) >= 3 and least[2] > _APART:
            return sign * least[1]
    return 0.0


def lowest_points(robot: RobotModel) -> np.ndarray:
    """Bottoms of the wheels and tracks in the base frame ``[m, 3]`` [m]; of robots in the pose of their file."""
    backwards = robot.point_tangents[:, 0]
    # Small wheels have twelve samples, of which the lowest is up to 15° from the bottom.
    limit = _AT_THE_BOTTOM if bool((backwards < _AT_THE_BOTTOM).any()) else float(np.cos(np.radians(16.0)) * -1.0)
    return robot.points[backwards < limit].numpy().astype(np.float64)


def lowest_support(robot: RobotModel, motion: MotionState, flipper_angles: np.ndarray, stiffness: float) -> float:
    """Height of level ground under a robot that rests on the lowest points of its moved flippers [m], in terrain axes.

    Args:
        robot: its flippers, wheels and tracks.
        motion: the robot's pose.
        flipper_angles: measured ``[F]`` [rad]; NaN: as in the file.
        stiffness: of the ground [N/m³].
    """
    posed = posed_robot(robot, flipper_angles)
    points = posed.points[posed.point_drives >= 0].double().cpu().numpy()
    heights = np.sort(transform_points(motion.terrain_from_base, points)[:, 2])
    return float(heights[: max(4, len(heights) // 20)].mean()) + rest_depth(robot, stiffness)


def align_to_ground(terrain: TerrainMap, support: np.ndarray) -> TerrainMap:
    """A predicted map, shifted near the robot so that it passes through the support points.

    The ground under the wheels is known better than an encoder predicts it; a robot that starts below a predicted
    surface would be thrown off it. The shift fades out with the distance from the support points ``[m, 3]``. The
    geometric height shifts along, because the resistance of vegetation depends on its height above the ground.
    """
    grid = terrain.grid
    rows, columns, inside = grid.cells(support[:, :2])
    if not inside.any():
        return terrain
    points = support[inside]
    error = points[:, 2] - terrain.height.numpy()[rows[inside], columns[inside]]
    # Cells outside of this window do not change.
    (left, bottom), (right, top) = points[:, :2].min(axis=0) - _NONE_BEYOND, points[:, :2].max(axis=0) + _NONE_BEYOND
    across = slice(*np.searchsorted(grid.x, (left, right)))
    up = slice(*np.searchsorted(grid.y, (bottom, top)))
    x, y = np.meshgrid(grid.x[across], grid.y[up])
    distance = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1])
    weight = 1.0 / (distance + 0.05) ** 2
    shift = (weight * error).sum(axis=-1) / weight.sum(axis=-1)
    share = np.clip((_NONE_BEYOND - distance.min(axis=-1)) / (_NONE_BEYOND - _FULL_WITHIN), 0.0, 1.0)
    change = torch.from_numpy((shift * share).astype(np.float32))
    height = terrain.height.clone()
    height[up, across] += change
    geometric_height = terrain.geometric_height.clone()
    geometric_height[up, across] += change
    return replace(terrain, height=height, geometric_height=geometric_height)
