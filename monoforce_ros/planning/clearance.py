"""Clearance: how close a rollout comes to obstacles that the robot cannot climb, before it touches them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.physics import Rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

LARGEST = 1.0
"""Largest limit [m]: maps are searched to three times as far."""
_LEVELS = (1.5, 0.5, 0.25)
"""Value of an obstacle within once, twice and three times the limit. The first is beyond 1, so that what stands closer
is infeasible; the others make a wider path the cheaper one."""
FURTHER = 0.05
"""Share of the limit by which a robot that is beyond it may go further for a moment, as it starts to move."""
_AROUND = 2.0
"""Distance of points of the outline that are beside each other, over that of neighbours: the first ones beyond a corner
come near a wall as the robot turns away from it."""
_INTERVAL = 0.12
"""Time between the poses that are examined [s]: at 1 m/s about a cell of a map."""
_RISE = 0.1
"""Height over which an obstacle comes to count in full [m]: of the accuracy of a map's heights, and smooth."""


def closeness(rollout: Rollout, terrain: TerrainMap, robot: RobotModel, limit: float) -> tuple[Tensor, Tensor]:
    """How close the robot's outline comes to obstacles: 0 beyond three times ``limit``, above 1 within it.

    Obstacles are what rises above the highest part of the wheels or tracks, or above the tips of raised flippers, in
    the robot's own frame: the robot cannot climb it. A rollout feels them only when it touches them, yet neither the
    map nor the motion is exact.

    Args:
        rollout: of ``N`` candidates.
        terrain: the map of the rollout.
        robot: the robot of the rollout.
        limit: clearance below which a path is infeasible [m].

    Returns:
        the largest value after the start ``[N]``, differentiable in the rollout, and whether the robot leaves an
        obstacle that it starts within the limit of ``[N]`` bool: see :func:`_leaves`.
    """
    height, grid = terrain.height.to(rollout.position), terrain.grid
    every = max(1, math.floor(_INTERVAL / float(rollout.times[1] - rollout.times[0]) + 1e-6))
    spacing = max(limit, grid.resolution)
    outline = torch.from_numpy(_outline(robot, spacing)).to(rollout.position)
    position, rotation = rollout.position[:, ::every], rollout.rotation[:, ::every]
    points = position[:, :, None] + torch.einsum("nsij,pj->nspi", rotation, outline)
    count, steps, around, _ = points.shape
    # A diverged rollout has no height.
    lowest = points.detach()[..., 2].nan_to_num(torch.inf).amin()
    if not bool(height.amax() > lowest):
        # Nothing on the map reaches that high.
        return points.new_zeros(count), torch.zeros(count, dtype=torch.bool)
    raised = torch.stack([_raised(height, (1 + level) * limit / grid.resolution) for level in range(len(_LEVELS))])
    span = points.new_tensor([grid.columns - 1, grid.rows - 1]) * grid.resolution
    place = 2.0 * (points[..., :2] - points.new_tensor(grid.origin)) / span - 1.0
    # Beyond the edge the border values are continued, as in the rollout.
    ground = functional.grid_sample(
        raised[None], place.reshape(1, count * steps, around, 2), align_corners=True, padding_mode="border"
    )[0].reshape(len(_LEVELS), count, steps, around)
    share = ((ground - points[..., 2]) / _RISE).clamp(0.0, 1.0).nan_to_num(1.0)
    values = (share * points.new_tensor(_LEVELS)[:, None, None, None]).amax(dim=0)
    return values[:, 1:].amax(dim=(1, 2)), _leaves(values.detach(), outline, _AROUND * spacing)


def _leaves(values: Tensor, outline: Tensor, around: float) -> Tensor:
    """Whether rollouts that start within the limit of an obstacle leave it, and come near no other ``[N]`` bool.

    A robot may turn before it leaves: until then the parts of its outline that are within the limit at the start, and
    those beside them, may be there; at the end no closer than at the start. Once it has left, it stays away.

    Args:
        values: of each point of the outline ``[N, S, P]``.
        outline: the points ``[P, 3]`` [m].
        around: distance of points beside each other [m].
    """
    near = values > 1.0
    beside = (torch.cdist(outline[:, :2], outline[:, :2]) <= around + 1e-6).to(values)
    allowed = near[:, :1].to(values) @ beside > 0.0
    away = values.amax(dim=2) <= _LEVELS[1]
    left = away.cummax(dim=1).values
    stays = ~near.any(dim=2) | (~left & ~(near & ~allowed).any(dim=2))
    return near[:, 0].any(dim=1) & stays.all(dim=1) & (values[:, -1].amax(dim=1) <= values[:, 0].amax(dim=1) + FURTHER)


def _raised(height: Tensor, cells: float) -> Tensor:
    """The highest ground within a distance, given in cells, of each cell ``[rows, columns]``."""
    reach = math.floor(cells + 1e-6)
    if reach == 0:
        return height
    padded = functional.pad(height[None, None], (reach,) * 4, mode="replicate")[0, 0]
    rows, columns = height.shape
    highest = height
    for row in range(-reach, reach + 1):
        # A row of a disc is a window of its width.
        half = math.floor(math.sqrt(max(cells**2 - row**2, 0.0)) + 1e-6)
        band = padded[reach + row : reach + row + rows, reach - half : reach + half + columns]
        highest = torch.maximum(highest, functional.max_pool1d(band[:, None], 2 * half + 1, stride=1)[:, 0])
    return highest


def _outline(robot: RobotModel, spacing: float) -> np.ndarray:
    """Points around the robot's bounds, at the height of what it cannot climb ``[P, 3]`` [m] (base frame)."""
    low, high = (bound.double().cpu().numpy() for bound in robot.bounds)
    driven = robot.points[robot.point_drives >= 0]
    top = float((driven if len(driven) else robot.points)[:, 2].max())
    top += max((_length(robot, index) for index in range(len(robot.flippers))), default=0.0)
    ends = [np.linspace(low[axis], high[axis], 1 + math.ceil((high[axis] - low[axis]) / spacing)) for axis in (0, 1)]
    sides = [[(x, y) for x in ends[0] for y in (low[1], high[1])], [(x, y) for x in (low[0], high[0]) for y in ends[1]]]
    places = np.unique(np.array([*sides[0], *sides[1]]), axis=0)
    return np.column_stack([places, np.full(len(places), top)])


def _length(robot: RobotModel, index: int) -> float:
    """Distance of a flipper's tip from its axle [m]."""
    assert robot.point_flippers is not None
    joint = np.asarray(robot.flippers[index].joint)
    points = robot.points[robot.point_flippers == index].double().cpu().numpy()
    return float(np.linalg.norm((points - joint)[:, [0, 2]], axis=1).max()) if len(points) else 0.0
