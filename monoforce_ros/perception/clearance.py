"""Clearance: where a robot stands there is no obstacle, whatever a map says."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from monoforce_ros.core import MotionState
from monoforce_ros.physics import State
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

HULL_DEPTH = 0.03
"""Depth to which the hull may start in the ground [m]: three times what a post yields at 1 m/s (physics/contact.py).
Between the points of a wheel and the centres of cells the ground may slope by as much."""
BELT_DEPTH = 0.3
"""Depth to which wheels and tracks may start in the ground [m]: the height from which ground counts as an obstacle in
the judgement of encoders. Less is an error of the ground, or grass that the map takes for ground."""


def with_clear_start(terrain: TerrainMap, robot: RobotModel, state: State, *, rigid: bool = False) -> TerrainMap:
    """The terrain, lowered where a robot would start inside it.

    Maps show walls a cell too near, and the robot's own parts as obstacles; no sensor sees the ground below the robot,
    and heights interpolated there rise towards a wall nearby. Contact would push a body out of them within a few steps:
    from a wall of 2 m a Husky is thrown 45 m up.

    Args:
        terrain: one map or a batch ``[B]``; unchanged, the same object, if nothing reaches into the robot.
        robot: its points, with its joints as they are at the start.
        state: start states ``[B]`` in the terrain frame; of one map all count.
        rigid: whether the map shows only rigid ground. Then wheels and tracks are cleared like the hull, and so are
            cells beside the robot that nothing measured; in grass, the robot would stand between walls.
    """
    hull = robot.point_drives < 0
    parts = [(robot.points[~hull], HULL_DEPTH if rigid else BELT_DEPTH), (robot.points[hull], HULL_DEPTH)]
    if not any(_may_reach(terrain, points, depth, state) for points, depth in parts):
        return terrain
    lowered = terrain.height
    for points, depth in parts:
        underside = _underside(terrain, points, state).to(lowered)
        if rigid:
            underside = torch.where(terrain.observed, underside, _least_around(underside))
        lowered = torch.where(lowered > underside + depth, underside, lowered)
    if torch.equal(lowered, terrain.height):
        return terrain
    return replace(terrain, height=lowered, geometric_height=terrain.geometric_height - (terrain.height - lowered))


def clear_of_robot(terrain: TerrainMap, robot: RobotModel, motion: MotionState) -> TerrainMap:
    """A map of rigid ground, lowered where it reaches into a robot at rest."""
    still, rotation = torch.zeros(1, 3), torch.as_tensor(motion.terrain_from_base[:3, :3], dtype=torch.float32)
    return with_clear_start(terrain, robot, State(still, rotation[None], still, still), rigid=True)


@torch.no_grad()
def _may_reach(terrain: TerrainMap, points: Tensor, depth: float, state: State) -> bool:
    """Whether any ground around the robot is higher than the lowest of its points ``[N, 3]``, and by more than a depth.

    Much faster than :func:`_underside`, and mostly enough.
    """
    if not len(points):
        return False
    grid = terrain.grid
    lowest = (points @ state.rotation[:, 2].to(points).unsqueeze(-1)).amin() + state.position[:, 2].amin()
    reach = float(points.norm(dim=-1).amax()) + 2.0 * grid.resolution
    columns, rows = (
        slice(
            max(0, math.floor((float(state.position[:, i].min()) - reach - grid.origin[i]) / grid.resolution)),
            max(0, math.ceil((float(state.position[:, i].max()) + reach - grid.origin[i]) / grid.resolution) + 1),
        )
        for i in (0, 1)
    )
    around = terrain.height[..., rows, columns]
    return bool(around.numel()) and bool((around > lowest.to(around) + depth).any())


def _least_around(values: Tensor) -> Tensor:
    """The least of each cell ``[..., rows, columns]`` and its eight neighbours."""
    pages = values.reshape(-1, 1, *values.shape[-2:])
    return -torch.nn.functional.max_pool2d(-pages, 3, stride=1, padding=1).reshape(values.shape)


@torch.no_grad()
def _underside(terrain: TerrainMap, points: Tensor, state: State) -> Tensor:
    """Lowest of body points ``[N, 3]`` over each cell, shaped like the heights; infinite where there are none [m]."""
    grid = terrain.grid
    # Candidates share one start.
    first = bool((state.position == state.position[:1]).all() and (state.rotation == state.rotation[:1]).all())
    count = 1 if first and terrain.height.ndim == 2 else len(state.position)
    position, rotation = state.position[:count].to(points), state.rotation[:count].to(points)
    placed = points @ rotation.transpose(1, 2) + position[:, None]
    column, row = ((placed[..., i] - grid.origin[i]) / grid.resolution for i in (0, 1))
    pages = terrain.height.shape[0] if terrain.height.ndim == 3 else 1
    page = torch.arange(count, device=points.device)[:, None].expand(column.shape) if pages > 1 else 0
    lowest = points.new_full((pages * grid.rows * grid.columns,), torch.inf)
    # Each point stands for the four cells between which the height beneath it is interpolated.
    for above in (0, 1):
        for right in (0, 1):
            r, c = row.floor().long() + above, column.floor().long() + right
            inside = (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.columns)
            cell = (page * grid.rows + r) * grid.columns + c
            lowest.scatter_reduce_(0, cell[inside], placed[..., 2][inside], "amin")
    return lowest.view_as(terrain.height)
