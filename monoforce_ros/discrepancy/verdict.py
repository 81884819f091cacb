"""Verdict: the conclusion of a diagnosis as a function of typed findings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.learned import LEARNED, formula
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import FitTest, Trial, excess_share


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
    """Of the healthy robot."""
    share_explained: float | None = None
    """Share of the excess loss, that above what a healthy robot may well have, which the effects explain."""
    by_formula: float | None = None
    """Held-out loss of the best formula."""
    p_rest: float | None = None
    """p-value of the test that what is left looks like the healthy robot."""
    variance_ratio: float | None = None
    """Variance of the effects' influence beyond that within the recording, as a share of that between segments of
    commissioning recordings."""


@dataclass(frozen=True)
class Findings:
    """What a search found on a recording."""

    nominal: Trial
    best: Trial
    """The nominal trial where no effect was added."""
    fit: FitTest
    """Of what the best trial leaves."""
    healthy_loss: float
    """Mean loss of the healthy robot."""
    commissioned: bool
    """Whether the healthy robot's residuals are known, with which those that are left can be compared."""
    known: Effects = ()
    """Effects measured by the gyro or the wheel speeds, which act in all trials."""
    formula: Trial | None = None
    """Formula in addition to the best trial; None where none was needed."""
    formula_gain: tuple[float, float] = (0.0, 0.0)
    """Reduction of the held-out loss by the formula, and its lower bound."""


@dataclass(frozen=True)
class Decision:
    """A verdict and the effects that go with it, before they are confirmed on windows of every horizon."""

    verdict: Verdict
    trial: Trial | None
    """Effects to add to the model, including a formula; None if there are none."""
    remarks: tuple[str, ...]
    """The reasons."""
    losses: Losses
    parts: Trial | None = None
    """Known effects that explain a part of an ``unknown_effect``."""

    def without_improvement(self, errors: str = "do not decrease", *, dispensable: bool = False) -> Decision:
        """The decision after held-out windows did not improve: an effect is not added, nor is a formula.

        Args:
            errors: what the errors do, beyond chance.
            dispensable: whether the recording looks like the healthy robot's without the effects, too. Then all that
                speaks for these is a test that healthy robots fail at its stated rate.
        """
        if self.verdict == Verdict.EFFECT_FOUND:
            if dispensable:
                names = "" if self.trial is None else f" with {' and '.join(self.trial.names)}"
                found = f"the errors are no larger than a healthy robot's; on held-out windows they {errors}{names}"
                return replace(self, verdict=Verdict.NO_DISCREPANCY, trial=None, remarks=(f"{found} beyond chance",))
            remarks = (*self.remarks, f"errors on held-out windows {errors} beyond chance")
            return replace(self, verdict=Verdict.NO_IMPROVEMENT, trial=None, remarks=remarks)
        if self.verdict == Verdict.UNKNOWN_EFFECT and self.trial is not None:
            remarks = (*self.remarks, f"the formula is not added: held-out errors {errors} beyond chance")
            return replace(self, trial=None, remarks=remarks)
        return self


def fits(findings: Findings, thresholds: Thresholds) -> bool:
    """Whether what the best effects leave looks like the healthy robot.

    Of a robot that was never commissioned nobody knows how large its errors should be. Its effects keep their names
    unless a formula in addition to them explains most of what they leave: large errors, as of a robot that spins, hide
    what is missing from a test. Where the test does find more, they must also explain most of the loss.
    """
    passed = findings.fit.passed(thresholds)
    if findings.commissioned or not findings.best.effects:
        return passed
    return not _contradicted(findings, thresholds) and (passed or not leaves_most(findings, thresholds))


def _contradicted(findings: Findings, thresholds: Thresholds) -> bool:
    """Whether a formula in addition to the best effects explains most of what they leave."""
    if findings.formula is None or findings.formula_gain[1] <= 0:
        return False
    return findings.formula.loss <= (1.0 - thresholds.most_share) * findings.best.loss


def leaves_most(findings: Findings, thresholds: Thresholds) -> bool:
    """Whether the best effects leave most of the nominal model's loss."""
    return findings.best.loss > (1.0 - thresholds.most_share) * findings.nominal.loss


def decide(findings: Findings, thresholds: Thresholds = Thresholds()) -> Decision:  # noqa: B008
    """The verdict on a recording."""
    nominal, best = findings.nominal, findings.best
    share = None
    if best.effects:
        share = findings.fit.explained
        if not findings.commissioned:
            share = excess_share(nominal.loss, best.loss, findings.healthy_loss)
    losses = Losses(nominal.loss, best.loss, findings.healthy_loss, share, p_rest=findings.fit.p)
    if fits(findings, thresholds):
        if not best.effects:
            none = ("the error is no larger than noise and the residual of a healthy robot",)
            return Decision(Verdict.NO_DISCREPANCY, None, none, losses)
        remarks: tuple[str, ...] = (f"{_explains(best)} {100 * (share or 0.0):.0f} % of the excess loss",)
        if not findings.commissioned:
            remarks += (
                "the robot was never commissioned: whether the rest is normal cannot be told (diagnose --commission)",
            )
        return Decision(Verdict.EFFECT_FOUND, best, remarks, losses)
    reason = f"more than {100 * (1.0 - thresholds.explained_share):.0f} % of the excess is left"
    if not findings.commissioned:
        reason = "a formula explains most of what is left"
    if findings.fit.p <= thresholds.fit_rate:
        reason = f"what is left does not look like the healthy robot: {findings.fit.strongest}"
    remarks = (reason,)
    parts = best if best.effects else None
    if parts is not None:
        remarks = (f"{_explains(best)} only {100 * (share or 0.0):.0f} % of the excess loss", reason)
    trial = None
    if findings.formula is not None:
        gain, low = findings.formula_gain
        losses = replace(losses, by_formula=findings.formula.loss)
        if low > 0 and gain > thresholds.smallest_share * nominal.loss:
            trial = findings.formula
            terms = formula(dict(trial.effects)[LEARNED])
            remarks += (f"the formula {terms} [N, N m] reduces the held-out loss by {100 * gain / nominal.loss:.0f} %",)
        else:
            remarks += ("no formula of the motion predicts held-out windows",)
    return Decision(Verdict.UNKNOWN_EFFECT, trial, remarks, losses, parts)


def _explains(trial: Trial) -> str:
    return f"{' and '.join(trial.names)} explain{'s' if len(trial.names) == 1 else ''}"
