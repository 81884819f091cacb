"""Directions: changes of a recording's residuals by effects, by terms of a formula, and by effects that change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from monoforce_ros.discrepancy.evidence import sample_motion
from monoforce_ros.discrepancy.fit import without
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, own_values, values_key
from monoforce_ros.discrepancy.learned import LEARNED, FormulaTerms
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.score_test import Direction, motion_count
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.effects import CATALOGUE

_SMALLEST_SECANT = 0.1
"""Smallest distance from neutral, in typical sizes, at which the influence of one of several parameters is taken."""
_KEPT = 8
"""Residuals of this many hypotheses are kept."""
_KEPT_TERMS = 2
"""Those of all terms, in addition to this many bases: what was found, and nothing."""
ONSETS = (1 / 3, 2 / 3)
"""Shares of a recording after which effects that begin late are tested. Of one that begins before two thirds of it the
nearest of these two, and of the start, has a correlation of at least 0.86 with the true course."""


class Directions:
    """Directions on one recording, each with how much it varies on the healthy robot.

    Args:
        predictions: of the robot with the effects of its file.
        scale: expected size of a residual, ``[W, K, 3]``.
        nominal: what commissioning learned; None for a robot that was never commissioned.
        thresholds: shares of variances.
    """

    def __init__(
        self, predictions: Predictions, scale: np.ndarray, nominal: NominalModel | None, thresholds: Thresholds
    ):
        self.predictions, self.scale, self.nominal = predictions, scale, nominal
        self.metric = 1.0 if nominal is None else scale / nominal.scale_in(predictions.data)
        self._thresholds = thresholds
        self._rolled: dict[tuple[tuple[object, ...], ...], np.ndarray] = {}
        self._terms: dict[tuple[tuple[object, ...], ...], FormulaTerms] = {}

    def scaled(self, effects: Effects) -> np.ndarray:
        """Scaled residuals, ``[W, K, 3]``; the last ones are kept."""
        key = values_key(effects)
        if key not in self._rolled:
            if len(self._rolled) >= _KEPT:
                self._rolled.pop(next(iter(self._rolled)))
            self._rolled[key] = self.predictions.residuals([effects])[0] / self.scale
        return self._rolled[key]

    def direction(self, name: str, columns: np.ndarray, error: float = 0.0) -> Direction:
        """A direction ``[q, W, K, 3]`` with how much it varies on the healthy robot.

        Args:
            name: of an effect or of a term of a formula.
            columns: change of the scaled residuals by each coefficient.
            error: mean square of what errors of other effects do, in nominal units.
        """
        if self.nominal is None:
            return Direction(name, columns)
        added = self._thresholds.model_error * float(np.sqrt(error))
        variation, degrees = self.nominal.variation_of(name, self._thresholds.drive_share)
        return Direction(name, columns, float(np.hypot(variation, added)), degrees)

    def influence(self, base: Effects, effect: tuple[str, Mapping[str, float]]) -> Direction:
        """Change of the residuals by an effect in addition to a base, one column for each parameter that was fitted.

        It is not compared with errors of the base's effects: it may be weak beside them, and what it removes on
        held-out blocks shows that it is there.
        """
        name, values = effect
        known = {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
        own = own_values(self.predictions.robot, name)
        hypotheses: list[Effects] = []
        if len(values) == 1:
            hypotheses.append((*base, effect))
        else:
            neutral = {key: own.get(key, known[key].neutral) for key in values}
            for key, value in values.items():
                least = _SMALLEST_SECANT * known[key].typical(self.predictions.robot)
                away = value - neutral[key]
                changed = value if abs(away) > least else neutral[key] + (least if away >= 0 else -least)
                if not known[key].low <= changed <= known[key].high:
                    changed = neutral[key] - (changed - neutral[key])
                hypotheses.append((*base, (name, {**neutral, key: changed})))
        changed_rows = self.predictions.residuals(hypotheses) / self.scale
        return self.direction(name, np.nan_to_num(changed_rows - self.scaled(base)))

    def formula_terms(self, base: Effects) -> FormulaTerms:
        """What every term of a formula does in addition to a base; kept, for a formula is fitted from it, too."""
        key = values_key(base)
        if key not in self._terms:
            if len(self._terms) >= _KEPT_TERMS:
                self._terms.pop(next(iter(self._terms)))
            self._terms[key] = FormulaTerms.of(self.predictions, base, self.scale)
        return self._terms[key]

    def of_formula(self, base: Effects, fixed: int = 0) -> list[Direction]:
        """Change of the residuals by each term of a formula in addition to a base, ``fixed`` of which were measured."""
        terms = self.formula_terms(base)
        error = self.mean_square(base, fixed, self.metric)
        return [
            self.direction(f"{LEARNED} {key}", (row - terms.without)[None], error)
            for key, row in zip(terms.keys, terms.with_each, strict=True)
        ]

    def of_changes(self, base: Effects, fixed: int = 0) -> list[Direction]:
        """A change of each effect of a base over the recording, with the speed, the direction of turning and the
        heading."""
        data = self.predictions.data
        twists = data.commands.sample(data.starts + round(0.5 * data.horizon * 1e9))
        turning = np.sign(twists[:, 1])
        regimes = {
            "over the recording": _standardised(data.starts * 1e-9)[None],
            "with the speed": _standardised(np.abs(twists[:, 0]))[None],
            "with the direction of turning": (turning - turning.mean())[None],
            "with the heading": self._forward().T,
        }
        return self._changed(base, fixed, regimes)

    def of_heading(self, base: Effects, fixed: int, acting: np.ndarray) -> tuple[list[Direction], list[Direction]]:
        """Changes of each effect of a base with the heading, and in some windows, a mask ``[W]``.

        What changes with the heading comes from outside, from iron near a compass, wind, or a slope.
        """
        regimes = {"with the heading": self._forward().T, "in a part": acting.astype(float)[None]}
        found = self._changed(base, fixed, regimes)
        return found[0::2], found[1::2]

    def _forward(self) -> np.ndarray:
        """Forward axes in the middle of the windows less their mean, ``[W, 2]``."""
        data = self.predictions.data
        forward = sample_motion(data.motion, data.starts + round(0.5 * data.horizon * 1e9))[1][:, :2, 0]
        return forward - forward.mean(axis=0)

    def _changed(self, base: Effects, fixed: int, regimes: Mapping[str, np.ndarray]) -> list[Direction]:
        """Changes of each effect of a base in proportion to each of some factors ``[q, W]``."""
        directions = []
        error = self.mean_square(base, fixed, self.metric)
        for name, _ in base[fixed:]:
            change = self.scaled(base) - self.predictions.residuals([without(base, name)])[0] / self.scale
            for regime, factors in regimes.items():
                direction = self.direction(name, factors[..., None, None] * change, error)
                directions.append(replace(direction, name=f"{name} changes {regime}"))
        return directions

    def late_parts(self) -> list[np.ndarray]:
        """Windows from a third and from two thirds of the recording on, masks ``[W]``."""
        starts = self.predictions.data.starts
        share = (starts - starts[0]) / max(float(np.ptp(starts)), 1.0)
        return [share >= begin for begin in ONSETS]

    def within(self, influences: Sequence[Direction], masks: Sequence[np.ndarray]) -> list[Direction]:
        """The same influences in parts of the recording alone, each a mask of its windows ``[W]``."""
        return [
            replace(entry, name=f"{entry.name} in a part", columns=entry.columns * mask[:, None, None])
            for mask in masks
            for entry in influences
        ]

    def mean_square(self, base: Effects, fixed: int, metric: np.ndarray | float = 1.0) -> float:
        """Mean square of what effects change in addition to the first ``fixed`` ones, in units of the scale."""
        if len(base) <= fixed:
            return 0.0
        change = self.scaled(base) - self.scaled(base[:fixed])
        return float(np.sum((np.nan_to_num(change) * metric) ** 2)) / motion_count(change)


def _standardised(values: np.ndarray) -> np.ndarray:
    """Values less their mean, in units of their standard deviation."""
    away = values - values.mean()
    return away / max(float(away.std()), 1e-9)
