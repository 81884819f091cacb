"""CostToGo: length of the cheapest path from anywhere on a costmap to a goal, around obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

UNKNOWN, LETHAL = -1, 100
"""Values of unknown and of lethal cells in costmaps."""
MAXIMUM_CELLS = 1_000_000
"""Cells of a map that are searched as they are; larger maps are coarsened first."""
_CELL = 0.2
"""Edge of the cells of the search [m]; smaller cells cost time and find the same path."""
_LETHAL_FACTOR, _COSTLY_FACTOR, _UNKNOWN_FACTOR = 30.0, 2.0, 1.5
"""Cost per metre over a lethal cell, over one just below lethal, and over an unknown one.

Lethal cells are expensive rather than impassable: a robot too close to a wall must find a path away from it.
"""
_MARGIN, _MARGIN_FACTOR = 0.6, 3.0
"""Distance beyond the robot's radius over which the proximity of lethal cells adds to the cost [m], and the largest
such addition per metre: a robot that must leave its path needs space."""
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))


@dataclass(frozen=True)
class CostToGo:
    """Cost of the cheapest path from each cell to the goal."""

    resolution: float
    """Edge of a cell [m]."""
    origin: np.ndarray
    """Corner of cell (0, 0) ``[2]`` [m]."""
    cost: np.ndarray
    """Path length, weighted by the cost per metre ``[rows, columns]`` [m]."""
    goal: np.ndarray
    """``[2]`` [m]."""
    proximity: np.ndarray
    """Proximity of lethal cells: 1 within the robot's radius, 0 beyond the margin ``[rows, columns]``."""

    def at(self, places: np.ndarray) -> np.ndarray:
        """Cost from places ``[..., 2]`` [m]; off the map, the straight distance to the goal [m]."""
        cells, inside = self._cells(places)
        # Within a cell, places differ by their straight distance to the goal.
        centre = (cells + 0.5) * self.resolution + self.origin
        straight = np.linalg.norm(places - self.goal, axis=-1)
        within = straight - np.linalg.norm(centre - self.goal, axis=-1)
        return np.where(inside, self._values(self.cost, cells) + within, straight)

    def proximity_at(self, places: np.ndarray) -> np.ndarray:
        """Proximity of lethal cells at places ``[..., 2]`` [m], 0 to 1; 0 off the map."""
        cells, inside = self._cells(places)
        return np.where(inside, self._values(self.proximity, cells), 0.0)

    def _cells(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row of the cell of each position ``[..., 2]``, and whether it is on the map."""
        cells = np.floor((places - self.origin) / self.resolution).astype(int)
        rows, columns = self.cost.shape
        return cells, ((cells >= 0) & (cells < [columns, rows])).all(axis=-1)

    def _values(self, of: np.ndarray, cells: np.ndarray) -> np.ndarray:
        rows, columns = of.shape
        return of[np.clip(cells[..., 1], 0, rows - 1), np.clip(cells[..., 0], 0, columns - 1)]


def cost_to_go(data: np.ndarray, resolution: float, origin: np.ndarray, goal: np.ndarray, *, radius: float) -> CostToGo:
    """Search the cheapest paths to a goal on a costmap (0 free to 100 lethal, -1 unknown) by Dijkstra's algorithm.

    Beyond the border of the map, paths go straight to the goal.

    Args:
        data: costs ``[rows, columns]``.
        resolution: edge of a cell [m].
        origin: corner of cell (0, 0) ``[2]`` [m].
        goal: ``[2]`` [m].
        radius: radius of the robot [m]; cells closer than this to a lethal one are lethal too.

    Raises:
        ValueError: the map is empty.
    """
    if data.size == 0 or data.ndim != 2:
        raise ValueError(f"costmap: got shape {data.shape}, expected rows and columns")
    # The search takes 0.15 s for so many cells, and the robot waits for it.
    if (pooled := math.ceil(math.sqrt(data.size / MAXIMUM_CELLS))) > 1:
        data, resolution = _coarser(data, pooled), resolution * pooled
    lethal = data >= LETHAL
    distance = distance_transform_edt(~lethal) * resolution if lethal.any() else np.full(data.shape, np.inf)
    proximity = np.clip(1.0 - (distance - radius) / _MARGIN, 0.0, 1.0)
    factor = 1.0 + (_COSTLY_FACTOR - 1.0) * np.clip(data, 0, LETHAL) / LETHAL
    factor = np.where(data == UNKNOWN, _UNKNOWN_FACTOR, factor) + _MARGIN_FACTOR * proximity
    factor = np.where(distance < radius, _LETHAL_FACTOR, factor)
    each = max(1, round(_CELL / resolution))
    factor, proximity, size = _coarser(factor, each), _coarser(proximity, each), each * resolution
    cost = _cheapest(factor, size, np.asarray(origin, float), np.asarray(goal, float))
    return CostToGo(size, np.asarray(origin, float), cost, np.asarray(goal, float), proximity)


def _cheapest(factor: np.ndarray, size: float, origin: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Cost of the cheapest path from each cell to the goal, from each cell's cost per metre ``[rows, columns]``."""
    rows, columns = factor.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    starts, ends, costs = [], [], []
    for down, right in _STEPS:
        here = (slice(0, rows - down), slice(max(0, -right), columns - max(0, right)))
        there = (slice(down, rows), slice(max(0, right), columns - max(0, -right)))
        starts.append(index[here].ravel())
        ends.append(index[there].ravel())
        costs.append((np.hypot(down, right) * size * 0.5 * (factor[here] + factor[there])).ravel())
    # The goal is one more node, connected to its own cell, or to all border cells if it is off the map.
    x, y = np.meshgrid(origin[0] + (np.arange(columns) + 0.5) * size, origin[1] + (np.arange(rows) + 0.5) * size)
    straight = np.hypot(x - goal[0], y - goal[1])
    connected = np.zeros((rows, columns), bool)
    inside = (origin[0] <= goal[0] < origin[0] + columns * size) and (origin[1] <= goal[1] < origin[1] + rows * size)
    if inside:
        connected.ravel()[straight.argmin()] = True
    else:
        connected[[0, -1]] = connected[:, [0, -1]] = True
    last = rows * columns
    starts.append(index[connected])
    ends.append(np.full(connected.sum(), last))
    costs.append(np.maximum(straight[connected], 1e-6))
    graph = coo_matrix(
        (np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))), shape=(last + 1, last + 1)
    ).tocsr()
    return dijkstra(graph, directed=False, indices=last)[:last].reshape(rows, columns)


def _coarser(values: np.ndarray, each: int) -> np.ndarray:
    """Largest value of blocks of ``each`` × ``each`` cells; border cells are repeated to fill the last blocks."""
    rows, columns = -(-values.shape[0] // each) * each, -(-values.shape[1] // each) * each
    padded = np.pad(values, ((0, rows - values.shape[0]), (0, columns - values.shape[1])), mode="edge")
    return padded.reshape(rows // each, each, columns // each, each).max(axis=(1, 3))
