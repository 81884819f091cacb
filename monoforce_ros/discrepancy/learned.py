"""Learned: a body wrench as a sparse sum of named features, for effects outside the catalogue.

Orthogonal matching pursuit (Pati et al. 1993) on the derivatives of a recording's residuals by every term; the selected
terms are then fitted through the rollout.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from monoforce_ros.discrepancy.fit import OUTLIER, flat, with_values
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.effects import CATALOGUE

LEARNED = "learned_term"
_STEP = 0.02
"""Step of the finite differences, as a share of the robot's weight."""


def learned_terms(predictions: Predictions, base: Effects, scale: np.ndarray, most: int) -> list[Effects]:
    """Sums of one to ``most`` terms, each with the further term that explains most of the remaining residuals.

    Args:
        predictions: predictions for the recording's windows.
        base: effects that act in addition.
        scale: expected size of a residual, ``[K, 3]``.
        most: largest number of terms.
    """
    keys = [parameter.name for parameter in CATALOGUE[LEARNED].parameters]
    step = _STEP * 9.81 * float(predictions.robot.mass.mean())
    trials = [(*base, (LEARNED, dict.fromkeys(keys, 0.0)))]
    trials += [(*base, (LEARNED, {**dict.fromkeys(keys, 0.0), key: step})) for key in keys]
    rolled = np.nan_to_num(predictions.residuals(trials) / scale, nan=1e3)
    weight = np.sqrt(np.minimum(1.0, OUTLIER / np.maximum(np.abs(rolled[0]), 1e-9))).ravel()
    wanted = -weight * rolled[0].ravel()
    columns = weight * (rolled[1:] - rolled[0]).reshape(len(keys), -1)
    lengths = np.linalg.norm(columns, axis=1)
    # A feature that hardly occurs in the recording would get an arbitrarily large weight.
    lengths = np.maximum(lengths, 0.1 * lengths.max())
    ridge = 0.03 * lengths.max()
    chosen: list[int] = []
    found = []
    remaining = wanted
    for _ in range(most):
        match = np.abs(columns @ remaining) / np.maximum(lengths, 1e-9)
        match[chosen] = -1.0
        chosen.append(int(np.argmax(match)))
        rows = columns[chosen]
        values = np.linalg.solve(rows @ rows.T + ridge**2 * np.eye(len(chosen)), rows @ wanted)
        remaining = wanted - values @ rows
        terms = {keys[index]: float(step * value) for index, value in zip(chosen, values, strict=True)}
        effects = (*base, (LEARNED, terms))
        found.append(with_values(effects, flat(effects)))
    return found


def formula(terms: Mapping[str, float]) -> str:
    """The sum in symbols, such as ``torque_z = 12.3 vx|vx| - 4 wz``."""
    rows: dict[str, list[str]] = {}
    for key, value in terms.items():
        row, feature = key.split(":")
        term = f"{abs(value):.3g}" + ("" if feature == "1" else f" {feature}")
        parts = rows.setdefault(row, [])
        parts.append((f"- {term}" if value < 0 else f"+ {term}") if parts else (f"-{term}" if value < 0 else term))
    return "; ".join(f"{row} = {' '.join(parts)}" for row, parts in rows.items())
