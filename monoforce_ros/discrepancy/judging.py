"""Judging: effects fitted to one recording, and judged on the parts of it that they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.directions import Directions
from monoforce_ros.discrepancy.estimates import EffectEstimate, effect_sizes
from monoforce_ros.discrepancy.evidence import EvidenceWindows
from monoforce_ros.discrepancy.fit import (
    Fit,
    estimate_effects,
    fit_effects,
    flat,
    neutral_values,
    robust,
    scales,
    without,
)
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, own_values
from monoforce_ros.discrepancy.left_out import values_without_parts
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.residual_size import ResidualSize, drive_spread, residual_size
from monoforce_ros.discrepancy.score_test import motion_count
from monoforce_ros.discrepancy.screening import Screening
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import (
    HEALTHY_LOSS,
    FitTest,
    Trial,
    excess_share,
    expected_loss,
    fold_count,
    folds_of,
    paired,
)
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel

_SLOWEST_CYCLE = 0.1
"""Longest time between commands that counts [s]: base controllers read them at 10 Hz or faster, also where they are
sent on change only."""
_CYCLE = next(effect for effect in CATALOGUE.values() if effect.shifts_cycle)
"""By which commands act sooner or later, as they do where a controller's cycle begins at another time."""


class Judging:
    """Fits and judges effects on one recording.

    Args:
        robot: robot with the effects of its file.
        data: the recording's windows.
        scale: expected size of a residual, ``[W, K, C]``.
        nominal: what commissioning learned; None for a robot that was never commissioned.
        known: effects that another sensor measured: they act and keep their values unless the motion contradicts them.
        hints: values that another sensor suggests; fits start there, too.
        excluded: effects that another sensor rules out.
        of_time: whether effects that grow with time are candidates, too, without a hint.
        thresholds: error rates.
        progress: called with a description of the next step.
    """

    def __init__(
        self,
        robot: RobotModel,
        data: EvidenceWindows,
        scale: np.ndarray,
        *,
        nominal: NominalModel | None = None,
        known: Effects = (),
        hints: Effects = (),
        excluded: Sequence[str] = (),
        of_time: bool = False,
        thresholds: Thresholds = Thresholds(),  # noqa: B008
        seed: int = 0,
        progress: Callable[[str], None] = lambda step: None,
    ):
        self.robot, self.data, self.nominal, self.thresholds = robot, data, nominal, thresholds
        self.scale = np.broadcast_to(scale, (len(data.starts), len(data.samples), len(data.components)))
        self.seed = seed
        self.predictions = Predictions(robot, data)
        self.directions = Directions(self.predictions, self.scale, nominal, thresholds)
        self._progress = progress
        self.screening = Screening(
            robot, data, self.directions, hints=hints, excluded=excluded, of_time=of_time,
            thresholds=thresholds, seed=seed, progress=progress,
        )  # fmt: skip
        starts = data.starts
        self.fold_count = fold_count(starts)
        self._folds = folds_of(starts, self.fold_count)
        self._ends = folds_of(np.r_[starts[0], starts + round(data.horizon * 1e9)], self.fold_count)[1:]
        self._fits: dict[tuple[tuple[str, ...], ...], Fit] = {}
        self.known = () if known and self._contradicts(known) else known
        """Effects that another sensor measured, unless the motion contradicts them."""

    def _contradicts(self, known: Effects) -> bool:
        """Whether the motion is predicted better beyond chance without effects that a sensor measured."""
        measured = Trial(known, (known,) * self.fold_count, self.loss_of(known))
        return self._gain(measured, self._without_effects)[1] > 0

    @property
    def commissioned(self) -> bool:
        """Whether the residuals of the healthy robot are known."""
        return self.nominal is not None and self.nominal.segments > 0

    @property
    def healthy_loss(self) -> float:
        """Mean loss of the healthy robot."""
        return HEALTHY_LOSS if self.nominal is None else self.nominal.loss

    @property
    def healthy_spread(self) -> float:
        """Standard deviation of the logarithm of the healthy robot's mean loss on a drive; 0 where it is unknown."""
        healthy = self.nominal
        return 0.0 if healthy is None or not healthy.segments else drive_spread(healthy, self.thresholds)

    def loss_of(self, effects: Effects) -> np.ndarray:
        """Robust loss of each window, ``[W]``."""
        return robust(self.directions.scaled(effects))

    def judge(self, effects: Effects) -> Trial:
        """Cross-validate: judge each fold with the values that the effects have without it."""
        fit = self.refit(effects)
        unchanged = np.concatenate([self._without(name, values) for name, values in fit.effects] or [np.zeros(0)])
        typical = scales(fit.effects, self.robot)
        parts = values_without_parts(fit, self._folds, self._ends, self.fold_count, unchanged, typical)
        residuals = self.predictions.residuals_by_part(self._folds, parts)
        return Trial(fit.effects, parts, robust(residuals / self.scale))

    def _without(self, name: str, values: Mapping[str, float]) -> np.ndarray:
        """Values of an effect's parameters on the nominal robot."""
        own, neutral = own_values(self.robot, name), neutral_values(((name, values),))
        return np.array([own.get(key, value) for key, value in zip(values, neutral, strict=True)])

    def refit(self, effects: Effects) -> Fit:
        """Fit to the whole recording; kept, and repeated from values that explain it better."""
        key = tuple((name, *values) for name, values in effects)
        known = self._fits.get(key)
        if known is not None and (
            known.effects == effects or float(self.loss_of(effects).mean()) >= float(known.loss.mean())
        ):
            return known
        self._fits[key] = fit_effects(
            self.predictions, [effects], self.scale, iterations=6, free=self.fixed_count(effects)
        )
        return self._fits[key]

    def fixed_count(self, effects: Effects) -> int:
        """Number of leading effects that keep the values which another sensor measured."""
        return len(self.known) if effects[: len(self.known)] == self.known else 0

    def healthy_covariance(self, fit: Fit) -> np.ndarray:
        """Covariance of the parameters of a fit if each effect varies as much as on the healthy robot, ``[P, P]``."""
        fixed = sum(len(values) for _, values in fit.effects[: self.fixed_count(fit.effects)])
        count = len(flat(fit.effects))
        covariance = np.zeros((count, count))
        if self.nominal is None or fit.derivatives is None:
            return covariance
        typical, at = scales(fit.effects, self.robot), 0
        for name, values in fit.effects:
            place = np.arange(at, at + len(values))
            at += len(values)
            if place[0] < fixed:
                continue
            columns = (fit.derivatives[place - fixed] * self.directions.metric).reshape(len(values), -1)
            squares = columns @ columns.T / motion_count(fit.derivatives[0])
            squares += 1e-6 * np.trace(squares) * np.eye(len(values)) + 1e-12 * np.eye(len(values))
            spread = (
                self.nominal.variation_of(name, self.thresholds.drive_share)[0] ** 2
                / len(values)
                * np.linalg.inv(squares)
            )
            covariance[np.ix_(place, place)] = spread * np.outer(typical[place], typical[place])
        return covariance

    def formula_variances(self, fit: Fit) -> np.ndarray:
        """Variance of each parameter of a fit because its effect's formula is not exact, ``[P]``.

        It grows with the square of the effect's size, beyond what the robot's file says.
        """
        found = [effect_sizes(name, values, self._without(name, values)) for name, values in fit.effects]
        return (self.thresholds.formula_error * np.concatenate([*found, np.zeros(0)])) ** 2

    def estimates(
        self, fit: Fit, indistinguishable: Mapping[str, Sequence[str]] | None = None
    ) -> tuple[EffectEstimate, ...]:
        """Fitted effects with intervals that hold the healthy robot's variation and the formulas' errors, too."""
        return estimate_effects(
            fit,
            indistinguishable or {},
            healthy_covariance=self.healthy_covariance(fit),
            segments=0 if self.nominal is None else self.nominal.segments,
            formula_variances=self.formula_variances(fit),
            confidence=self.thresholds.confidence,
        )

    def credible(self, trial: Trial, last: int | None = None) -> bool:
        """Whether the effects of a trial that no sensor measured, or the ``last`` of them, are measurements."""
        fit = self.refit(trial.effects)
        first = self.fixed_count(fit.effects) if last is None else len(fit.effects) - last
        if any(self._within_a_command(name, values) for name, values in fit.effects[first:]):
            return False
        return not any(
            complaint(replace(estimate, in_file=own_values(self.robot, estimate.name)))
            for estimate in self.estimates(fit)[first:]
        )

    @property
    def command_interval(self) -> float:
        """Time between two commands, at most that of the slowest controllers [s]; 0 of a robot never commissioned.

        A base controller reads commands in its own cycle: how long the last one has lain there, up to the time between
        two, differs from one start of a healthy robot to the next.
        """
        stamps = self.data.commands.stamps
        if not self.commissioned or len(stamps) < 2:
            return 0.0
        return min(float(np.median(np.diff(stamps))) * 1e-9, _SLOWEST_CYCLE)

    def _within_a_command(self, name: str, values: Mapping[str, float]) -> bool:
        """Whether an effect only shifts the motion by less than the time between two commands."""
        key = CATALOGUE[name].shifts if name in CATALOGUE else ""
        if not key or key not in values:
            return False
        return abs(values[key] - own_values(self.robot, name).get(key, 0.0)) <= self.command_interval

    def start_of_cycle(self, best: Trial, *, explained: bool) -> Effects:
        """The effect by which the base reads commands sooner or later than on the healthy robot; none where it is more
        than the time between two commands, which is a fault, or explains nothing.

        Args:
            best: the effects that were found.
            explained: whether they are the explanation: another beginning of the cycle then takes the place of one of
                them, as of a lag, if it predicts better.
        """
        interval = self.command_interval
        if not interval or any(CATALOGUE[name].shifts for name in best.names if name in CATALOGUE):
            return ()
        reached = self.screening.quick_loss(self.refit(best.effects).effects if best.effects else self.known)
        found = [without(best.effects, name) for name in best.names[self.fixed_count(best.effects) :]]
        trials = [self._with_start_of_cycle(base, interval, reached) for base in found]
        better = [trial for trial in trials if trial is not None and self._gain(best, trial)[1] > 0.0]
        beside = None if explained else self._with_start_of_cycle(best.effects or self.known, interval, reached)
        if beside is not None and self._adds(best, beside):
            better.append(beside)
        return min(better, key=lambda trial: trial.loss).effects[-1:] if better else ()

    def _with_start_of_cycle(self, others: Effects, interval: float, reached: float) -> Trial | None:
        """The trial with another beginning of the cycle, by at most an interval, where it is significant and leaves
        less than the loss that is reached without it."""
        base = self.refit(others).effects if others else ()
        fixed, residual = self.fixed_count(base), self.directions.scaled(base)
        fits = [
            self.screening.quick_fit((*base, (_CYCLE.name, {_CYCLE.shifts: offset})), len(base), 4)
            for offset in (-0.5 * interval, 0.5 * interval)
        ]
        effects, loss = min(fits, key=lambda fit: fit[1])
        if loss >= reached:
            return None
        (test,) = self.screening.tested(base, fixed, residual, [self.directions.influence(base, effects[-1])])
        if test.p > self.thresholds.further_rate:
            return None
        trial = self.judge(effects)
        return trial if abs(dict(trial.effects)[_CYCLE.name][_CYCLE.shifts]) <= interval else None

    def ranked(self, fit: Fit) -> list[int]:
        """Indices of a fit's effects, ranked by leave-one-out loss: the loss of the others, fitted again without it."""
        if len(fit.effects) < 2:
            return list(range(len(fit.effects)))
        losses = []
        for i in range(len(fit.effects)):
            others = fit.effects[:i] + fit.effects[i + 1 :]
            free = self.fixed_count(others)
            losses.append(self.screening.quick_fit(others, free, 4)[1])
        return sorted(range(len(losses)), key=lambda i: -losses[i])

    def fit_test(self, trial: Trial, nominal: Trial) -> FitTest:
        """Whether the residuals that a trial leaves look like those of the healthy robot.

        Tested together: every term of a formula; a change over the recording, with the speed and with the direction of
        turning of each effect that was found; and the size of the residuals, where the healthy robot's is known.
        What is small beside the nominal model's loss does not count: an effect that is nearly all of an error keeps its
        name, though the model's own error differs a little under it.
        """
        self._progress("testing what is left")
        base = self.refit(trial.effects).effects if trial.effects else ()
        fixed = self.fixed_count(base)
        directions = [*self.directions.of_formula(base, fixed), *self.directions.of_changes(base, fixed)]
        residual = self.directions.scaled(base)
        tests = self.screening.tested(base, fixed, residual, directions)
        least = self.thresholds.smallest_share * nominal.loss
        strongest = min((test for test in tests if test.gain > least), key=lambda test: test.adjusted, default=None)
        p, name = (1.0, "") if strongest is None else (strongest.adjusted, strongest.name)
        size = self._size(trial)
        if size is not None:
            if size.above < size.spread:
                # What is about as small as on the healthy robot is nothing that is missing.
                p, name = 1.0, ""
            if trial.loss - self.healthy_loss > least and size.p < p:
                p, name = size.p, "residuals that are too large"
            # Two tests: the smaller p-value of two has twice the rate.
            p = min(1.0, 2.0 * p)
        explained = 1.0
        if self.commissioned and trial.effects:
            spread = self.healthy_spread if size is None else size.spread
            explained = excess_share(nominal.loss, trial.loss, self.healthy_loss, spread)
        return FitTest(p, name, tuple(tests), explained)

    def size_p(self, trial: Trial) -> float | None:
        """p-value of a healthy robot's residuals as large as a trial's; None where these are unknown."""
        size = self._size(trial)
        # Two tests of a trial: the size of its residuals, and their directions.
        return None if size is None else 2.0 * size.p

    def _size(self, trial: Trial, *, exact: bool = False) -> ResidualSize | None:
        """How much larger a trial's residuals are than a healthy robot's; None where these are unknown.

        An effect of the right kind leaves some of what it does, for no formula is exact: that is expected, too, unless
        formulas count as ``exact``.
        """
        healthy = self.nominal
        if healthy is None or healthy.segments < 2:
            return None
        expected = healthy.loss
        if not exact:
            base = self.refit(trial.effects).effects if trial.effects else ()
            change = self.directions.scaled(base) - self.directions.scaled(base[: self.fixed_count(base)])
            expected = expected_loss(healthy.loss, change, self.thresholds.model_error)
        return residual_size(trial.held_out_loss, self.data.starts, expected, healthy, self.thresholds)

    def _pays(self, before: Trial, after: Trial, *, least: float = 0.0) -> bool:
        """Whether a significant effect predicts held-out blocks better.

        Of a robot that was never commissioned the test does not know how much the model's own error does: the gain must
        then be beyond chance. Else it need only be large enough, for effects that few blocks show gain in few of them.
        """
        gain, low = self._gain(before, after)
        # Where residuals are far below what counts as healthy, any share of them is nothing.
        least = max(least, self.thresholds.smallest_share * max(before.loss, self.healthy_loss))
        return gain > least and (self.commissioned or low > 0)

    def _adds(self, before: Trial, after: Trial) -> bool:
        """Whether an effect beside others pays, and is more than what makes up for the error of their formulas."""
        explained = self._without_effects.loss - before.loss
        return self._pays(before, after, least=self.thresholds.further_share * explained)

    def needs(self, trial: Trial, name: str) -> bool:
        """Whether one of several effects takes away most of what the others leave above a healthy robot's loss, or most
        of what all explain, and held-out windows are predicted worse beyond chance without it."""
        fewer = self.judge(without(trial.effects, name))
        gain, low = self._gain(fewer, trial)
        most, explained = self.thresholds.explained_share, self._without_effects.loss - trial.loss
        left = excess_share(fewer.loss, trial.loss, self.healthy_loss, self.healthy_spread)
        above = fewer.loss > self.healthy_loss * np.exp(self.healthy_spread)
        return low > 0.0 and ((above and left >= most) or gain >= most * explained)

    @cached_property
    def _without_effects(self) -> Trial:
        return Trial((), ((),) * self.fold_count, self.loss_of(()))

    def _gain(self, before: Trial, after: Trial) -> tuple[float, float]:
        rate = self.thresholds.comparison_rate
        return paired(before.held_out_loss, after.held_out_loss, self.data.starts, rate)
