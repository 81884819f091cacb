"""CostToGo: how far it is from anywhere on a costmap to a goal, around what cannot be driven over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

UNKNOWN, LETHAL = -1, 100
"""What costmaps call a cell that nothing measured, and one that nobody must enter."""
_CELL = 0.2
"""Edge of the cells on which the way is sought [m]; finer ones cost time and find the same way."""
_LETHAL_COST, _COSTLY, _UNKNOWN_COST = 30.0, 2.0, 1.5
"""Metres that a metre counts: over a lethal cell, over one just short of it, over one that nothing measured.

Lethal is costly rather than impossible: a robot that stands too near to a wall must find away from it.
"""
_BESIDE, _BESIDE_COST = 0.6, 3.0
"""Next to what is lethal a metre counts this much more [m], less and less up to this distance from there [m]: a robot
that has to leave its way must have the room."""
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))


@dataclass(frozen=True)
class CostToGo:
    """Length of the cheapest way from each cell to the goal."""

    resolution: float
    origin: np.ndarray
    """Corner of cell (0, 0) ``[2]`` [m]."""
    length: np.ndarray
    """``[rows, columns]`` [m]."""
    goal: np.ndarray
    """``[2]`` [m]."""
    nearness: np.ndarray
    """To what is lethal, 1 from the robot's radius on and 0 where there is room enough ``[rows, columns]``."""

    def at(self, places: np.ndarray) -> np.ndarray:
        """From places ``[..., 2]`` [m]; as the crow flies where they are off the map."""
        cells, inside = self._cells(places)
        # Within a cell the straight distance to the goal tells two places apart.
        centre = (cells + 0.5) * self.resolution + self.origin
        straight = np.linalg.norm(places - self.goal, axis=-1)
        within = straight - np.linalg.norm(centre - self.goal, axis=-1)
        return np.where(inside, self._values(self.length, cells) + within, straight)

    def near(self, places: np.ndarray) -> np.ndarray:
        """How near to what is lethal places ``[..., 2]`` [m] are, 0 to 1; 0 off the map."""
        cells, inside = self._cells(places)
        return np.where(inside, self._values(self.nearness, cells), 0.0)

    def _cells(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row of the cell of each place ``[..., 2]``, and whether it is on the map."""
        cells = np.floor((places - self.origin) / self.resolution).astype(int)
        rows, columns = self.length.shape
        return cells, ((cells >= 0) & (cells < [columns, rows])).all(axis=-1)

    def _values(self, of: np.ndarray, cells: np.ndarray) -> np.ndarray:
        rows, columns = of.shape
        return of[np.clip(cells[..., 1], 0, rows - 1), np.clip(cells[..., 0], 0, columns - 1)]


def cost_to_go(data: np.ndarray, resolution: float, origin: np.ndarray, goal: np.ndarray, *, radius: float) -> CostToGo:
    """Seek the way on a costmap (0 free to 100 lethal, -1 unknown).

    Beyond the map's border the way goes straight to the goal.

    Args:
        data: costs ``[rows, columns]``.
        resolution: edge of a cell [m].
        origin: corner of cell (0, 0) ``[2]`` [m].
        goal: ``[2]`` [m].
        radius: of the robot; cells nearer than this to a lethal one are lethal too [m].

    Raises:
        ValueError: the map is empty.
    """
    if data.size == 0 or data.ndim != 2:
        raise ValueError(f"costmap: got shape {data.shape}, expected rows and columns")
    lethal = data >= LETHAL
    away = distance_transform_edt(~lethal) * resolution if lethal.any() else np.full(data.shape, np.inf)
    near = away < radius
    factor = 1.0 + (_COSTLY - 1.0) * np.clip(data, 0, LETHAL) / LETHAL
    factor = np.where(data == UNKNOWN, _UNKNOWN_COST, factor)
    nearness = np.clip(1.0 - (away - radius) / _BESIDE, 0.0, 1.0)
    factor = factor + _BESIDE_COST * nearness
    factor = np.where(near, _LETHAL_COST, factor)
    each = max(1, round(_CELL / resolution))
    factor, nearness, size = _coarser(factor, each), _coarser(nearness, each), each * resolution
    rows, columns = factor.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    starts, ends, costs = [], [], []
    for down, right in _STEPS:
        here = (slice(0, rows - down), slice(max(0, -right), columns - max(0, right)))
        there = (slice(down, rows), slice(max(0, right), columns - max(0, -right)))
        starts.append(index[here].ravel())
        ends.append(index[there].ravel())
        costs.append((np.hypot(down, right) * size * 0.5 * (factor[here] + factor[there])).ravel())
    # The goal is one more node: beside its own cell, or straight beyond the border.
    x, y = np.meshgrid(origin[0] + (np.arange(columns) + 0.5) * size, origin[1] + (np.arange(rows) + 0.5) * size)
    straight = np.hypot(x - goal[0], y - goal[1])
    border = np.zeros((rows, columns), bool)
    inside = (origin[0] <= goal[0] < origin[0] + columns * size) and (origin[1] <= goal[1] < origin[1] + rows * size)
    if inside:
        border.ravel()[straight.argmin()] = True
    else:
        border[[0, -1]] = border[:, [0, -1]] = True
    last = rows * columns
    starts.append(index[border])
    ends.append(np.full(border.sum(), last))
    costs.append(np.maximum(straight[border], 1e-6))
    graph = coo_matrix(
        (np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))), shape=(last + 1, last + 1)
    ).tocsr()
    length = dijkstra(graph, directed=False, indices=last)[:last].reshape(rows, columns)
    return CostToGo(size, np.asarray(origin, float), length, np.asarray(goal, float), nearness)


def _coarser(values: np.ndarray, each: int) -> np.ndarray:
    """Largest value of blocks of ``each`` × ``each`` cells; the last ones are repeated where they do not fit."""
    rows, columns = -(-values.shape[0] // each) * each, -(-values.shape[1] // each) * each
    padded = np.pad(values, ((0, rows - values.shape[0]), (0, columns - values.shape[1])), mode="edge")
    return padded.reshape(rows // each, each, columns // each, each).max(axis=(1, 3))
