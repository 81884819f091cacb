"""Selection: which effects explain a recording, by two-fold cross-validation over blocks.

Every effect is screened by a quick fit; the most promising ones are fitted on every other block and judged by their
loss on the remaining blocks. Effects are added one at a time while they reduce the held-out loss enough; then each is
tested again in the presence of the others, and may be dropped or replaced. The folds that judge the effects also select
them, so the loss of the selected effects is somewhat optimistic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import wilcoxon

from monoforce_ros.discrepancy.fit import Fit, first_values, fit_effects, robust, without
from monoforce_ros.discrepancy.hypothesis import Effects, EvidenceWindows, Predictions
from monoforce_ros.discrepancy.learned import learned_terms
from monoforce_ros.effects import CATALOGUE, Effect, identifiable_effects, separating_sensor
from monoforce_ros.robots import RobotModel

HEALTHY_LOSS = 0.5
"""Robust loss of residuals as large as their scale: half the square of a standard deviation."""
SMALLEST_GAIN = 0.05
"""Smallest gain of an added effect, as a share of the loss before."""
SMALLEST_STEP = 0.15
"""Smallest gain of an added effect, absolute: three tenths of a healthy robot's loss."""
_FOLDS = 2
BLOCK = 8.0
"""Length of the blocks that are held out together [s]: longer than a window."""
_ALPHA = 0.01
"""Significance level of one effect's gain; most of the guard against false alarms is the smallest gain."""
_JUDGED = 5
_ALTERNATIVES = 2
_LATER_GAIN = 0.1
"""Smallest gain of a further effect, as a share of the unexplained loss while that is large, else of the loss that was
to be explained: a small remainder is due to the simulator more often than to the robot."""


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted and judged by their held-out loss."""

    effects: Effects
    """With the values of the fold whose fit has the smaller loss."""
    parts: tuple[Effects, ...]
    """Effects fitted with each fold left out."""
    held_out_loss: np.ndarray
    """Loss of each window with the effects fitted without its fold, ``[W]``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(name for name, _ in self.effects)

    @property
    def loss(self) -> float:
        """Mean held-out loss."""
        return float(self.held_out_loss.mean())


@dataclass(frozen=True)
class CandidateScore:
    """The score of one candidate effect in one round of the search."""

    name: str
    round: int
    """From 1 on."""
    gain: float
    """Reduction of the loss: held out where ``judged``, else of the screening fit."""
    p: float
    """One-sided p-value of the gain over blocks; 1 where it was not judged."""
    judged: bool
    """Whether the candidate was cross-validated."""


@dataclass(frozen=True)
class Outcome:
    """The result of a search."""

    nominal: Trial
    best: Trial
    """The nominal trial where no effect was added."""
    tried: tuple[CandidateScore, ...]
    indistinguishable: dict[str, list[str]]
    """By selected effect: others that explain the recording about as well in its place."""


def folds_of(starts: np.ndarray) -> np.ndarray:
    """Fold of each window: alternating blocks."""
    return ((starts - starts[0]) // round(BLOCK * 1e9)).astype(int) % _FOLDS


def blocks_of(starts: np.ndarray) -> np.ndarray:
    """Number of the half block in which each window starts."""
    return ((starts - starts[0]) // round(0.5 * BLOCK * 1e9)).astype(int)


def paired(before: np.ndarray, after: np.ndarray, starts: np.ndarray, seed: int = 0) -> tuple[float, float, float]:
    """Mean gain, its one-sided 95 % lower bound, and the p-value of Wilcoxon's signed-rank test over blocks."""
    blocks = blocks_of(starts)
    numbers = np.unique(blocks)
    # Clipped, so that a few windows that no effect explains do not dominate.
    difference = np.clip(before - after, -50.0, 50.0)
    sums = np.array([difference[blocks == block].sum() for block in numbers]) / len(starts)
    gain = float(sums.sum())
    picked = np.random.default_rng(seed).integers(0, len(sums), (2000, len(sums)))
    # By ranks: a gain in all blocks counts, even where it is much larger in a few of them.
    chance = float(wilcoxon(sums, alternative="greater").pvalue) if np.abs(sums).max() > 1e-12 else 1.0
    return gain, float(np.quantile(sums[picked].sum(axis=1), 0.05)), chance


class Search:
    """A search over effects on one recording.

    Args:
        robot: robot with the effects of its file.
        data: the recording's windows.
        scale: expected size of a residual, ``[K, 3]``.
        known: effects that another sensor measured: they always act and keep their values.
        excluded: effects that another sensor rules out.
        progress: called with a description of the next step.
    """

    def __init__(
        self,
        robot: RobotModel,
        data: EvidenceWindows,
        scale: np.ndarray,
        *,
        known: Effects = (),
        excluded: Sequence[str] = (),
        progress: Callable[[str], None] = lambda step: None,
    ):
        self.robot, self.data, self.scale = robot, data, scale
        self.known = known
        self.predictions = Predictions(robot, data)
        self._progress = progress
        starts = data.starts
        self._coarse = Predictions(robot, replace(data, starts=starts[::2]))
        folds = folds_of(starts)
        # A window that reaches into the next block shares motion with windows of the held-out fold.
        ends = folds_of(np.r_[starts[0], starts + round(data.horizon * 1e9)])[1:]
        self._split = []
        for held_out in range(_FOLDS):
            fitted = (folds != held_out) & (ends != held_out)
            if fitted.sum() < 4:
                fitted = folds != held_out
            self._split.append(
                (
                    Predictions(robot, replace(data, starts=starts[fitted])),
                    Predictions(robot, replace(data, starts=starts[folds == held_out])),
                    folds == held_out,
                )
            )
        self._own = dict(robot.effects)
        # The recording is already corrected for measurement effects in the file; a second one would add to them.
        self._taken = {name for name in self._own if CATALOGUE[name].stage == "measurement"} | set(excluded)

    def run(self, most_effects: int) -> Outcome:
        """Add effects while they reduce the loss enough, then test each in the presence of the others."""
        nominal = Trial((), ((),) * _FOLDS, self.loss_of(()))
        start = nominal
        if self.known:
            start = Trial(self.known, (self.known,) * _FOLDS, self.loss_of(self.known))
            if start.loss > nominal.loss + SMALLEST_STEP:
                # The motion contradicts the measurement of the other sensor.
                self.known, start = (), nominal
        judged, tried = self._round(start, 1)
        found = self._preferred(judged, start) if judged else None
        if found is None or not self._pays(start, found, nominal):
            return Outcome(nominal, start, tuple(tried), {})
        indistinguishable = {found.names[-1]: self._indistinguishable(found, judged)}
        best, listed = self._extended(found, nominal, most_effects)
        tried += listed
        others = [trial for trial in judged if trial is not found and self._pays(start, trial, nominal)]
        for other in others[:_ALTERNATIVES]:
            # The effect that explains most alone need not be part of the best combination.
            if best.loss < 3 * HEALTHY_LOSS or most_effects < 2:
                break
            extended, listed = self._extended(other, nominal, most_effects)
            tried += listed
            gain, low, _ = self._gain(best, extended)
            if low > 0 and gain > _LATER_GAIN * (nominal.loss - HEALTHY_LOSS):
                best = extended
        if len(best.effects) > 1 + len(self.known):
            best, indistinguishable = self._exchanged(best)
        return Outcome(nominal, best, tuple(tried), indistinguishable)

    def _extended(self, best: Trial, nominal: Trial, most_effects: int) -> tuple[Trial, list[CandidateScore]]:
        """Add effects one at a time while each reduces the loss enough."""
        tried: list[CandidateScore] = []
        for step in range(1, most_effects):
            if best.loss < HEALTHY_LOSS:
                # The remaining loss is that of a healthy robot.
                break
            judged, listed = self._round(best, step + 1)
            tried += listed
            if not judged:
                break
            found = self._preferred(judged, best)
            if not self._pays(best, found, nominal):
                break
            best = self._pruned(found, nominal)
        return best, tried

    def learn(self, base: Effects = (), most: int = 3) -> Trial:
        """The sparse formula that best explains the residuals left by ``base``, with one to ``most`` terms.

        A further term must reduce the held-out loss by a tenth.
        """
        trials = []
        for number, effects in enumerate(learned_terms(self.predictions, base or self.known, self.scale, most)):
            self._progress(f"fitting a formula with {number + 1} terms")
            trials.append(self.judge(effects))
        best = trials[0]
        for trial in trials[1:]:
            if trial.loss < 0.9 * best.loss:
                best = trial
        return best

    def drifting(self, trial: Trial, pieces: int = 3) -> tuple[float, list[Effects]]:
        """Reduction of the loss by fits to each third of the recording alone, and these fits."""
        starts = self.data.starts
        gain, fits = 0.0, []
        for part in np.array_split(np.arange(len(starts)), pieces):
            predictions = Predictions(self.robot, replace(self.data, starts=starts[part]))
            fixed = self._fixed_count(trial.effects)
            fit = fit_effects(predictions, [trial.effects], self.scale, iterations=4, free=fixed)
            gain += float(trial.held_out_loss[part].sum() - fit.loss.sum()) / len(starts)
            fits.append(fit.effects)
        return gain, fits

    def loss_of(self, effects: Effects) -> np.ndarray:
        """Robust loss of each window, ``[W]``."""
        return robust(self.predictions.residuals([effects])[0] / self.scale)

    def judge(self, effects: Effects, iterations: int = 4) -> Trial:
        """Cross-validate: fit without each fold, and judge on it."""
        held_out_loss = np.zeros(len(self.data.starts))
        parts, losses = [], []
        for fitted, judged, where in self._split:
            fit = fit_effects(fitted, [effects], self.scale, iterations=iterations, free=self._fixed_count(effects))
            held_out_loss[where] = robust(judged.residuals([fit.effects])[0] / self.scale)
            parts.append(fit.effects)
            losses.append(float(fit.loss.mean()) + float(held_out_loss[where].mean()))
        return Trial(parts[int(np.argmin(losses))], tuple(parts), held_out_loss)

    def refit(self, effects: Effects) -> Fit:
        """Fit to the whole recording."""
        return fit_effects(self.predictions, [effects], self.scale, iterations=6, free=self._fixed_count(effects))

    def ranked(self, fit: Fit) -> list[int]:
        """Indices of a fit's effects, ranked by leave-one-out loss: the loss of the others, fitted again without it."""
        if len(fit.effects) < 2:
            return list(range(len(fit.effects)))
        losses = []
        for i in range(len(fit.effects)):
            others = fit.effects[:i] + fit.effects[i + 1 :]
            alone = fit_effects(self._coarse, [others], self.scale, iterations=4, free=self._fixed_count(others))
            losses.append(float(alone.loss.mean()))
        return sorted(range(len(losses)), key=lambda i: -losses[i])

    def _fixed_count(self, effects: Effects) -> int:
        return len(self.known) if effects[: len(self.known)] == self.known else 0

    def _screened(self, base: Effects, number: str) -> tuple[float, list[tuple[str, Effects, float]]]:
        """Loss of ``base``, and a quick fit of every further effect on every other window, best first."""
        results = []
        before = float(robust(self._coarse.residuals([base])[0] / self.scale).mean())
        names = {name for name, _ in base}
        for effect in identifiable_effects():
            name = effect.name
            if name in names or name in self._taken:
                continue
            self._progress(f"{number}{name}")
            starts = [base + start for start in self._starts(effect)]
            fit = fit_effects(self._coarse, starts, self.scale, iterations=3, free=len(base))
            results.append((name, fit.effects, float(fit.loss.mean())))
        return before, sorted(results, key=lambda entry: entry[2])

    def _round(self, best: Trial, number: int) -> tuple[list[Trial], list[CandidateScore]]:
        before, screened = self._screened(best.effects, f"{number}: ")
        span = before - screened[0][2]
        judged = []
        for place, (name, effects, loss) in enumerate(screened):
            related = bool(name != screened[0][0] and separating_sensor(name, screened[0][0]))
            if (place < _JUDGED or related) and before - loss > 0.05 * span:
                self._progress(f"{number}: {name}, judged")
                judged.append(self.judge(effects))
        listed = []
        for name, _, loss in screened:
            trial = next((trial for trial in judged if trial.names[-1] == name), None)
            gain, _, chance = (before - loss, 0, 1.0) if trial is None else self._gain(best, trial)
            listed.append(CandidateScore(name, number, float(gain), float(chance), judged=trial is not None))
        return sorted(judged, key=lambda trial: trial.loss), listed

    def _gain(self, before: Trial, after: Trial) -> tuple[float, float, float]:
        return paired(before.held_out_loss, after.held_out_loss, self.data.starts)

    def _pays(self, before: Trial, after: Trial, nominal: Trial) -> bool:
        gain, low, chance = self._gain(before, after)
        # A large gain needs less significance: a dozen blocks rarely agree to one in a hundred.
        large = gain > 0.4 * (nominal.loss - HEALTHY_LOSS) and chance < 5 * _ALPHA
        significant = (chance < _ALPHA or large) and low > 0
        least = max(SMALLEST_GAIN * before.loss, SMALLEST_STEP)
        if len(after.effects) > 1 + len(self.known):
            unexplained = before.loss > 3 * HEALTHY_LOSS
            least = max(least, _LATER_GAIN * ((before if unexplained else nominal).loss - HEALTHY_LOSS))
        return significant and gain > least

    def _preferred(self, judged: list[Trial], before: Trial) -> Trial:
        """The best trial, or one about as good with fewer parameters."""
        best = judged[0]
        for trial in judged[1:]:
            margin, low, _ = self._gain(trial, best)
            simpler = _parameter_count(trial) < _parameter_count(best)
            if simpler and (low <= 0 or margin < 0.02 * before.loss):
                best = trial
        return best

    def _pruned(self, best: Trial, nominal: Trial) -> Trial:
        """The trial without effects that no longer reduce the loss enough in the presence of the others."""
        for name in best.names[len(self.known) : -1]:
            fewer = self.judge(without(best.effects, name))
            if not self._pays(fewer, best, nominal):
                best = fewer
        return best

    def _exchanged(self, best: Trial) -> tuple[Trial, dict[str, list[str]]]:
        """Replace each effect by every other one; also returns those that explain the recording about as well."""
        indistinguishable = {}
        for name in best.names[len(self.known) :]:
            if name not in best.names:
                continue
            others = without(best.effects, name)
            before, screened = self._screened(others, f"{name} or ")
            judged = [
                self.judge(effects)
                for other, effects, loss in screened[:4]
                if other != name and loss < 0.5 * (before + best.loss)
            ]
            judged = sorted([*judged, best], key=lambda trial: trial.loss)
            if judged[0] is not best:
                gain, low, _ = self._gain(best, judged[0])
                if low > 0 and gain > 0.02 * best.loss:
                    best = judged[0]
            kept = best.names[-1] if name not in best.names else name
            indistinguishable[kept] = self._indistinguishable(best, [t for t in judged if t is not best], kept)
        return best, indistinguishable

    def _indistinguishable(self, best: Trial, judged: Sequence[Trial], effect: str | None = None) -> list[str]:
        """Effects that explain the recording about as well in place of ``effect``, by default the last one."""
        effect = effect or best.names[-1]
        found = []
        for trial in judged:
            other = next((name for name in trial.names if name not in best.names), None)
            if other is None:
                continue
            _, low, _ = self._gain(trial, best)
            if low <= 0 or separating_sensor(other, effect):
                found.append(other)
        return found

    def _starts(self, effect: Effect) -> list[Effects]:
        name = effect.name
        starts = first_values(effect)
        if name in self._own:
            known = {key: float(value) for key, value in dict(self._own[name]).items()}
            starts = [((name, {**known, **dict(values)}),) for ((_, values),) in starts]
            starts.append(((name, {key: known.get(key, value) for key, value in starts[0][0][1].items()}),))
        return starts


def _parameter_count(trial: Trial) -> int:
    """Parameters of the effect that was added last."""
    return len(CATALOGUE[trial.names[-1]].identified)
