"""Verdict: the conclusion of a diagnosis, and the rules by which it is reached."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.learned import LEARNED, formula
from monoforce_ros.discrepancy.selection import HEALTHY_LOSS, SMALLEST_GAIN, Outcome, Search, Trial, paired
from monoforce_ros.effects import CATALOGUE, FEATURE_SIZES, FEATURES

SMALLEST_SHARE = 0.6
"""Share of the excess loss that effects must explain to be the missing ones."""
LARGEST_DRIFT = 0.12
"""Share of the excess loss that values which change over the recording may explain; beyond it no single value fits."""
_CLEARLY = 3.0 * HEALTHY_LOSS
"""Loss above which the model lacks an effect, known or not."""
_WELL = 2.0 * HEALTHY_LOSS
"""Loss up to which an effect fits well enough to keep its name."""


class Verdict(StrEnum):
    """The conclusion of a diagnosis."""

    EFFECT_FOUND = "effect_found"
    NO_DISCREPANCY = "no_discrepancy"
    UNKNOWN_EFFECT = "unknown_effect"
    NOT_IDENTIFIABLE = "not_identifiable"
    NO_IMPROVEMENT = "no_improvement"


@dataclass(frozen=True)
class Losses:
    """Mean robust losses by which a verdict was reached; None where they were not needed."""

    before: float
    """Of the nominal model."""
    after: float
    """Held-out loss of the best effects of the catalogue."""
    healthy: float | None = None
    """Of a healthy robot, whose residuals are as large as their scale."""
    share_explained: float | None = None
    """Share of the excess loss, that above a healthy robot's, which the effects explain."""
    by_formula: float | None = None
    """Held-out loss of the best formula."""
    share_by_drift: float | None = None
    """Share of the excess loss explained by values that change over the recording."""


@dataclass(frozen=True)
class Decision:
    """A verdict and the effects that go with it, before they are confirmed on windows of every horizon."""

    verdict: Verdict
    trial: Trial | None
    """Effects to add to the model, including a formula; None if there are none."""
    remarks: tuple[str, ...]
    """The reasons."""
    losses: Losses
    measured: Trial | None = None
    """What a gyro or wheel speeds measured: kept where a formula in addition to it is rejected."""

    def without_improvement(self) -> Decision:
        """The decision after held-out windows did not improve: an effect is not added, nor is a formula."""
        if self.verdict == Verdict.EFFECT_FOUND:
            remarks = (*self.remarks, "errors on held-out windows do not decrease beyond chance")
            return replace(self, verdict=Verdict.NO_IMPROVEMENT, trial=None, remarks=remarks)
        if self.verdict == Verdict.UNKNOWN_EFFECT and self.trial is not self.measured:
            remarks = (*self.remarks, "the formula is not added: held-out errors do not decrease beyond chance")
            return replace(self, trial=self.measured, remarks=remarks)
        return self


def decide(search: Search, outcome: Outcome) -> Decision:
    """The verdict by the losses of a search, which is continued with a formula where no effect fits."""
    nominal, best = outcome.nominal, outcome.best
    excess = nominal.loss - HEALTHY_LOSS
    share = (nominal.loss - best.loss) / max(excess, 1e-6)
    only_measured = search.known and best.names == tuple(name for name, _ in search.known)
    if only_measured and nominal.loss > best.loss and (best.loss < _CLEARLY or share > SMALLEST_SHARE):
        # A measurement by the gyro or the wheels is accepted even if it explains only a part.
        remarks = ("measured by the gyro or the wheel speeds, independent of the ground",)
        losses = Losses(nominal.loss, best.loss, share_explained=share)
        return Decision(Verdict.EFFECT_FOUND, best, remarks, losses)
    losses = Losses(nominal.loss, best.loss, HEALTHY_LOSS)
    if not best.effects and nominal.loss < _CLEARLY:
        remarks = ("the error is no larger than noise and the residual of a healthy robot",)
        return Decision(Verdict.NO_DISCREPANCY, None, remarks, losses)
    explained = f"{' and '.join(best.names)} explain{'s' if len(best.names) == 1 else ''}"
    if best.effects:
        losses = replace(losses, share_explained=share)
    found = Decision(
        Verdict.EFFECT_FOUND, best, (f"{explained} {100 * min(share, 1.0):.0f} % of the excess loss",), losses
    )
    if best.effects and best.loss < 1.2 * HEALTHY_LOSS:
        return found
    formula_trial = search.learn()
    losses = replace(losses, by_formula=formula_trial.loss)
    if not best.effects:
        gain, low, _ = paired(nominal.held_out_loss, formula_trial.held_out_loss, search.data.starts)
        if low > 0 and gain > SMALLEST_GAIN * nominal.loss:
            return _unknown(formula_trial, nominal, "no known effect explains the error", losses)
        if nominal.loss < 1.7 * _CLEARLY:
            remarks = ("no effect reduces the error on held-out windows",)
            return Decision(Verdict.NO_IMPROVEMENT, None, remarks, losses)
        reason = "the error is far larger than the noise, and no known effect explains it"
        return _unknown(formula_trial, nominal, reason, losses)
    reason = ""
    # A formula has more freedom than an effect: one that fits well keeps its name even if a formula is better.
    better, low, _ = paired(best.held_out_loss, formula_trial.held_out_loss, search.data.starts)
    if low > 0 and better > 0.1 * excess and best.loss > _WELL and not _same(best, formula_trial, nominal):
        reason = f"a formula predicts held-out windows better than {' and '.join(best.names)}"
    elif best.loss > _CLEARLY:
        drift, thirds = search.drifting(best)
        losses = replace(losses, share_by_drift=drift / excess)
        # A formula that repeats the effect with one value for the whole recording contradicts a drift.
        if drift > (2.0 if _same(best, formula_trial, nominal) else 1.0) * LARGEST_DRIFT * excess:
            reason = f"{_drift_of(thirds, len(search.known))} over the recording: no single value fits"
        elif share < SMALLEST_SHARE and not search.known and not _same(best, formula_trial, nominal):
            # Measurements by the gyro and the wheels are valid for any explained share.
            reason = f"{explained} only {100 * share:.0f} % of the excess loss"
    if reason:
        # Measurements by the gyro and the wheels remain known.
        measured = best if search.known and best.effects[: len(search.known)] == search.known else None
        return _unknown(formula_trial, nominal, reason, losses, measured)
    return replace(found, losses=losses)


def _same(best: Trial, formula_trial: Trial, nominal: Trial) -> bool:
    """Whether a formula is an effect of the catalogue with a small remainder.

    Its largest term is then the force by which that effect acts, and the effect explains most of what the formula does.
    """
    terms = dict(formula_trial.effects).get(LEARNED)
    if not terms:
        return False
    feature_sizes = dict(zip(FEATURES, FEATURE_SIZES, strict=True))
    largest = max(terms, key=lambda key: abs(terms[key]) * feature_sizes[key.split(":")[1]])
    if not any(largest in CATALOGUE[name].formula_terms for name in best.names):
        return False
    return nominal.loss - best.loss > SMALLEST_SHARE * (nominal.loss - formula_trial.loss)


def _unknown(trial: Trial, nominal: Trial, reason: str, losses: Losses, measured: Trial | None = None) -> Decision:
    """The verdict with the formula, or else with what other sensors measured."""
    share = 1 - trial.loss / nominal.loss
    if share < SMALLEST_GAIN or (measured is not None and trial.loss > measured.loss):
        remarks = (reason, "no formula of the motion explains it either")
        return Decision(Verdict.UNKNOWN_EFFECT, measured, remarks, losses, measured)
    found = formula(dict(trial.effects)[LEARNED])
    remarks = (reason, f"the formula {found} [N, N m] reduces the held-out loss by {100 * share:.0f} %")
    return Decision(Verdict.UNKNOWN_EFFECT, trial, remarks, losses, measured)


def _drift_of(thirds: list[Effects], known: int) -> str:
    """How the first effect that is not measured changes over the thirds of a recording."""
    name, first = thirds[0][known]
    key = next(iter(first))
    values = [dict(effects)[name][key] for effects in thirds]
    return f"{key} of {name} would change ({', '.join(f'{value:.3g}' for value in values)})"
