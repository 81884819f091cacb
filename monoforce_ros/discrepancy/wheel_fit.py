"""Wheel fit: values of a wheel model by robust least squares, and their confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from monoforce_ros.discrepancy.wheel_blocks import WheelBlocks
from monoforce_ros.discrepancy.wheel_model import WheelModel, bounds_of, by_effect, residuals, response_of
from monoforce_ros.effects import CATALOGUE, Fastest

_FIRST_ITERATIONS, _ITERATIONS = 3, 8
"""Of a fit at most, from every start and then from the best of what these reach."""
_TOLERANCE = 1e-4
"""Relative decrease of the cost below which a fit ends."""
_DAMPING = 1e-3
"""Initial damping, as a share of the diagonal of the normal equations (Marquardt 1963)."""


def starts(names: tuple[str, ...], fastest: Fastest, similar: WheelModel | None) -> list[np.ndarray]:
    """Initial values: those of a similar model, with each initial value of what it does not hold."""
    known = {} if similar is None else dict(by_effect(similar.names, similar.values))
    listed = []
    for name in names:
        neutral = {parameter.name: parameter.neutral for parameter in CATALOGUE[name].parameters}
        further = tuple(float(neutral[key]) for key in response_of(name).further)
        listed.append([known[name]] if name in known else [(v, *further) for v in response_of(name).starts(fastest)])
    count = max(map(len, listed), default=0)
    return [np.concatenate([values[i % len(values)] for values in listed]) for i in range(count)]


def fit(
    names: tuple[str, ...],
    blocks: WheelBlocks,
    initial: Sequence[np.ndarray],
    groups: np.ndarray | None = None,
    *,
    rough: bool = False,
) -> np.ndarray:
    """Parameters ``[G, P]`` by robust least squares from a few starts, for each group of blocks alone.

    Args:
        names: effects.
        blocks: measured wheel speeds.
        initial: starts ``[P]``, at least one.
        groups: number of each block's group ``[n]``; None: one group.
        rough: end after the few steps that are made from every start.
    """
    members = np.zeros(len(blocks), int) if groups is None else groups
    count, number = int(members.max()) + 1, len(initial)
    if not names:
        return np.zeros((count, 0))
    values = np.repeat(np.stack(initial), count, axis=0)
    if number > 1 or rough:
        # Each start is a group of its own: a call of an effect costs more than its values.
        repeated = blocks[np.tile(np.arange(len(blocks)), number)]
        every = (members + count * np.arange(number)[:, None]).ravel()
        values, cost = _fitted(names, repeated, blocks.fastest, values, every, _FIRST_ITERATIONS)
        best = cost.reshape(number, count).argmin(axis=0)
        values = values.reshape(number, count, -1)[best, np.arange(count)]
    return values if rough else _fitted(names, blocks, blocks.fastest, values, members, _ITERATIONS)[0]


def _fitted(
    names: tuple[str, ...],
    blocks: WheelBlocks,
    fastest: Fastest,
    initial: np.ndarray,
    members: np.ndarray,
    iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters ``[G, P]`` and costs ``[G]`` of groups of blocks from one start ``[G, P]`` each.

    Levenberg's and Marquardt's method with the weights of the soft L1 loss, within bounds: a parameter at its bound
    that the cost would carry across it stays there. All groups and all derivatives are computed together.
    """
    count = len(initial)
    low, high = bounds_of(names, fastest).T
    values, scale = np.clip(initial, low, high), 0.05 * fastest.speed
    rest, jacobian = _linearised(names, values[members], blocks, low, high)
    cost = _cost(rest, scale, members, count)
    damping, going = np.full(count, _DAMPING), np.ones(count, bool)
    for _ in range(iterations):
        trial = values.copy()
        for group in np.flatnonzero(going):
            of_group = members == group
            step = _step(rest[of_group], jacobian[:, of_group], scale, damping[group], (values[group], low, high))
            trial[group] = np.clip(values[group] + step, low, high)
        tried_rest, tried_jacobian = _linearised(names, trial[members], blocks, low, high)
        tried_cost = _cost(tried_rest, scale, members, count)
        better = going & (tried_cost < cost)
        replaced = better[members]
        rest = np.where(replaced[:, None, None], tried_rest, rest)
        jacobian = np.where(replaced[None, :, None, None], tried_jacobian, jacobian)
        going &= ~better | (cost - tried_cost > _TOLERANCE * cost)
        going &= (trial != values).any(axis=1)
        values[better], cost[better] = trial[better], tried_cost[better]
        damping = np.where(better, np.maximum(0.1 * damping, 1e-9), 10.0 * damping)
        if not going.any():
            break
    return values, cost


def _linearised(
    names: tuple[str, ...], values: np.ndarray, blocks: WheelBlocks, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals ``[n, 2, K]``, and their derivatives with respect to the values of each block, ``[P, n, 2, K]``."""
    change = np.maximum(0.01 * np.abs(values), 1e-3)
    change = np.where(values + change > high, -change, change)
    change = np.where(values + change < low, high - low, change)
    found = residuals(names, values, blocks, change)
    return found[0], (found[1:] - found[0]) / change.T[:, :, None, None]


def _weights(rest: np.ndarray, scale: float) -> np.ndarray:
    """Of squared residuals: derivative of the soft L1 loss."""
    return 1.0 / np.sqrt(1.0 + (rest / scale) ** 2)


def _cost(rest: np.ndarray, scale: float, members: np.ndarray, count: int) -> np.ndarray:
    """Soft L1 loss of each group."""
    losses = 2.0 * scale**2 * (np.sqrt(1.0 + (rest / scale) ** 2) - 1.0)
    return np.bincount(members, losses.sum(axis=(1, 2)), minlength=count)


def _step(
    rest: np.ndarray,
    jacobian: np.ndarray,
    scale: float,
    damping: float,
    limits: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Damped step of the values ``[P]`` of one group."""
    values, low, high = limits
    root = np.sqrt(_weights(rest, scale))
    weighted = (jacobian * root).reshape(len(jacobian), -1)
    gradient, curvature = weighted @ (rest * root).ravel(), weighted @ weighted.T
    free = ~(((values <= low) & (gradient > 0)) | ((values >= high) & (gradient < 0))) & (np.diag(curvature) > 0)
    step = np.zeros(len(values))
    if free.any():
        reduced = curvature[np.ix_(free, free)]
        step[free] = -np.linalg.solve(reduced + damping * np.diag(np.diag(reduced)), gradient[free])
    return step


def half_widths(names: tuple[str, ...], values: np.ndarray, blocks: WheelBlocks) -> np.ndarray:
    """Half-widths of 95 % intervals from the scores of each block (sandwich estimate, White 1980), ``[P]``."""
    if not names:
        return np.zeros(0)
    low, high = bounds_of(names, blocks.fastest).T
    step = np.maximum(0.01 * np.abs(values), 1e-3)
    # A dead time of less than none is not defined.
    ends = [np.clip(values + side * step, low, high) - values for side in (-1.0, 1.0)]
    before, after = (residuals(names, values, blocks, end) for end in ends)
    base, jacobian = before[0], (after[1:] - before[1:]) / (ends[1] - ends[0])[:, None, None, None]
    weight = _weights(base, 0.05 * blocks.fastest.speed)
    scores = np.einsum("pnsk,nsk->np", jacobian, weight * base)
    weighted = (jacobian * np.sqrt(weight)).reshape(len(jacobian), -1)
    inverse = np.linalg.pinv(weighted @ weighted.T)
    freedom = max(1, len(blocks) - len(values))
    covariance = len(blocks) / freedom * inverse @ (scores.T @ scores) @ inverse
    return student.ppf(0.975, freedom) * np.sqrt(np.maximum(np.diag(covariance), 0.0))
