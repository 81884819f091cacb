"""Pairing: two effects that explain together what neither does alone.

A drag slows a robot, and a localisation sensor beside its centre adds to the speed in curves: where it mostly turns one
way they cancel on average, and a search that adds one effect at a time begins with neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from monoforce_ros.discrepancy.fit import robust_weights
from monoforce_ros.discrepancy.score_test import Direction, motion_count

_RIDGE = 1e-6
"""Relative size of a ridge that keeps indistinguishable effects finite."""
_LARGEST = 5.0
"""Largest coefficient of a change, in units of the value at which it was computed: beyond, nothing is linear."""


@dataclass(frozen=True)
class Pair:
    """Two directions, by their indices, and what they promise together."""

    first: int
    second: int
    coefficients: tuple[np.ndarray, np.ndarray]
    """Of the columns of both."""
    gain: float
    """Mean reduction of the loss, to first order."""
    beyond: float
    """Of which neither promises alone."""


def promising_pairs(residual: np.ndarray, directions: Sequence[Direction], most: int) -> list[Pair]:
    """The pairs that promise most beyond what the best single direction does, the best first.

    Args:
        residual: scaled, ``[W, K, C]``.
        directions: changes of the residuals by single effects.
        most: largest number of pairs.
    """
    used = np.nan_to_num(residual).ravel()
    weights = robust_weights(used)
    columns = [np.nan_to_num(direction.columns).reshape(len(direction.columns), -1) for direction in directions]
    if len(columns) < 2:
        return []
    joined = np.concatenate(columns)
    gram, pull = (joined * weights) @ joined.T, -joined @ (weights * used)
    ends = np.cumsum([len(column) for column in columns])
    places = [np.arange(end - len(column), end) for column, end in zip(columns, ends, strict=True)]
    count = motion_count(np.nan_to_num(residual))

    def solved(place: np.ndarray) -> tuple[np.ndarray, float]:
        part = gram[np.ix_(place, place)]
        sizes = np.maximum(part.diagonal(), 1e-12)
        found = np.clip(np.linalg.solve(part + _RIDGE * np.diag(sizes), pull[place]), -_LARGEST, _LARGEST)
        return found, float(found @ pull[place] - 0.5 * found @ part @ found) / count

    single = [solved(place)[1] for place in places]
    best, pairs = max(single), []
    for i, j in combinations(range(len(columns)), 2):
        found, gain = solved(np.concatenate([places[i], places[j]]))
        split = (found[: len(places[i])], found[len(places[i]) :])
        pairs.append(Pair(i, j, split, gain, gain - best))
    return sorted((pair for pair in pairs if pair.beyond > 0), key=lambda pair: -pair.gain)[:most]
