"""Selection: which effects explain a recording.

Every effect is screened by a quick fit. Its influence on the residuals is then tested against the null distribution of
the strongest of all candidates on this very recording (:mod:`score_test`). Where one is significant, the best of those
that are significant by themselves is the one with the smallest held-out loss, by two-fold cross-validation over blocks.
Effects are added one at a time while a further one is significant in the presence of the others; then each is tested
again, and may be dropped or replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student_distribution

from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.directions import Directions
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.fit import (
    Fit,
    estimate_effects,
    first_values,
    fit_effects,
    flat,
    jacobian,
    robust,
    robust_weights,
    scales,
    without,
)
from monoforce_ros.discrepancy.hypothesis import Effects, EvidenceWindows, Predictions
from monoforce_ros.discrepancy.learned import learned_terms
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.score_test import Direction, ScoreResult, block_numbers, score_tests
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import (
    FOLDS,
    HEALTHY_LOSS,
    CandidateScore,
    FitTest,
    Outcome,
    Trial,
    excess_share,
    expected_loss,
    folds_of,
    paired,
)
from monoforce_ros.effects import CATALOGUE, Effect, identifiable_effects, separating_sensor
from monoforce_ros.robots import RobotModel

_JUDGED = 6
"""Significant effects that are cross-validated in one round, those with the smallest screening loss first."""
_FITTED = 8
"""Effects with one parameter that are fitted in one round, those that promise the smallest loss first. More than are
judged afterwards; fewer than all of them only to save time."""
_HOPELESS = 0.3
"""p-value of an effect by itself at its best initial value above which it is not fitted: ten times the rate at which
effects count as significant among all candidates. It only saves time."""
_ALTERNATIVES = 2
"""Combinations that do not begin with the best single effect and are tried where that one leads to no good fit."""


@dataclass(frozen=True)
class Screened:
    """A candidate after its quick fit."""

    effects: Effects
    """With the base's effects before it."""
    loss: float
    """On the subsampled windows."""
    test: ScoreResult

    @property
    def name(self) -> str:
        """Of the candidate."""
        return self.effects[-1][0]


class Search:
    """A search over effects on one recording.

    Args:
        robot: robot with the effects of its file.
        data: the recording's windows.
        scale: expected size of a residual, ``[W, K, 3]``.
        nominal: what commissioning learned; None for a robot that was never commissioned.
        known: effects that another sensor measured: they always act and keep their values.
        hints: values that another sensor suggests; fits start there, too.
        excluded: effects that another sensor rules out.
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
        thresholds: Thresholds = Thresholds(),  # noqa: B008
        seed: int = 0,
        progress: Callable[[str], None] = lambda step: None,
    ):
        self.robot, self.data, self.nominal, self.thresholds = robot, data, nominal, thresholds
        self.scale = np.broadcast_to(scale, (len(data.starts), len(data.samples), 3))
        self.known = known
        self.predictions = Predictions(robot, data)
        self.directions = Directions(self.predictions, self.scale, nominal, thresholds)
        self._seed, self._progress = seed, progress
        starts = data.starts
        self._coarse = Predictions(robot, replace(data, starts=starts[::2]))
        self._coarse_scale = self.scale[::2]
        self._sparse = Predictions(robot, replace(data, starts=starts[::4]))
        self._sparse_scale = self.scale[::4]
        self._blocks = block_numbers(starts, thresholds.block)
        folds = folds_of(starts)
        # A window that reaches into the next block shares motion with windows of the held-out fold.
        ends = folds_of(np.r_[starts[0], starts + round(data.horizon * 1e9)])[1:]
        self._split = []
        for held_out in range(FOLDS):
            fitted = (folds != held_out) & (ends != held_out)
            if fitted.sum() < 4:
                fitted = folds != held_out
            self._split.append(
                (
                    Predictions(robot, replace(data, starts=starts[fitted])),
                    self.scale[fitted],
                    Predictions(robot, replace(data, starts=starts[folds == held_out])),
                    folds == held_out,
                )
            )
        self._own = dict(robot.effects)
        self._hints = dict(hints)
        self._excluded = set(excluded)
        self._fits: dict[tuple[str, ...], Fit] = {}
        self.variance_ratio: float | None = None
        """Mean variance of the candidates' influence beyond what this recording and the robot file explain, as a share
        of that between segments."""
        self._screenings: dict[tuple[tuple[object, ...], ...], tuple[float, list[Screened]]] = {}
        self._influences: dict[tuple[tuple[object, ...], ...], list[Direction]] = {}
        """Directions of the candidates that were screened last."""

    def run(self, most_effects: int, *, exchange: bool = True) -> Outcome:
        """Add effects while a further one is significant, then test each in the presence of the others.

        Args:
            most_effects: largest number.
            exchange: replace each of several effects by every other one at the end, and find those that are
                indistinguishable from it.
        """
        nominal = Trial((), ((),) * FOLDS, self.loss_of(()))
        start = nominal
        if self.known:
            start = Trial(self.known, (self.known,) * FOLDS, self.loss_of(self.known))
            _, low = self._gain(start, nominal)
            if low > 0:
                # The motion contradicts the measurement of the other sensor.
                self.known, start = (), nominal
        judged, tried = self._round(start, 1, self.thresholds.effect_rate)
        if not judged:
            return Outcome(nominal, start, self.fit_test(start, nominal), tuple(tried), self.variance_ratio)
        best, listed = self._extended(self._preferred(judged), most_effects)
        tried += listed
        fit = self.fit_test(best, nominal)
        for other in [trial for trial in judged if trial.names[-1] not in best.names][:_ALTERNATIVES]:
            # The effect that explains most alone need not be part of the best combination.
            if fit.passed(self.thresholds) or most_effects < 2:
                break
            extended, listed = self._extended(other, most_effects)
            tried += listed
            gain, low = self._gain(best, extended)
            if low > 0 and gain > self.thresholds.smallest_share * nominal.loss:
                best, fit = extended, self.fit_test(extended, nominal)
        exchanged, indistinguishable = self._exchanged(best) if exchange else (best, {})
        if exchanged is not best:
            best, fit = exchanged, self.fit_test(exchanged, nominal)
        return Outcome(nominal, best, fit, tuple(tried), self.variance_ratio, indistinguishable)

    def _extended(self, best: Trial, most_effects: int) -> tuple[Trial, list[CandidateScore]]:
        """Add effects one at a time while a further one is significant."""
        tried: list[CandidateScore] = []
        for step in range(1, most_effects):
            judged, listed = self._round(best, step + 1, self.thresholds.further_rate)
            tried += listed
            if not judged:
                break
            best = self._pruned(self._preferred(judged))
        return best, tried

    def learn(self, base: Effects = (), most: int = 3) -> Trial:
        """The sparse formula that best explains the residuals left by ``base``, with one to ``most`` terms.

        A further term must reduce the held-out loss beyond chance.
        """
        trials = []
        for number, effects in enumerate(learned_terms(self.predictions, base or self.known, self.scale, most)):
            self._progress(f"fitting a formula with {number + 1} terms")
            trials.append(self.judge(effects))
        best = trials[0]
        for trial in trials[1:]:
            if self._gain(best, trial)[1] > 0:
                best = trial
        return best

    @property
    def healthy_loss(self) -> float:
        """Mean loss of the healthy robot."""
        return HEALTHY_LOSS if self.nominal is None else self.nominal.loss

    def loss_of(self, effects: Effects) -> np.ndarray:
        """Robust loss of each window, ``[W]``."""
        return robust(self.predictions.residuals([effects])[0] / self.scale)

    def judge(self, effects: Effects, iterations: int = 4) -> Trial:
        """Cross-validate: fit without each fold, and judge on it."""
        held_out_loss = np.zeros(len(self.data.starts))
        parts, losses = [], []
        for fitted, scale, judged, where in self._split:
            fit = fit_effects(fitted, [effects], scale, iterations=iterations, free=self.fixed_count(effects))
            held_out_loss[where] = robust(judged.residuals([fit.effects])[0] / self.scale[where])
            parts.append(fit.effects)
            losses.append(float(fit.loss.mean()) + float(held_out_loss[where].mean()))
        return Trial(parts[int(np.argmin(losses))], tuple(parts), held_out_loss)

    def refit(self, effects: Effects) -> Fit:
        """Fit to the whole recording."""
        names = tuple(name for name, _ in effects)
        if names not in self._fits:
            self._fits[names] = fit_effects(
                self.predictions, [effects], self.scale, iterations=6, free=self.fixed_count(effects)
            )
        return self._fits[names]

    def healthy_variances(self, fit: Fit) -> np.ndarray:
        """Variance of each parameter of a fit if its effect varies as much as on the healthy robot, ``[P]``."""
        fixed = sum(len(values) for _, values in fit.effects[: self.fixed_count(fit.effects)])
        variances = np.zeros(len(flat(fit.effects)))
        if self.nominal is None or fit.derivatives is None:
            return variances
        typical, at = scales(fit.effects), 0
        for name, values in fit.effects:
            place = np.arange(at, at + len(values))
            at += len(values)
            if place[0] < fixed:
                continue
            columns = (fit.derivatives[place - fixed] * self.directions.metric).reshape(len(values), -1)
            squares = columns @ columns.T / columns.shape[1]
            squares += 1e-6 * np.trace(squares) * np.eye(len(values)) + 1e-12 * np.eye(len(values))
            spread = (
                self.nominal.variation_of(name, self.thresholds.drive_share)[0] ** 2
                / len(values)
                * np.linalg.inv(squares)
            )
            variances[place] = np.diag(spread) * typical[place] ** 2
        return variances

    def estimates(
        self, fit: Fit, indistinguishable: Mapping[str, Sequence[str]] | None = None
    ) -> tuple[EffectEstimate, ...]:
        """Fitted effects with intervals that hold the healthy robot's variation too."""
        return estimate_effects(
            fit,
            indistinguishable or {},
            healthy_variances=self.healthy_variances(fit),
            segments=0 if self.nominal is None else self.nominal.segments,
            confidence=self.thresholds.confidence,
        )

    def _credible(self, trial: Trial) -> bool:
        """Whether the effect that was added last is a measurement."""
        estimate = self.estimates(self.refit(trial.effects))[-1]
        in_file = {} if CATALOGUE[estimate.name].stage == "measurement" else dict(self._own.get(estimate.name, {}))
        return not complaint(estimate, {key: float(value) for key, value in in_file.items()})

    def ranked(self, fit: Fit) -> list[int]:
        """Indices of a fit's effects, ranked by leave-one-out loss: the loss of the others, fitted again without it."""
        if len(fit.effects) < 2:
            return list(range(len(fit.effects)))
        losses = []
        for i in range(len(fit.effects)):
            others = fit.effects[:i] + fit.effects[i + 1 :]
            free = self.fixed_count(others)
            alone = fit_effects(self._coarse, [others], self._coarse_scale, iterations=4, free=free)
            losses.append(float(alone.loss.mean()))
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
        tests = self._tested(base, residual, directions)
        least = self.thresholds.smallest_share * nominal.loss
        strongest = min((test for test in tests if test.gain > least), key=lambda test: test.adjusted, default=None)
        p, name = (1.0, "") if strongest is None else (strongest.adjusted, strongest.name)
        healthy, spread = self.nominal, self.thresholds.drive_spread
        if healthy is not None and healthy.segments > 1:
            # An effect of the right kind leaves some of what it does: no formula is exact.
            change = self.directions.scaled(base) - self.directions.scaled(base[:fixed])
            expected = expected_loss(healthy.loss, change, self.thresholds.model_error)
            above = np.log(max(trial.loss, 1e-9) / expected)
            size = float(student_distribution.sf(above / spread, self.thresholds.calibration_degrees))
            if above < spread:
                # What is about as small as on the healthy robot is nothing that is missing.
                p, name = 1.0, ""
            if trial.loss - healthy.loss > least and size < p:
                p, name = size, "residuals that are too large"
            # Two tests: the smaller p-value of two has twice the rate.
            p = min(1.0, 2.0 * p)
        explained = 1.0
        if self.nominal is not None and self.nominal.segments > 0 and trial.effects:
            explained = excess_share(nominal.loss, trial.loss, self.healthy_loss)
        return FitTest(p, name, tuple(tests), explained)

    def screened(self, thresholds: Thresholds) -> list[ScoreResult]:
        """Tests of all candidates alone, as if healthy drives varied as ``thresholds`` say."""
        key = _key(self.known)
        if key not in self._influences:
            self._screenings.pop(key, None)
            self._screened(self.known, "1: ")
        directions = self._influences[key]
        if self.nominal is not None:
            varied = [self.nominal.variation_of(entry.name, thresholds.drive_share) for entry in directions]
            directions = [
                replace(entry, variation=variation, degrees=degrees)
                for entry, (variation, degrees) in zip(directions, varied, strict=True)
            ]
        return self._tested(self.known, self.directions.scaled(self.known), directions)

    def _tested(self, base: Effects, residual: np.ndarray, directions: Sequence[Direction]) -> list[ScoreResult]:
        fixed = self.fixed_count(base)
        free = sum(len(values) for _, values in base[fixed:])
        fitted = None
        if free:
            skipped = sum(len(values) for _, values in base[:fixed])
            rows = jacobian(self.predictions, base, residual, self.scale, skipped)
            fitted = rows.reshape(free, *residual.shape)
        weights = robust_weights(residual)
        return score_tests(
            residual, weights, self._blocks, directions, fitted=fitted, metric=self.directions.metric,
            draws=self.thresholds.draws, seed=self._seed,
        )  # fmt: skip

    def fixed_count(self, effects: Effects) -> int:
        """Number of leading effects that keep the values which another sensor measured."""
        return len(self.known) if effects[: len(self.known)] == self.known else 0

    def _screened(self, base: Effects, number: str) -> tuple[float, list[Screened]]:
        """Loss of ``base``, and a quick fit and test of every further effect, smallest loss first."""
        key = _key(base)
        if key in self._screenings:
            return self._screenings[key]
        before = float(robust(self._coarse.residuals([base])[0] / self._coarse_scale).mean())
        residual = self._sparse.residuals([base])[0] / self._sparse_scale
        names = {name for name, _ in base}
        tried: list[tuple[float, Effect, Effects]] = []
        for effect in identifiable_effects(self.robot):
            if effect.name in names or effect.name in self._excluded:
                continue
            self._progress(f"{number}{effect.name}")
            tried.append(self._tried(effect, base, residual))
        tried.sort(key=lambda entry: entry[0])
        residual = self.directions.scaled(base)
        directions = [self.directions.influence(base, start[-1]) for _, _, start in tried]
        tests = self._tested(base, residual, directions)
        # Only what may be significant, and promises to reduce the loss, is fitted; others keep their initial values.
        fits = []
        for rank, (_, effect, start) in enumerate(tried):
            promising = tests[rank].p <= _HOPELESS and (rank < _FITTED or len(effect.identified) > 1)
            iterations = 2 if promising else 0
            fit = fit_effects(self._coarse, [start], self._coarse_scale, iterations=iterations, free=len(base))
            fits.append(fit)
            if fit.effects != start:
                directions[rank] = self.directions.influence(base, fit.effects[-1])
        tests = self._tested(base, residual, directions)
        screened = [Screened(fit.effects, float(fit.loss.mean()), test) for fit, test in zip(fits, tests, strict=True)]
        if base == self.known and self.nominal is not None and self.nominal.segments:
            ratios = [test.excess / self.nominal.between_segments(test.name)[0] for test in tests if test.p < 1.0]
            share = 1.0 / self.nominal.segments
            self.variance_ratio = float(np.mean(ratios)) - share if ratios else None
        self._influences = {key: directions}
        self._screenings[key] = (before, sorted(screened, key=lambda entry: entry.loss))
        return self._screenings[key]

    def _tried(self, effect: Effect, base: Effects, residual: np.ndarray) -> tuple[float, Effect, Effects]:
        """Loss that an effect promises on some windows, and the best of its initial values.

        The promised loss is the smallest at an initial value, or along the straight line from ``base`` to one.
        """
        starts = [base + start for start in self._starts(effect)]
        scaled = np.nan_to_num(self._sparse.residuals(starts) / self._sparse_scale)
        losses = robust(scaled).mean(axis=1)
        weights = robust_weights(residual)
        changes = scaled - residual
        slopes = (weights * residual * changes).sum(axis=(1, 2, 3))
        curvatures = np.maximum((weights * changes**2).sum(axis=(1, 2, 3)), 1e-12)
        promised = robust(residual).mean() - 0.5 * slopes**2 / curvatures / residual.size
        return float(min(promised.min(), losses.min())), effect, starts[int(np.argmin(losses))]

    def _round(self, best: Trial, number: int, rate: float) -> tuple[list[Trial], list[CandidateScore]]:
        """Trials with one more effect that is significant, smallest held-out loss first, and the scores of all."""
        base = self.refit(best.effects).effects if best.effects else ()
        before, screened = self._screened(base, f"{number}: ")
        judged = []
        for entry in admitted(screened, before, rate)[:_JUDGED]:
            self._progress(f"{number}: {entry.name}, judged")
            judged.append(self.judge(entry.effects))
        listed = []
        for entry in screened:
            trial = next((trial for trial in judged if trial.names[-1] == entry.name), None)
            gain = before - entry.loss if trial is None else self._gain(best, trial)[0]
            listed.append(
                CandidateScore(entry.name, number, float(gain), entry.test.adjusted, judged=trial is not None)
            )
        kept = [trial for trial in judged if self._pays(best, trial) and self._credible(trial)]
        return sorted(kept, key=lambda trial: trial.loss), listed

    def _pays(self, before: Trial, after: Trial) -> bool:
        """Whether a significant effect predicts held-out blocks better.

        Of a robot that was never commissioned the test does not know how much the model's own error does: the gain must
        then be beyond chance. Else it need only be large enough, for effects that few blocks show gain in few of them.
        """
        gain, low = self._gain(before, after)
        commissioned = self.nominal is not None and self.nominal.segments > 0
        # Where residuals are far below what counts as healthy, any share of them is nothing.
        least = self.thresholds.smallest_share * max(before.loss, self.healthy_loss)
        return gain > least and (commissioned or low > 0)

    def _gain(self, before: Trial, after: Trial) -> tuple[float, float]:
        rate = self.thresholds.comparison_rate
        return paired(before.held_out_loss, after.held_out_loss, self.data.starts, rate)

    def _preferred(self, judged: list[Trial]) -> Trial:
        """The best trial, or one that is not significantly worse with fewer parameters."""
        best = judged[0]
        for trial in judged[1:]:
            _, low = self._gain(trial, best)
            if _parameter_count(trial) < _parameter_count(best) and low <= 0:
                best = trial
        return best

    def _pruned(self, best: Trial) -> Trial:
        """The trial without effects that are no longer significant in the presence of the others."""
        for name in best.names[len(self.known) : -1]:
            fewer = self.judge(without(best.effects, name))
            base = self.refit(fewer.effects).effects
            residual = self.directions.scaled(base)
            effect = next(entry for entry in best.effects if entry[0] == name)
            (test,) = self._tested(base, residual, [self.directions.influence(base, effect)])
            if test.p > self.thresholds.further_rate or not self._pays(fewer, best):
                best = fewer
        return best

    def _exchanged(self, best: Trial) -> tuple[Trial, dict[str, list[str]]]:
        """Replace each effect by every other one; also returns those that explain the recording about as well."""
        indistinguishable = {}
        for name in best.names[len(self.known) :]:
            if name not in best.names:
                continue
            base = tuple(entry for entry in self.refit(best.effects).effects if entry[0] != name)
            before, screened = self._screened(base, f"{name} or ")
            reached = float(
                robust(self._coarse.residuals([self.refit(best.effects).effects])[0] / self._coarse_scale).mean()
            )
            near = [entry for entry in screened if entry.name != name and entry.loss < 0.5 * (before + reached)]
            judged = sorted([*(self.judge(entry.effects) for entry in near[:_JUDGED]), best], key=lambda t: t.loss)
            if judged[0] is not best and self._gain(best, judged[0])[1] > 0:
                best = judged[0]
            kept = best.names[-1] if name not in best.names else name
            others = [trial for trial in judged if trial is not best]
            indistinguishable[kept] = self._indistinguishable(best, others, kept)
        return best, indistinguishable

    def _indistinguishable(self, best: Trial, judged: Sequence[Trial], effect: str) -> list[str]:
        """Effects that explain the recording about as well in place of ``effect``.

        The other explanation is fitted; if what the best one predicts beyond it is not significant in its residuals
        (Davidson and MacKinnon's J test), the recording does not tell them apart.
        """
        found = []
        chosen = self.predictions.residuals([self.refit(best.effects).effects])[0] / self.scale
        for trial in judged:
            other = next((name for name in trial.names if name not in best.names), None)
            if other is None:
                continue
            base = self.refit(trial.effects).effects
            residual = self.directions.scaled(base)
            (test,) = self._tested(
                base, residual, [self.directions.direction(effect, np.nan_to_num(chosen - residual)[None])]
            )
            if test.p > self.thresholds.comparison_rate or separating_sensor(other, effect):
                found.append(other)
        return found

    def _starts(self, effect: Effect) -> list[Effects]:
        name = effect.name
        starts = first_values(effect)
        if name in self._own and effect.stage != "measurement":
            known = {key: float(value) for key, value in dict(self._own[name]).items()}
            starts = [((name, {**known, **_changed(effect, values, known)}),) for ((_, values),) in starts]
            starts.append(((name, {key: known.get(key, value) for key, value in starts[0][0][1].items()}),))
        if name in self._hints:
            starts.append(((name, {**dict(starts[0][0][1]), **dict(self._hints[name])}),))
        return starts


def admitted(screened: Sequence[Screened], before: float, rate: float) -> list[Screened]:
    """Candidates that are cross-validated, in their order.

    That something is missing has to be shown among all candidates: one of them must be significant after adjustment.
    Which it is, is then a choice between explanations: every effect that is significant by itself takes part in it, for
    the best one may be the least certain (low friction varies most on the healthy robot, too).

    Args:
        screened: candidates after their quick fits.
        before: loss without any of them.
        rate: error rate of both steps.
    """
    better = [entry for entry in screened if entry.loss < before]
    if not any(entry.test.adjusted <= rate for entry in better):
        return []
    return [entry for entry in better if entry.test.p <= rate]


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


def _key(effects: Effects) -> tuple[tuple[object, ...], ...]:
    """Names and values of effects, hashable."""
    return tuple((name, *values.values()) for name, values in effects)


def _parameter_count(trial: Trial) -> int:
    """Parameters of the effect that was added last."""
    return len(CATALOGUE[trial.names[-1]].identified)
