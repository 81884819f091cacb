"""Selection: which effects explain a drive, judged on blocks of it that their fits did not see.

Every effect is screened by a quick fit; the most promising ones are fitted on every other block and judged on the
blocks left out. One more effect is added while it pays; then each is put to the test again beside the others, and may
be dropped or replaced.
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
"""Robust loss of residuals that are no larger than their scale: half the square of a standard deviation."""
SMALLEST_GAIN = 0.05
"""Of the loss at the start: what an effect must gain to be added."""
SMALLEST_STEP = 0.15
"""Loss that an effect must gain, whatever the share: three tenths of what a healthy robot leaves."""
_FOLDS = 2
BLOCK = 8.0
"""Length of the blocks that are left out together [s]: longer than a window."""
_ALPHA = 0.01
"""Chance of a gain by one effect where there is none; most of the guard against false alarms is what it must gain."""
_JUDGED = 5
_ALTERNATIVES = 2
_LATER_GAIN = 0.1
"""What a further effect must gain: of what is unexplained while that is much, else of what was to explain at all. A
small rest is the model's more often than the robot's."""


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted and judged."""

    effects: Effects
    """By the fit to the part of the drive that explains the rest best."""
    parts: tuple[Effects, ...]
    """Fits with each fold left out."""
    held_out_loss: np.ndarray
    """Loss of each window by the fit that did not see it, ``[W]``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(name for name, _ in self.effects)

    @property
    def loss(self) -> float:
        """Mean over windows."""
        return float(self.held_out_loss.mean())


@dataclass(frozen=True)
class Outcome:
    """What a search found."""

    nominal: Trial
    best: Trial
    """The nominal one where nothing was found."""
    tried: tuple[dict, ...]
    """``name``, ``round``, ``gain``, ``p`` of every effect."""
    rivals: dict[str, list[str]]
    """By found effect: others that explain the drive about as well in its place."""


def folds_of(starts: np.ndarray) -> np.ndarray:
    """Which fold each window belongs to: alternating blocks."""
    return ((starts - starts[0]) // round(BLOCK * 1e9)).astype(int) % _FOLDS


def blocks_of(starts: np.ndarray) -> np.ndarray:
    """Number of the half block in which each window starts."""
    return ((starts - starts[0]) // round(0.5 * BLOCK * 1e9)).astype(int)


def paired(before: np.ndarray, after: np.ndarray, starts: np.ndarray, seed: int = 0) -> tuple[float, float, float]:
    """Mean gain, its lower bound of 95 %, and the chance of such gains of whole blocks by Wilcoxon's test."""
    blocks = blocks_of(starts)
    numbers = np.unique(blocks)
    # A few windows that nothing explains shall not decide.
    difference = np.clip(before - after, -50.0, 50.0)
    sums = np.array([difference[blocks == block].sum() for block in numbers]) / len(starts)
    gain = float(sums.sum())
    picked = np.random.default_rng(seed).integers(0, len(sums), (2000, len(sums)))
    # By ranks: a few blocks that gain much and others that gain little are a gain in all of them.
    chance = float(wilcoxon(sums, alternative="greater").pvalue) if np.abs(sums).max() > 1e-12 else 1.0
    return gain, float(np.quantile(sums[picked].sum(axis=1), 0.05)), chance


class Search:
    """A search over effects on one drive.

    Args:
        robot: with the effects of its file.
        data: the drive.
        scale: size of a residual that means nothing, ``[K, 3]``.
        known: effects that another sensor has measured: they act throughout and keep their values.
        excluded: effects that another sensor rules out.
        progress: called with what is done next.
    """

    def __init__(
        self,
        robot: RobotModel,
        data: EvidenceWindows,
        scale: np.ndarray,
        *,
        known: Effects = (),
        excluded: Sequence[str] = (),
        progress: Callable[[str], None] = lambda what: None,
    ):
        self.robot, self.data, self.scale = robot, data, scale
        self.known = known
        self.predictions = Predictions(robot, data)
        self._progress = progress
        starts = data.starts
        self._coarse = Predictions(robot, replace(data, starts=starts[::2]))
        folds = folds_of(starts)
        # A window that reaches into the next block shares motion with windows that judge the fit.
        ends = folds_of(np.r_[starts[0], starts + round(data.horizon * 1e9)])[1:]
        self._split = []
        for left in range(_FOLDS):
            seen = (folds != left) & (ends != left)
            if seen.sum() < 4:
                seen = folds != left
            self._split.append(
                (
                    Predictions(robot, replace(data, starts=starts[seen])),
                    Predictions(robot, replace(data, starts=starts[folds == left])),
                    folds == left,
                )
            )
        self._own = dict(robot.effects)
        # An offset that the file holds was undone; a second one of its kind would add to it.
        self._taken = {name for name in self._own if CATALOGUE[name].stage == "measurement"} | set(excluded)

    def run(self, most_effects: int) -> Outcome:
        """Add effects while they pay, then test each beside the others."""
        nominal = Trial((), ((),) * _FOLDS, self.loss_of(()))
        start = nominal
        if self.known:
            start = Trial(self.known, (self.known,) * _FOLDS, self.loss_of(self.known))
            if start.loss > nominal.loss + SMALLEST_STEP:
                # The motion contradicts the other sensor.
                self.known, start = (), nominal
        judged, tried = self._round(start, 1)
        found = self._preferred(judged, start) if judged else None
        if found is None or not self._pays(start, found, nominal):
            return Outcome(nominal, start, tuple(tried), {})
        rivals = {found.names[-1]: self._rivals(found, judged)}
        best, listed = self._extended(found, nominal, most_effects)
        tried += listed
        others = [trial for trial in judged if trial is not found and self._pays(start, trial, nominal)]
        for other in others[:_ALTERNATIVES]:
            # What explains most alone need not be among those that explain most together.
            if best.loss < 3 * HEALTHY_LOSS or most_effects < 2:
                break
            extended, listed = self._extended(other, nominal, most_effects)
            tried += listed
            gain, low, _ = self._gain(best, extended)
            if low > 0 and gain > _LATER_GAIN * (nominal.loss - HEALTHY_LOSS):
                best = extended
        if len(best.effects) > 1 + len(self.known):
            best, rivals = self._exchanged(best)
        return Outcome(nominal, best, tuple(tried), rivals)

    def _extended(self, best: Trial, nominal: Trial, most_effects: int) -> tuple[Trial, list[dict]]:
        """One more effect while it pays."""
        tried: list[dict] = []
        for step in range(1, most_effects):
            if best.loss < HEALTHY_LOSS:
                # A healthy robot leaves as much.
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
        """The sparse sum of features that explains best what ``base`` leaves, of as few terms as do about as well."""
        best: Trial | None = None
        for number, effects in enumerate(learned_terms(self.predictions, base or self.known, self.scale, most)):
            self._progress(f"a formula of {number + 1}")
            trial = self.judge(effects)
            if best is None or trial.loss < 0.9 * best.loss:
                best = trial
        return best

    def drifting(self, trial: Trial, pieces: int = 3) -> tuple[float, list[Effects]]:
        """What fitting each third of the drive on its own would still gain, and these fits."""
        starts = self.data.starts
        gain, fits = 0.0, []
        for part in np.array_split(np.arange(len(starts)), pieces):
            predictions = Predictions(self.robot, replace(self.data, starts=starts[part]))
            held = self._held(trial.effects)
            fit = fit_effects(predictions, [trial.effects], self.scale, iterations=4, free=held)
            gain += float(trial.held_out_loss[part].sum() - fit.loss.sum()) / len(starts)
            fits.append(fit.effects)
        return gain, fits

    def loss_of(self, effects: Effects) -> np.ndarray:
        """Robust loss of each window, ``[W]``."""
        return robust(self.predictions.residuals([effects])[0] / self.scale)

    def judge(self, effects: Effects, iterations: int = 4) -> Trial:
        """Fit on every fold's complement and judge on the fold."""
        held_out_loss = np.zeros(len(self.data.starts))
        parts, losses = [], []
        for seen, other, where in self._split:
            fit = fit_effects(seen, [effects], self.scale, iterations=iterations, free=self._held(effects))
            held_out_loss[where] = robust(other.residuals([fit.effects])[0] / self.scale)
            parts.append(fit.effects)
            losses.append(float(fit.loss.mean()) + float(held_out_loss[where].mean()))
        return Trial(parts[int(np.argmin(losses))], tuple(parts), held_out_loss)

    def refit(self, effects: Effects) -> Fit:
        """Fit to the whole drive."""
        return fit_effects(self.predictions, [effects], self.scale, iterations=6, free=self._held(effects))

    def ranked(self, fit: Fit) -> list[int]:
        """Indices of a fit's effects, that first which the others, fitted anew without it, replace least."""
        if len(fit.effects) < 2:
            return list(range(len(fit.effects)))
        losses = []
        for i in range(len(fit.effects)):
            others = fit.effects[:i] + fit.effects[i + 1 :]
            alone = fit_effects(self._coarse, [others], self.scale, iterations=4, free=self._held(others))
            losses.append(float(alone.loss.mean()))
        return sorted(range(len(losses)), key=lambda i: -losses[i])

    def _held(self, effects: Effects) -> int:
        return len(self.known) if effects[: len(self.known)] == self.known else 0

    def _screened(self, base: Effects, number: str) -> tuple[float, list[tuple[str, Effects, float]]]:
        """Loss of ``base``, and every effect with a quick fit to every other window beside it, best first."""
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

    def _round(self, best: Trial, number: int) -> tuple[list[Trial], list[dict]]:
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
            own = next((trial for trial in judged if trial.names[-1] == name), None)
            gain, _, chance = (before - loss, 0, 1.0) if own is None else self._gain(best, own)
            listed.append(
                {"name": name, "round": number, "gain": float(gain), "p": float(chance), "judged": own is not None}
            )
        return sorted(judged, key=lambda trial: trial.loss), listed

    def _gain(self, before: Trial, after: Trial) -> tuple[float, float, float]:
        return paired(before.held_out_loss, after.held_out_loss, self.data.starts)

    def _pays(self, before: Trial, after: Trial, nominal: Trial) -> bool:
        gain, low, chance = self._gain(before, after)
        # Where most of the disagreement goes, a dozen blocks need not agree by rank to one in a hundred.
        large = gain > 0.4 * (nominal.loss - HEALTHY_LOSS) and chance < 5 * _ALPHA
        significant = (chance < _ALPHA or large) and low > 0
        least = max(SMALLEST_GAIN * before.loss, SMALLEST_STEP)
        if len(after.effects) > 1 + len(self.known):
            unexplained = before.loss > 3 * HEALTHY_LOSS
            least = max(least, _LATER_GAIN * ((before if unexplained else nominal).loss - HEALTHY_LOSS))
        return significant and gain > least

    def _preferred(self, judged: list[Trial], before: Trial) -> Trial:
        """The best trial, or one as good that asks for fewer parameters."""
        best = judged[0]
        for trial in judged[1:]:
            margin, low, _ = self._gain(trial, best)
            simpler = _parameter_count(trial) < _parameter_count(best)
            if simpler and (low <= 0 or margin < 0.02 * before.loss):
                best = trial
        return best

    def _pruned(self, best: Trial, nominal: Trial) -> Trial:
        """Without effects that no longer pay beside the others."""
        for name in best.names[len(self.known) : -1]:
            fewer = self.judge(without(best.effects, name))
            if not self._pays(fewer, best, nominal):
                best = fewer
        return best

    def _exchanged(self, best: Trial) -> tuple[Trial, dict[str, list[str]]]:
        """Each effect against all others in its place, and those that explain the drive as well there."""
        rivals = {}
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
            own = best.names[-1] if name not in best.names else name
            rivals[own] = self._rivals(best, [t for t in judged if t is not best], own)
        return best, rivals

    def _rivals(self, best: Trial, judged: Sequence[Trial], own: str | None = None) -> list[str]:
        """Effects that explain the drive about as well."""
        own = own or best.names[-1]
        rivals = []
        for trial in judged:
            other = next((name for name in trial.names if name not in best.names), None)
            if other is None:
                continue
            _, low, _ = self._gain(trial, best)
            if low <= 0 or separating_sensor(other, own):
                rivals.append(other)
        return rivals

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
