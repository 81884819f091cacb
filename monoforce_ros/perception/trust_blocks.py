"""Blocks: comparisons of predictions with the ground found later, by the stretch of travel that found it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

BLOCK = 0.5
"""Distance travelled in one block of comparisons [m], about a robot's length: errors within it are not independent."""
LENGTH = 6.0
"""Distance travelled over which predictions are judged [m]."""
FEWEST_BLOCKS = 3
"""Blocks before which comparisons decide nothing."""
_KEPT = round(LENGTH / BLOCK)


class Comparison(NamedTuple):
    """Means over points of the ground under the wheels, of which one earlier prediction had said something."""

    error: float
    """Of the prediction [m]."""
    level: float
    """Error of level ground [m]."""
    product: float
    """d g of :class:`~monoforce_ros.perception.TerrainTrust` [m²]."""
    square: float
    """d² [m²]."""
    ground: float
    """g² [m²]."""
    off: float
    """|g|, the error of the fallback [m]."""
    ratio: float
    """Error of the prediction in units of its spread; NaN where it tells none."""
    distance: float
    """From which the prediction was made [m]."""
    camera: str
    """That looked at the place."""


class Blocks:
    """Means of comparisons over blocks of travel, the last ones over :data:`LENGTH`.

    A place, a square of :data:`BLOCK` in the odometry frame, belongs to the block in which a wheel first touched it:
    what the wheels that follow find there is no further evidence. After :data:`LENGTH` it is a new one.
    """

    def __init__(self) -> None:
        self._current = 0
        self._block_of: dict[tuple[int, int], int] = {}
        """Number of the block to which each place belongs."""
        self._sums: dict[int, tuple[np.ndarray, int, str]] = {}
        """Sums of the numbers of comparisons, their count and the last one's camera, by the number of the block."""

    def of_places(self, points: np.ndarray) -> np.ndarray:
        """Numbers of the blocks ``[m]`` to which points ``[m, 2 or 3]`` in the odometry frame [m] belong."""
        places = np.floor(points[:, :2] / BLOCK).astype(np.int64)
        found = np.empty(len(places), np.int64)
        for i, place in enumerate(map(tuple, places.tolist())):
            if self._current - self._block_of.get(place, -_KEPT) >= _KEPT:
                self._block_of[place] = self._current
            found[i] = self._block_of[place]
        return found

    def add(self, block: int, comparison: Comparison) -> None:
        """Add a comparison to a block, one of :meth:`of_places`."""
        total, count, _ = self._sums.get(block, (0.0, 0, ""))
        self._sums[block] = total + np.array(comparison[:-1]), count + 1, comparison.camera

    def close(self) -> None:
        """End the current block."""
        self._current += 1
        self._block_of = {place: block for place, block in self._block_of.items() if self._current - block < _KEPT}
        for block in sorted(self._sums)[:-_KEPT]:
            del self._sums[block]

    @property
    def means(self) -> list[Comparison]:
        """Mean of each block that has ended and found something new."""
        return [
            Comparison._make([*(total / count).tolist(), camera])
            for block, (total, count, camera) in sorted(self._sums.items())
            if block < self._current
        ]


def mean_comparison(comparisons: Iterable[Comparison]) -> Comparison:
    """Mean of all numbers; of the camera the last one."""
    rows = list(comparisons)
    return Comparison._make([*np.mean([row[:-1] for row in rows], axis=0).tolist(), rows[-1].camera])


def telling_blocks(squares: np.ndarray) -> np.ndarray | None:
    """Which blocks count ``[n]``, 0 or 1, where prediction and fallback differ by ``squares`` ``[n]`` [m²]; None if
    fewer than :data:`FEWEST_BLOCKS` tell them apart.

    A block that differs far more than all others would decide alone: it is left out, until the effective number of
    blocks is no smaller.
    """
    order = np.argsort(-squares, kind="stable")
    for left_out in range(len(squares)):
        kept = squares[order[left_out:]]
        if (kept > 0.0).sum() < FEWEST_BLOCKS:
            break
        if effective_number(kept) >= FEWEST_BLOCKS * (1.0 - 1e-9):
            weights = np.ones(len(squares))
            weights[order[:left_out]] = 0.0
            return weights
    return None


def effective_number(squares: np.ndarray) -> float:
    """Effective number of blocks that differ by ``squares`` ``[n]`` [m²], (Σ d²)² / Σ d⁴; 0 if none differs."""
    fourth = float((squares**2).sum())
    return float(squares.sum()) ** 2 / fourth if fourth > 0.0 else 0.0
