"""Selection: which effects explain a recording.

Every effect is screened by a quick fit. Its influence on the residuals is then tested against the null distribution of
the strongest of all candidates on this very recording (:mod:`score_test`). Where one is significant, something is
missing, and the effect with the smallest held-out loss is added, by cross-validation over blocks. Effects are added one
at a time while a further one is significant in the presence of the others, whose values are fitted once more beside it;
then each is tested again, and may be dropped or replaced. Where single effects explain little, pairs are tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from monoforce_ros.discrepancy.areas import clusters
from monoforce_ros.discrepancy.fit import first_values, without
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.judging import Judging
from monoforce_ros.discrepancy.learned import LEARNED, learned_terms
from monoforce_ros.discrepancy.pairing import promising_pairs
from monoforce_ros.discrepancy.screening import Candidates, Screened, admitted
from monoforce_ros.discrepancy.trial import CandidateScore, FitTest, Outcome, Trial
from monoforce_ros.effects import CATALOGUE

_JUDGED = 6
"""Effects that are cross-validated in one round, those with the smallest screening loss first."""
_PROMISING = 0.5
"""Share of the best gain on held-out windows that an effect must promise on those of its quick fit to be judged. It
only saves time: effects that promise half as much hardly predict more."""
_JOINT_ITERATIONS = 2
"""Of the fits of effects beside a further one: two show how much it promises."""
_SMALL_SHARE = 0.5
"""Effects that explain less than this share of what an explanation must explain (``explained_share``) are neither
exchanged nor replaced by combinations with another beginning: it only saves time on what is unknown anyway."""
_PAIRS, _PAIR_ITERATIONS = 3, 4
"""Pairs of effects that are fitted where single ones explain little, those that promise most to first order, and
iterations of these fits, which begin at that promise."""
_ALTERNATIVES = 1
"""Combinations that do not begin with the best single effect and are tried where that one leads to no good fit."""


class Search(Judging):
    """A search over effects on one recording."""

    def run(self, most_effects: int, *, exchange: bool = True, missing: bool = False) -> Outcome:
        """Add effects while a further one is significant, then test each in the presence of the others.

        Args:
            most_effects: largest number.
            exchange: replace each of several effects by every other one at the end, and find those that are
                indistinguishable from it.
            missing: it is known that something is missing: the first effect is a choice between explanations.
        """
        measured = self.measured()
        nominal, start = measured.nominal, measured.best
        judged, tried = self._round(start, 1, self.thresholds.whole_rate, missing=missing)
        ratio = self.screening.candidates(self.known, len(self.known), "1: ").variance_ratio(self.directions)
        if not judged:
            return Outcome(nominal, start, self.fit_test(start, nominal), tuple(tried), ratio)
        best, listed = self._extended(self._preferred(judged), most_effects)
        tried += listed
        fit = self.fit_test(best, nominal)
        for other in [trial for trial in judged if trial.names[-1] not in best.names][:_ALTERNATIVES]:
            # The effect that explains most alone need not be part of the best combination.
            if fit.passed(self.thresholds) or most_effects < 2 or self._hopeless(fit):
                break
            extended, listed = self._extended(other, most_effects)
            tried += listed
            gain, low = self._gain(best, extended)
            if low > 0 and gain > self.thresholds.smallest_share * nominal.loss:
                best, fit = extended, self.fit_test(extended, nominal)
        if self._hopeless(fit) and most_effects > 1:
            pair = self._together(best)
            if pair is not None:
                best, listed = self._extended(pair, most_effects)
                tried, fit = [*tried, *listed], self.fit_test(best, nominal)
        hopeless = self._hopeless(fit)
        exchanged, indistinguishable = self._exchanged(best) if exchange and not hopeless else (best, {})
        if exchanged is not best:
            best, fit = exchanged, self.fit_test(exchanged, nominal)
        refined = self.refined(best)
        if refined is not best:
            best, fit = refined, self.fit_test(refined, nominal)
        return Outcome(nominal, best, fit, tuple(tried), ratio, indistinguishable)

    def part_p(self) -> float:
        """Smallest adjusted p-value of candidates that act always, from some time on or in some area, in addition to
        measured ones.

        An effect that acts in a part of a recording may be too weak over the whole. 1 for a robot that was never
        commissioned.
        """
        self._progress("testing for effects in parts of the recording")
        influences = self.screening.candidates(self.known, len(self.known), "1: ").influences
        if self.nominal is None or not influences:
            return 1.0
        parts = [*self.directions.late_parts(), *(area.inside for area in clusters(self.data))]
        directions = [*influences, *self.directions.within(influences, parts)]
        tests = self.screening.tested(self.known, len(self.known), self.directions.scaled(self.known), directions)
        return min(test.adjusted for test in tests)

    def grows_with_time(self, best: Trial) -> bool:
        """Whether an effect that grows with time is significant beside those of a trial."""
        base = self.refit(best.effects).effects if best.effects else ()
        fixed, residual = self.fixed_count(base), self.directions.scaled(base)
        entries = [first_values(effect, self.robot)[0][0] for effect in self.screening.growing(best.names)]
        directions = [self.directions.influence(base, entry) for entry in entries]
        tests = self.screening.tested(base, fixed, residual, directions) if directions else []
        return any(test.adjusted <= self.thresholds.further_rate for test in tests)

    def follows_heading(self, effects: Effects, acting: np.ndarray) -> bool:
        """Whether effects change with the heading, and that explains why they act in some windows ``[W]`` more.

        Where the robot turned once in a recording, its heading goes with time. Of two explanations of which neither
        adds to the other, that one counts which explains more; of a change with the heading, which has two
        coefficients, as much is no more than of one between two parts.
        """
        base = self.refit(effects).effects
        fixed, residual = self.fixed_count(base), self.directions.scaled(base)
        headings, part = self.directions.of_heading(base, fixed, acting)
        by_heading = self.screening.tested(base, fixed, residual, headings)
        if all(test.adjusted > self.thresholds.fit_rate for test in by_heading):
            return False
        by_part = self.screening.tested(base, fixed, residual, part)
        if max(test.gain for test in by_part) >= max(test.gain for test in by_heading):
            return False
        tests = self.screening.tested(base, fixed, residual, part, beside=headings)
        return all(test.adjusted > self.thresholds.effect_rate for test in tests)

    def measured(self) -> Outcome:
        """The effects that another sensor measured, unless the motion contradicts them."""
        nominal = start = self._without_effects
        if self.known:
            start = Trial(self.known, (self.known,) * self.fold_count, self.loss_of(self.known))
        return Outcome(nominal, start, FitTest(1.0, ""))

    def _extended(self, best: Trial, most_effects: int) -> tuple[Trial, list[CandidateScore]]:
        """Add effects one at a time while a further one is significant and no error of a formula.

        An effect's own further parameters come first: another effect must predict better than these do.
        """
        tried: list[CandidateScore] = []
        for number in range(2, most_effects + 1):
            further, listed = self._further(best, number)
            tried += listed
            if further is None:
                break
            refined = self.refined(best)
            if refined is not best and self._gain(refined, further)[1] <= 0.0:
                best = refined
                further, listed = self._further(best, number)
                tried += listed
                if further is None:
                    break
            best = further
        return best, tried

    def _further(self, best: Trial, number: int) -> tuple[Trial | None, list[CandidateScore]]:
        """The trial with a further effect in a round, None if there is no such effect, and the scores of all."""
        judged, listed = self._round(best, number, self.thresholds.further_rate)
        if not judged:
            return None, listed
        further = self._pruned(self._preferred(judged))
        # Where two effects show only together, the older one may go and leave a further one that explains little.
        worse = further.loss >= best.loss
        return None if worse or self._makes_up(best, further) else further, listed

    def _makes_up(self, best: Trial, further: Trial) -> bool:
        """Whether a further effect makes up for formulas that are not exact.

        Effects that are the explanation may leave residuals as small as a healthy robot's, judged as the nominal
        model's are. What is there beside them then explains most of what is left, as all must of the whole.
        """
        size = self._size(best, exact=True)
        if size is None or len(best.effects) == len(self.known):
            return False
        if best.loss - further.loss >= self.thresholds.explained_share * (best.loss - self.healthy_loss):
            return False
        small = 2.0 * size.p > self.thresholds.fit_rate
        return small and self.fit_test(best, self._without_effects).passed(self.thresholds)

    def _hopeless(self, fit: FitTest) -> bool:
        """Whether effects explain so little that improving them is of no use."""
        return fit.explained < _SMALL_SHARE * self.thresholds.explained_share

    def _together(self, best: Trial) -> Trial | None:
        """Two effects that explain together what neither does alone, if they predict better than ``best``."""
        self._progress("testing pairs of effects")
        fixed = len(self.known)
        found = self.screening.candidates(self.known, fixed, "1: ")
        entries = {entry.name: entry.effects[-1] for entry in found.screened}
        fits = []
        for pair in promising_pairs(self.directions.scaled(self.known), found.influences, _PAIRS):
            effects = self.known
            for index, coefficients in zip((pair.first, pair.second), pair.coefficients, strict=True):
                effects = (*effects, self._moved(entries[found.influences[index].name], coefficients))
            fits.append(self.screening.quick_fit(effects, fixed, _PAIR_ITERATIONS))
        if not fits:
            return None
        effects, _ = min(fits, key=lambda fit: fit[1])
        trial = self.judge(effects)
        gain, low = self._gain(best, trial)
        if low <= 0 or gain <= self.thresholds.smallest_share * self._without_effects.loss:
            return None
        for other in trial.effects[fixed:]:
            if not self._adds(self.judge((*trial.effects[:fixed], other)), trial):
                return None
        return trial if self.credible(trial, last=2) else None

    def _moved(self, entry: tuple[str, Mapping[str, float]], coefficients: np.ndarray) -> tuple[str, dict[str, float]]:
        """An effect whose values are multiples of those that it has, as distances from the nominal robot's."""
        name, values = entry
        bounds = {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
        moved, nominal = {}, self._without(name, values)
        for (key, value), own, coefficient in zip(values.items(), nominal, coefficients, strict=True):
            away = float(coefficient) * (value - own)
            # Limits are no multiples: without one there is no distance.
            moved[key] = float(np.clip(own + away, bounds[key].low, bounds[key].high)) if np.isfinite(away) else value
        return name, moved

    def learn(self, base: Effects = (), most: int = 3) -> Trial:
        """The sparse formula that best explains the residuals left by ``base``, with one to ``most`` terms.

        A further term must reduce the held-out loss beyond chance. Terms whose interval holds zero are left out, unless
        that predicts worse beyond chance.
        """
        start = self.refit(base).effects if base else self.known
        trials = []
        for number, effects in enumerate(learned_terms(start, self.directions.formula_terms(start), most)):
            self._progress(f"fitting a formula with {number + 1} terms")
            trials.append(self.judge(effects))
        best = trials[0]
        for trial in trials[1:]:
            if self._gain(best, trial)[1] > 0:
                best = trial
        fit = self.refit(best.effects)
        terms, measured = dict(fit.effects)[LEARNED], self.estimates(fit)[-1].parameters
        kept = {key: value for key, value in terms.items() if not measured[key].holds(0.0)}
        if not kept or len(kept) == len(terms):
            return best
        shorter = self.judge((*fit.effects[:-1], (LEARNED, kept)))
        return best if self._gain(shorter, best)[1] > 0 else shorter

    def _round(
        self, best: Trial, number: int, rate: float, *, missing: bool = False
    ) -> tuple[list[Trial], list[CandidateScore]]:
        """Trials with one more effect that is significant, smallest held-out loss first, and the scores of all."""
        base = self.refit(best.effects).effects if best.effects else ()
        # What effects leave is larger than a healthy robot's, for no formula is exact: that is expected of its size.
        size_p = self.size_p(best)
        incomplete = missing or (size_p is not None and size_p <= self.thresholds.fit_rate)
        found = self.screening.candidates(base, self.fixed_count(base), f"{number}: ", incomplete=incomplete)
        screened = self._beside(base, found, rate)
        entries = admitted(screened, found.before, rate, incomplete=incomplete)
        if not self.commissioned:
            # Nothing tells whether an effect explains enough: it must be significant by itself.
            entries = [entry for entry in entries if entry.test.p <= rate]
        judged: list[Trial] = []
        for entry in entries[:_JUDGED]:
            if judged and found.before - entry.loss < _PROMISING * (best.loss - min(trial.loss for trial in judged)):
                break
            self._progress(f"{number}: {entry.name}, judged")
            judged.append(self.judge(entry.effects))
        listed = []
        for entry in screened:
            trial = next((trial for trial in judged if trial.names[-1] == entry.name), None)
            gain = found.before - entry.loss if trial is None else self._gain(best, trial)[0]
            listed.append(
                CandidateScore(entry.name, number, float(gain), entry.test.adjusted, judged=trial is not None)
            )
        kept = [trial for trial in judged if self._adds(best, trial) and self.credible(trial, last=1)]
        if number > 1 and all(entry.test.adjusted > rate for entry in screened):
            # By its size something is missing, but no test says what: that must show in what it predicts.
            kept = [trial for trial in kept if self._gain(best, trial)[1] > 0.0]
        return sorted(kept, key=lambda trial: trial.loss), listed

    def _beside(self, base: Effects, found: Candidates, rate: float) -> Sequence[Screened]:
        """Screened candidates; beside those that are significant the effects of ``base`` are fitted once more.

        Without an effect that is missing the values of others make up for it, and with these it promises little.
        """
        fixed = self.fixed_count(base)
        if len(base) == fixed or all(entry.test.adjusted > rate for entry in found.screened):
            return found.screened
        screened = []
        for entry in found.screened:
            if entry.test.p <= rate:
                effects, loss = self.screening.quick_fit(entry.effects, fixed, _JOINT_ITERATIONS)
                entry = replace(entry, effects=effects, loss=loss)
            screened.append(entry)
        return sorted(screened, key=lambda entry: entry.loss)

    def _preferred(self, judged: list[Trial]) -> Trial:
        """The best trial, or one with fewer parameters that is as good.

        As good is what is not significantly worse, nor by more than the error of a formula.
        """
        top, least = judged[0], _parameter_count(judged[0])
        error = self.thresholds.model_error**2 * (self._without_effects.loss - top.loss)
        simpler = []
        for trial in judged[1:]:
            gain, low = self._gain(trial, top)
            if _parameter_count(trial) < least and low <= 0 and gain <= error:
                simpler.append(trial)
        return min(simpler, key=lambda trial: (_parameter_count(trial), trial.loss), default=top)

    def refined(self, best: Trial) -> Trial:
        """The trial with further parameters of its effects, such as a payload's height, that the recording shows."""
        for name in best.names[len(self.known) :]:
            known = {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
            for key in CATALOGUE[name].refined:
                base = self.refit(best.effects).effects
                values = dict(base)[name]
                if key in values:
                    continue
                changed = {**values, key: known[key].neutral + known[key].scale}
                more = tuple((other, changed if other == name else found) for other, found in base)
                residual = self.directions.scaled(base)
                change = np.nan_to_num(self.directions.scaled(more) - residual)
                direction = self.directions.direction(name, change[None])
                (test,) = self.screening.tested(base, self.fixed_count(base), residual, [direction])
                if test.p > self.thresholds.further_rate:
                    continue
                trial = self.judge(more)
                if self._pays(best, trial):
                    best = trial
        return best

    def _pruned(self, best: Trial) -> Trial:
        """The trial without effects that are no longer significant in the presence of the others."""
        for name in best.names[len(self.known) : -1]:
            fewer = self.judge(without(best.effects, name))
            base = self.refit(fewer.effects).effects
            residual = self.directions.scaled(base)
            effect = next(entry for entry in best.effects if entry[0] == name)
            influence = self.directions.influence(base, effect)
            (test,) = self.screening.tested(base, self.fixed_count(base), residual, [influence])
            needed = test.p <= self.thresholds.further_rate or self._gain(fewer, best)[1] > 0.0
            if not needed or not self._adds(fewer, best):
                best = fewer
        return best

    def _exchanged(self, best: Trial) -> tuple[Trial, dict[str, list[str]]]:
        """Replace each effect by every other one; also returns those that explain the recording about as well."""
        indistinguishable = {}
        for name in best.names[len(self.known) :]:
            if name not in best.names:
                continue
            base = tuple(entry for entry in self.refit(best.effects).effects if entry[0] != name)
            others = self.screening.candidates(base, self.fixed_count(base), f"{name} or ")
            reached = self.screening.quick_loss(self.refit(best.effects).effects)
            middle = 0.5 * (others.before + reached)
            near = [entry for entry in others.screened if entry.name != name and entry.loss < middle]
            judged = sorted([*(self.judge(entry.effects) for entry in near[:_JUDGED]), best], key=lambda t: t.loss)
            # An effect that is no measurement, whose value may as well be none, takes the place of no other.
            better = next((trial for trial in judged if trial is best or self.credible(trial, last=1)), best)
            if better is not best and self._gain(best, better)[1] > 0:
                best = better
            kept = best.names[-1] if name not in best.names else name
            instead = [trial for trial in judged if trial is not best]
            indistinguishable[kept] = self._indistinguishable(best, instead, kept)
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
            direction = self.directions.direction(effect, np.nan_to_num(chosen - residual)[None])
            (test,) = self.screening.tested(base, self.fixed_count(base), residual, [direction])
            # Both shift the motion against the commands: that they differ at all is how poses are interpolated.
            same = CATALOGUE[other].shifts and CATALOGUE[effect].shifts
            if test.p > self.thresholds.comparison_rate or same:
                found.append(other)
        return found


def _parameter_count(trial: Trial) -> int:
    """Parameters of the effect that was added last."""
    return len(CATALOGUE[trial.names[-1]].identified)
