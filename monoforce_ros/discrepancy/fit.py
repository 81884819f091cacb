"""Fit: the parameters of effects that bring predictions closest to a drive, by robust least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.physics.effects import CATALOGUE

_OUTLIER = 3.0
"""Scaled residuals beyond this weigh with their size rather than their square."""
_DAMPINGS = (1e-3, 1e-1, 3.0)


@dataclass(frozen=True)
class Fit:
    """Fitted effects and what they explain."""

    effects: Effects
    loss: np.ndarray
    """Robust loss of each window, ``[W]``."""
    covariance: np.ndarray
    """Of the parameters in their order, ``[P, P]``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(name for name, _ in self.effects)


def robust(scaled: np.ndarray) -> np.ndarray:
    """Huber's loss of scaled residuals ``[..., W, K, 3]``, averaged over a window, ``[..., W]``."""
    size = np.abs(scaled)
    values = np.where(size <= _OUTLIER, 0.5 * size**2, _OUTLIER * (size - 0.5 * _OUTLIER))
    return np.minimum(values, 1e6).mean(axis=(-1, -2))


def flat(effects: Effects) -> np.ndarray:
    """Values of all parameters in a row."""
    return np.array([float(value) for _, parameters in effects for value in parameters.values()])


def with_values(effects: Effects, values: np.ndarray) -> Effects:
    """The same effects with other values, kept within their bounds."""
    result, at = [], 0
    for name, parameters in effects:
        known = {p.name: p for p in CATALOGUE[name].parameters}
        changed = {}
        for key in parameters:
            changed[key] = float(np.clip(values[at], known[key].low, known[key].high))
            at += 1
        result.append((name, changed))
    return tuple(result)


def scales(effects: Effects) -> np.ndarray:
    """How far from neutral each parameter is typically found."""
    return np.array(
        [{p.name: p for p in CATALOGUE[name].parameters}[key].scale for name, values in effects for key in values]
    )


def fit_effects(
    predictions: Predictions,
    starts: Sequence[Effects],
    scale: np.ndarray,
    windows: np.ndarray,
    *,
    iterations: int = 8,
) -> Fit:
    """Robust Levenberg-Marquardt from the best of several starts.

    Args:
        predictions: of the drive.
        starts: the same effects with different values.
        scale: size of a residual that means nothing, ``[K, 3]``.
        windows: which windows count, ``[W]`` bool.
        iterations: at most.
    """
    tried = predictions.residuals(list(starts)) / scale
    losses = robust(np.nan_to_num(tried, nan=1e3))[:, windows].mean(axis=1)
    best = int(np.argmin(losses))
    current, residual, loss = starts[best], tried[best], float(losses[best])
    typical = scales(current)
    values = flat(current)
    jacobian = None
    for _ in range(iterations):
        steps = 1e-2 * typical
        # Away from a bound, and from neutral values beyond which an effect does not exist.
        moved = [with_values(current, values + steps * unit) for unit in np.eye(len(values))]
        actual = np.array([flat(m)[i] - values[i] for i, m in enumerate(moved)])
        back = np.abs(actual) < 0.5 * steps
        for i in np.flatnonzero(back):
            moved[i] = with_values(current, values - steps * np.eye(len(values))[i])
            actual[i] = flat(moved[i])[i] - values[i]
        shifted = predictions.residuals(moved) / scale
        actual = np.where(actual == 0.0, np.inf, actual)
        jacobian = (shifted - residual) / actual[:, None, None, None] * typical[:, None, None, None]
        jacobian = np.nan_to_num(jacobian[:, windows]).reshape(len(values), -1)
        used = np.nan_to_num(residual[windows]).ravel()
        weight = np.minimum(1.0, _OUTLIER / np.maximum(np.abs(used), 1e-9))
        gradient = jacobian @ (weight * used)
        curvature = (jacobian * weight) @ jacobian.T
        diagonal = np.diag(np.diag(curvature) + 1e-6 * np.trace(curvature) + 1e-9)
        candidates = [
            with_values(current, values - typical * np.linalg.solve(curvature + damping * diagonal, gradient))
            for damping in _DAMPINGS
        ]
        tried = predictions.residuals(candidates) / scale
        losses = robust(np.nan_to_num(tried, nan=1e3))[:, windows].mean(axis=1)
        best = int(np.argmin(losses))
        if losses[best] >= loss * (1.0 - 1e-4):
            break
        current, residual, loss = candidates[best], tried[best], float(losses[best])
        values = flat(current)
    count = max(1, int(windows.sum()))
    covariance = np.zeros((len(values), len(values)))
    if jacobian is not None and jacobian.any():
        # Windows overlap and samples within one belong together: each window counts once.
        information = jacobian @ jacobian.T / (jacobian.shape[1] / count)
        spread = float(np.mean(np.minimum(np.nan_to_num(residual[windows]) ** 2, _OUTLIER**2)))
        inverse = np.linalg.pinv(information + 1e-9 * np.eye(len(values)) * np.trace(information))
        covariance = spread * inverse * np.outer(typical, typical)
    return Fit(current, robust(np.nan_to_num(residual, nan=1e3)), covariance)


def first_values(name: str, keys: Sequence[str]) -> list[Effects]:
    """Starts over the range where an effect is typically found, its neutral value excepted."""
    known = {p.name: p for p in CATALOGUE[name].parameters}
    if name == "payload":
        # A load in the middle hardly shows: it is sought towards the ends.
        return [
            ((name, {"mass": mass, **{key: place if key == "x" else 0.0 for key in keys if key != "mass"}}),)
            for mass in (8.0, 20.0)
            for place in (-0.3, 0.3)
        ]
    main = known[keys[0]]
    starts = []
    for factor in (-2.0, -1.0, -0.4, 0.4, 1.0, 2.0):
        neutral = main.neutral
        if np.isinf(neutral):
            value = {-2.0: 0.15, -1.0: 0.3, -0.4: 0.5, 0.4: 0.7, 1.0: 0.9, 2.0: 1.5}[factor]
        else:
            value = neutral + factor * main.scale
        if not main.low <= value <= main.high:
            continue
        values = {key: known[key].neutral for key in keys}
        values[keys[0]] = float(value)
        starts.append(((name, values),))
    return starts
