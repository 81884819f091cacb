"""Residual model: how large the residuals of a healthy robot are, by how far and how sharply it is commanded to move.

A robot that goes straight on is predicted within a degree, the same robot in a sharp turn within ten. One size for all
windows would hide what goes wrong on the straight, and take a recording with more turns for a faulty one. The variance
of each component is a sum of squares of what was commanded since the start of the window, with coefficients that are
not negative. They follow from the likelihood of normal residuals (the Itakura-Saito divergence between squared
residuals and variances) by multiplicative updates (Févotte, Bertin and Durrieu 2009).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.discrepancy.evidence import EvidenceWindows

TERMS = ("time", "distance", "turn", "sideways", "speed_change", "yaw_rate_change")
"""Commanded motion whose squares add up to the variance: elapsed time [s], distance [m], turn [rad], integral of the
sideways acceleration [m/s], and changes of speed [m/s] and of yaw rate [rad/s]."""
STEP = 0.05
"""Of the commands [s]."""
BEFORE = 0.5
"""Changes of the command so long before a window still move the robot in it [s]: typical dead times and lags."""
_LARGEST = 3.0
"""Residuals beyond so many standard deviations count as if they were that large."""
_UPDATES = 200
"""Steps of the multiplicative iteration: they bound the time."""
_PRIOR_WINDOWS = 1.0
"""Weight of the prior, in windows."""


def window_commands(data: EvidenceWindows) -> np.ndarray:
    """Speed [m/s] and yaw rate [rad/s] every :data:`STEP` from :data:`BEFORE` windows to their ends, ``[W, T, 2]``."""
    before, steps = round(BEFORE / STEP), round(float(data.samples[-1]) / STEP)
    grid = np.rint(np.arange(-before, steps + 1) * STEP * 1e9).astype(np.int64)
    return data.commands.sample(data.starts[:, None] + grid)[..., :2]


def motion_terms(data: EvidenceWindows) -> np.ndarray:
    """Squares of the terms since the start of each window, ``[W, K, len(TERMS)]``."""
    before, steps = round(BEFORE / STEP), round(float(data.samples[-1]) / STEP)
    speed, rate = np.moveaxis(window_commands(data), -1, 0)
    driven = [np.abs(values[:, before + 1 :]) * STEP for values in (speed, rate, speed * rate)]
    changes = [np.abs(np.diff(values, axis=1)) for values in (speed, rate)]
    totals = [np.cumsum(values, axis=1) for values in driven]
    totals += [np.cumsum(values, axis=1)[:, before:] for values in changes]
    at = np.clip(np.rint(data.samples / STEP).astype(int) - 1, 0, steps - 1)
    elapsed = np.broadcast_to(data.samples, (len(data.starts), len(data.samples)))
    return np.stack([elapsed, *(values[:, at] for values in totals)], axis=-1) ** 2


def fit_terms(residuals: Sequence[np.ndarray], floors: Sequence[np.ndarray], terms: Sequence[np.ndarray]) -> np.ndarray:
    """Coefficients of the variance of each component beyond what is known already, ``[C, len(TERMS)]``.

    A prior of the weight of one window shares the mean square of the residuals equally between the terms: what a
    recording does not show is not taken for impossible.

    Args:
        residuals: of recordings of the healthy robot, ``[W, K, C]`` each.
        floors: their size by noise and map, ``[W, K, C]``.
        terms: result of :func:`motion_terms` for each.
    """
    features = np.concatenate([values.reshape(-1, len(TERMS)) for values in terms])
    count = features.shape[1]
    means = np.maximum(features.mean(axis=0), 1e-12)
    samples, components = residuals[0].shape[1:]
    result = np.zeros((components, count))
    for component in range(components):
        squares = np.concatenate([values[..., component].ravel() ** 2 for values in residuals])
        known = np.concatenate([values[..., component].ravel() ** 2 for values in floors])
        least = 1e-3 * float(known.mean()) + 1e-12
        total = max(float(np.quantile(squares, 0.683) - known.mean()), least)
        # Each window of the prior moves by one term alone, and has the mean square of all.
        alone = np.diag(means)
        inputs = np.concatenate([features, alone])
        weights = np.r_[np.ones(len(features)), np.full(count, _PRIOR_WINDOWS * samples / count)][:, None]
        offsets = np.r_[known, np.zeros(count)]
        targets = np.r_[squares, np.full(count, total / count)]
        values = total / count / means
        for _ in range(_UPDATES):
            variance = offsets + inputs @ values
            clipped = np.minimum(targets, _LARGEST**2 * variance)
            above = (weights * inputs * (clipped / variance**2)[:, None]).sum(axis=0)
            below = (weights * inputs / variance[:, None]).sum(axis=0)
            values = values * np.sqrt(above / below)
        result[component] = values
    return result
