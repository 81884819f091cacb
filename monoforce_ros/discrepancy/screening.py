"""Screening: a quick fit and a test of every effect of the catalogue in addition to a base, on one recording."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.discrepancy.directions import Directions
from monoforce_ros.discrepancy.evidence import EvidenceWindows
from monoforce_ros.discrepancy.fit import first_values, fit_effects, jacobian, robust, robust_weights
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, values_key
from monoforce_ros.discrepancy.score_test import Direction, ScoreResult, block_numbers, motion_count, score_tests
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.effects import Effect, identifiable_effects
from monoforce_ros.robots import RobotModel

_FITTED = 8
"""Effects with one parameter that are fitted in one round, those that promise the smallest loss first. More than are
judged afterwards; fewer than all of them only to save time."""
_ITERATIONS = 3
"""Of these fits: what is far lower than expected is reached in three from any of its initial values, also beside an
effect that moves with it (``test_effect_recovery.py``); later fits go on from there."""
_HOPELESS = 0.3
"""p-value of an effect by itself at its best initial value above which it is not fitted: ten times the rate at which
effects count as significant among all candidates. It only saves time."""


@dataclass(frozen=True)
class Screened:
    """A candidate after its quick fit."""

    effects: Effects
    """With the base's effects before it."""
    loss: float
    """On every second window."""
    test: ScoreResult

    @property
    def name(self) -> str:
        """Of the candidate."""
        return self.effects[-1][0]


@dataclass(frozen=True)
class Candidates:
    """All candidates in addition to a base."""

    before: float
    """Loss of the base on every second window."""
    screened: tuple[Screened, ...]
    """Smallest loss first."""
    influences: tuple[Direction, ...]
    """Changes of the residuals by the candidates."""
    incomplete: bool = False
    """Whether those were fitted, too, that are not significant by themselves."""

    def variance_ratio(self, directions: Directions) -> float | None:
        """Mean variance of the candidates' influence beyond what this recording and the robot file explain, as a share
        of that between segments of the commissioning recording; None where that is unknown."""
        nominal = directions.nominal
        if nominal is None or not nominal.segments:
            return None
        tests = [entry.test for entry in self.screened]
        ratios = [test.excess / nominal.between_segments(test.name)[0] for test in tests if test.p < 1.0]
        return float(np.mean(ratios)) - 1.0 / nominal.segments if ratios else None


class Screening:
    """Screens the effects that can be identified on a robot.

    Args:
        robot: robot with the effects of its file.
        data: the recording's windows.
        directions: of the same windows.
        hints: values that another sensor suggests; fits start there, too.
        excluded: effects that another sensor rules out.
        of_time: whether effects that grow with time are candidates, too, without a hint. An effect that begins late
            looks like them.
        thresholds: error rates.
        seed: of the null distributions.
        progress: called with a description of the next step.
    """

    def __init__(
        self,
        robot: RobotModel,
        data: EvidenceWindows,
        directions: Directions,
        *,
        hints: Effects = (),
        excluded: Sequence[str] = (),
        of_time: bool = False,
        thresholds: Thresholds = Thresholds(),  # noqa: B008
        seed: int = 0,
        progress: Callable[[str], None] = lambda step: None,
    ):
        self._robot, self._directions, self._thresholds = robot, directions, thresholds
        self._hints, self._excluded, self._of_time = dict(hints), set(excluded), of_time
        self._seed, self._progress = seed, progress
        starts, scale = data.starts, directions.scale
        self._coarse, self._coarse_scale = Predictions(robot, replace(data, starts=starts[::2])), scale[::2]
        self._sparse, self._sparse_scale = Predictions(robot, replace(data, starts=starts[::4])), scale[::4]
        self._blocks = block_numbers(starts, thresholds.block)
        self._done: dict[tuple[tuple[object, ...], ...], Candidates] = {}
        self._first: dict[str, tuple[Effects, Direction]] = {}

    def quick_fit(self, effects: Effects, fixed: int, iterations: int) -> tuple[Effects, float]:
        """Effects fitted to every second window, with the first ``fixed`` of them as they are, and their loss there."""
        fit = fit_effects(self._coarse, [effects], self._coarse_scale, iterations=iterations, free=fixed)
        return fit.effects, float(fit.loss.mean())

    def quick_loss(self, effects: Effects) -> float:
        """Loss on every second window."""
        return float(robust(self._coarse.residuals([effects])[0] / self._coarse_scale).mean())

    def tested(
        self,
        base: Effects,
        fixed: int,
        residual: np.ndarray,
        directions: Sequence[Direction],
        *,
        beside: Sequence[Direction] = (),
    ) -> list[ScoreResult]:
        """Tests of directions in addition to a base, of which the first ``fixed`` effects were measured.

        Args:
            base: effects in the model.
            fixed: number of those whose values are not fitted.
            residual: that ``base`` leaves, scaled, ``[W, K, 3]``.
            directions: to be tested.
            beside: what else may explain the residuals.
        """
        free = sum(len(values) for _, values in base[fixed:])
        fitted = [direction.columns for direction in beside]
        if free:
            skipped = sum(len(values) for _, values in base[:fixed])
            rows = jacobian(self._directions.predictions, base, residual, self._directions.scale, skipped)
            fitted.append(rows.reshape(free, *residual.shape))
        return score_tests(
            residual, robust_weights(residual), self._blocks, directions,
            fitted=np.concatenate(fitted) if fitted else None,
            metric=self._directions.metric, draws=self._thresholds.draws, seed=self._seed,
        )  # fmt: skip

    def tested_as_if(self, base: Effects, thresholds: Thresholds) -> list[ScoreResult]:
        """Tests of all candidates in addition to measured effects, if healthy drives varied as ``thresholds`` say."""
        influences = self.candidates(base, len(base), "1: ").influences
        nominal = self._directions.nominal
        if nominal is not None:
            varied = [nominal.variation_of(entry.name, thresholds.drive_share) for entry in influences]
            influences = tuple(
                replace(entry, variation=variation, degrees=degrees)
                for entry, (variation, degrees) in zip(influences, varied, strict=True)
            )
        return self.tested(base, len(base), self._directions.scaled(base), influences)

    def possible(self, names: Collection[str]) -> Iterator[Effect]:
        """The candidates in addition to effects with these names."""
        for effect in self._not_ruled_out(names):
            if self._of_time or not effect.clock or effect.name in self._hints:
                yield effect

    def growing(self, names: Collection[str]) -> Iterator[Effect]:
        """Effects that grow with time, in addition to those with these names, candidates or not."""
        return (effect for effect in self._not_ruled_out(names) if effect.clock)

    def _not_ruled_out(self, names: Collection[str]) -> Iterator[Effect]:
        for effect in identifiable_effects(self._robot):
            if effect.name not in names and effect.name not in self._excluded:
                yield effect

    def candidates(self, base: Effects, fixed: int, number: str, *, incomplete: bool = False) -> Candidates:
        """A quick fit and a test of every effect in addition to a base; kept, for it is asked for again.

        Args:
            base: effects in the model.
            fixed: number of those whose values were measured.
            number: of the round, for the progress.
            incomplete: whether it is known that something is missing: then effects are fitted that are not significant
                by themselves, too.
        """
        key = values_key(base)
        known = self._done.get(key)
        if known is None or (incomplete and not known.incomplete):
            self._done[key] = known = self._screened(base, fixed, number, incomplete)
        return known

    def _screened(self, base: Effects, fixed: int, number: str, incomplete: bool) -> Candidates:
        hopeless = {} if incomplete else self._hopeless(base, fixed)
        residual = self._sparse.residuals([base])[0] / self._sparse_scale
        tried: list[tuple[float, Effect, Effects]] = []
        for effect in self.possible({name for name, _ in base}):
            if effect.name in hopeless:
                continue
            self._progress(f"{number}{effect.name}")
            tried.append(self._tried(effect, base, residual))
        tried.sort(key=lambda entry: entry[0])
        residual, before = self._directions.scaled(base), self.quick_loss(base)
        possible = np.ones(len(tried), bool)
        if not incomplete:
            influences = [self._directions.influence(base, start[-1]) for _, _, start in tried]
            possible = np.array([test.p <= _HOPELESS for test in self.tested(base, fixed, residual, influences)])
        # Only what may be significant, and promises to reduce the loss, is fitted; others keep their initial values.
        # The base's effects are fitted again beside it: alone they took over some of what a further one does, and with
        # the values that they have then nothing leads to it.
        fits = []
        for rank, (_, effect, start) in enumerate(tried):
            promising = possible[rank] and (rank < _FITTED or len(effect.identified) > 1)
            fits.append(self.quick_fit(start, fixed, _ITERATIONS if promising else 0))
        influences = [
            influences[rank] if not incomplete and fit == start else self._directions.influence(base, fit[-1])
            for rank, ((_, _, start), (fit, _)) in enumerate(zip(tried, fits, strict=True))
        ]
        if not self._first:
            self._first = {
                effect.name: (start[len(base) :], influence)
                for (_, effect, start), influence in zip(tried, influences, strict=True)
            }
        for start, influence in hopeless.values():
            fits.append((base + start, before))
            influences.append(influence)
        tests = self.tested(base, fixed, residual, influences)
        screened = [Screened(effects, loss, test) for (effects, loss), test in zip(fits, tests, strict=True)]
        ordered = tuple(sorted(screened, key=lambda entry: entry.loss))
        return Candidates(before, ordered, tuple(influences), incomplete)

    def _hopeless(self, base: Effects, fixed: int) -> dict[str, tuple[Effects, Direction]]:
        """Candidates that are not rolled out again, each with its initial value and its influence in the first round.

        Beside other effects a candidate changes the residuals about as it did without them.
        """
        names = {effect.name for effect in self.possible({name for name, _ in base})}
        listed = {name: entry for name, entry in self._first.items() if name in names}
        if not listed:
            return {}
        directions = [direction for _, direction in listed.values()]
        tests = self.tested(base, fixed, self._directions.scaled(base), directions)
        return {name: listed[name] for name, test in zip(listed, tests, strict=True) if test.p > _HOPELESS}

    def _tried(self, effect: Effect, base: Effects, residual: np.ndarray) -> tuple[float, Effect, Effects]:
        """Loss that an effect promises on every fourth window, and the best of its initial values.

        The promised loss is the smallest at an initial value, or along the straight line from ``base`` to one.
        """
        starts = [base + start for start in self.starts(effect)]
        scaled = np.nan_to_num(self._sparse.residuals(starts) / self._sparse_scale)
        losses = robust(scaled).mean(axis=1)
        weights = robust_weights(residual)
        changes = scaled - residual
        slopes = (weights * residual * changes).sum(axis=(1, 2, 3))
        curvatures = np.maximum((weights * changes**2).sum(axis=(1, 2, 3)), 1e-12)
        promised = robust(residual).mean() - 0.5 * slopes**2 / curvatures / motion_count(residual)
        # One that changes nothing, as the robot file's own, has the smallest loss where every other one is too far, and
        # shows nothing.
        best = int(np.argmin(np.where((changes**2).sum(axis=(1, 2, 3)) > 0.0, losses, np.inf)))
        return float(min(promised.min(), losses.min())), effect, starts[best]

    def starts(self, effect: Effect) -> list[Effects]:
        """Initial values of an effect's fits: over its range, from the robot's file, and what a sensor suggests."""
        name = effect.name
        own = dict(self._robot.effects)
        starts = first_values(effect, self._robot)
        if name in own and effect.stage != "measurement":
            known = {key: float(value) for key, value in dict(own[name]).items()}
            starts = [((name, {**known, **_changed(effect, values, known)}),) for ((_, values),) in starts]
            starts.append(((name, {key: known.get(key, value) for key, value in starts[0][0][1].items()}),))
        if name in self._hints:
            starts.append(((name, {**dict(starts[0][0][1]), **dict(self._hints[name])}),))
        return starts


def admitted(screened: Sequence[Screened], before: float, rate: float, *, incomplete: bool = False) -> list[Screened]:
    """Candidates that are cross-validated, in their order.

    That something is missing has to be shown: by one of all candidates that is significant after adjustment, or by the
    size of what is left. Which it is, is then a choice between explanations, by what each predicts. The best one may be
    the least certain: fast driving alone shows a drag, and low friction varies most on the healthy robot, too.

    Args:
        screened: candidates after their quick fits.
        before: loss without any of them.
        rate: error rate.
        incomplete: whether it is known that something is missing.
    """
    better = [entry for entry in screened if entry.loss < before]
    return better if incomplete or any(entry.test.adjusted <= rate for entry in better) else []


def _changed(effect: Effect, values: Mapping[str, float], known: Mapping[str, float]) -> dict[str, float]:
    """Initial values of a fit where the robot's file has ``known`` ones: as far from these as ``values`` from neutral.

    A factor is multiplied, other parameters are added. Limits, whose neutral value is infinite, stay as they are.
    """
    parameters, changed = {parameter.name: parameter for parameter in effect.parameters}, {}
    for key, value in values.items():
        parameter = parameters[key]
        if key not in known or not np.isfinite(parameter.neutral) or not np.isfinite(known[key]):
            changed[key] = value
            continue
        moved = known[key] * value if parameter.neutral == 1.0 else known[key] + value - parameter.neutral
        changed[key] = float(np.clip(moved, parameter.low, parameter.high))
    return changed
