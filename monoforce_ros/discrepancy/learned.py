"""Learned: a body wrench as a sparse sum of named features, for effects outside the catalogue.

Orthogonal matching pursuit (Pati et al. 1993) on the derivatives of a recording's residuals by every term; the selected
terms are then fitted through the rollout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from monoforce_ros.discrepancy.fit import OUTLIER, flat, with_values
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.effects import CATALOGUE, only_effect

LEARNED = only_effect(lambda effect: effect.nameless)
"""Effect that stands for a formula."""
_STEP = 0.02
"""Step of the finite differences, as a share of the robot's weight."""


@dataclass(frozen=True)
class FormulaTerms:
    """What each term of a formula does to a recording's residuals."""

    keys: tuple[str, ...]
    """Of the terms."""
    step: float
    """Coefficient of each [N or N m]."""
    without: np.ndarray
    """Scaled residuals without any of them, ``[W, K, 3]``."""
    with_each: np.ndarray
    """Scaled residuals with one of them at a time, ``[F, W, K, 3]``."""

    @classmethod
    def of(cls, predictions: Predictions, base: Effects, scale: np.ndarray) -> FormulaTerms:
        """Every term in addition to a base; ``scale`` is the expected size of a residual, ``[W, K, 3]``."""
        keys = tuple(parameter.name for parameter in CATALOGUE[LEARNED].parameters)
        step = _STEP * 9.81 * float(predictions.robot.mass.mean())
        neutral = dict.fromkeys(keys, 0.0)
        trials: list[Effects] = [(*base, (LEARNED, neutral))]
        trials += [(*base, (LEARNED, {**neutral, key: step})) for key in keys]
        rolled = predictions.residuals(trials) / scale
        return cls(keys, step, rolled[0], rolled[1:])


def learned_terms(base: Effects, terms: FormulaTerms, most: int) -> list[Effects]:
    """Sums of one to ``most`` terms, each with the further term that explains most of the remaining residuals.

    Args:
        base: effects that act in addition.
        terms: what each does in addition to them.
        most: largest number of terms.
    """
    keys, step = terms.keys, terms.step
    without = np.nan_to_num(terms.without, nan=1e3)
    changes = np.nan_to_num(terms.with_each, nan=1e3) - without
    weight = np.sqrt(np.minimum(1.0, OUTLIER / np.maximum(np.abs(without), 1e-9))).ravel()
    wanted = -weight * without.ravel()
    columns = weight * changes.reshape(len(keys), -1)
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
        sum_of = {keys[index]: float(step * value) for index, value in zip(chosen, values, strict=True)}
        effects: Effects = (*base, (LEARNED, sum_of))
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
