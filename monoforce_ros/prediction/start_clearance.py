"""Clearance of the start: where a robot stands there is no obstacle, whatever a map says."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from monoforce_ros.physics import State
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

HULL_DEPTH = 0.03
"""Depth to which the hull may start in the ground [m]: three times what a post yields at 1 m/s (physics/contact.py)."""
BELT_DEPTH = 0.3
"""Depth to which wheels and tracks may start in the ground [m]: the height from which ground counts as an obstacle in
the judgement of encoders. Less is an error of the ground, or grass that the map takes for ground."""


def with_clear_start(terrain: TerrainMap, robot: RobotModel, state: State) -> TerrainMap:
    """The terrain, lowered where a robot would start inside it.

    Maps show walls a cell too near, and the robot's own parts as obstacles. Contact would push a body out of them
    within a few steps: from a wall of 2 m a Husky is thrown 45 m up.

    Args:
        terrain: one map or a batch ``[B]``; unchanged, the same object, if nothing reaches into the robot.
        robot: its points, with its joints as they are at the start.
        state: start states ``[B]`` in the terrain frame; of one map all count.
    """
    hull = robot.point_drives < 0
    lowered = terrain.height
    for chosen, depth in ((hull, HULL_DEPTH), (~hull, BELT_DEPTH)):
        underside = _underside(terrain, robot.points[chosen], state).to(lowered)
        lowered = torch.where(lowered > underside + depth, underside, lowered)
    if torch.equal(lowered, terrain.height):
        return terrain
    return replace(terrain, height=lowered, geometric_height=terrain.geometric_height - (terrain.height - lowered))


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
