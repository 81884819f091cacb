"""Conclusion: a decision that held-out windows and searches without parts of the recording confirm, or do not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.comparison import (
    Comparison,
    GapRow,
    HeldOut,
    compare,
    gap_table,
    gets_worse,
    improves,
)
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Explanation
from monoforce_ros.discrepancy.flippers import BLOCKED
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.repetition import Repetition
from monoforce_ros.discrepancy.sensor_findings import SensorFindings, bias_row, changed_bias, heading_noise
from monoforce_ros.discrepancy.verdict import Decision, Verdict
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Judge:
    """Compares windows of every horizon with what effects predict of them."""

    evidence: Evidence
    robot: RobotModel
    explanation: Explanation
    left_out: LeftOut
    """Stretches that cannot be compared."""
    noisy: Sequence[MotionTrack]
    """The motion with other noise."""
    seed: int
    by_gyro: Mapping[float, float]
    """By how much poses and gyro turn apart, by horizon [deg]."""

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        robot: RobotModel,
        explanation: Explanation,
        left_out: LeftOut,
        noisy: Sequence[MotionTrack],
        settings: DiagnosisSettings,
    ) -> Judge:
        """The judge of an explanation of a recording."""
        return cls(
            evidence,
            robot,
            explanation,
            left_out,
            noisy,
            settings.seed,
            heading_noise(evidence, explanation.sensors.gyro),
        )

    def held_out(self, decision: Decision) -> HeldOut | None:
        """The effects of a decision, each fold with the values fitted without it; None where it adds none."""
        first = int(self.explanation.windows.data.starts[0])
        return None if decision.trial is None else HeldOut(decision.trial.parts, first)

    def compared(self, judged: HeldOut | None) -> tuple[Comparison, ...]:
        """Windows by horizon, before and after held-out effects."""
        data, part = self.explanation.windows.data, self.explanation.part
        acting = None if part is None else part.acting_in
        return tuple(compare(self.robot, data, self.evidence, self.left_out, judged, self.noisy, acting))

    def table(self, compared: Sequence[Comparison]) -> dict[str, GapRow]:
        """Errors by metric, before and after."""
        return gap_table(compared, self.seed, self.by_gyro)


@dataclass(frozen=True)
class Conclusion:
    """A decision, and the errors on held-out windows that go with it."""

    decision: Decision
    judged: HeldOut | None
    """The effects with which windows were predicted; None where nothing is added."""
    compared: tuple[Comparison, ...]
    gap: Mapping[str, GapRow]
    repetition: Repetition | None = None
    """The search without parts of the recording; None where nothing was found, or too little was recorded."""
    not_found_again: bool = False
    """Whether effects explain the whole recording, and searches without a part of it do not find them."""


def conclude(explanation: Explanation, judge: Judge, repeated: Callable[[], Repetition | None]) -> Conclusion:
    """What stays of a decision: on the folds of its own search, on those of its repetitions, and with their effects.

    Args:
        explanation: with the decision of the search.
        judge: compares windows of this explanation.
        repeated: repeats the search without parts of the recording.
    """
    first = _on_folds(explanation, judge)
    if first.decision.trial is None:
        return first
    repetition = repeated()
    if repetition is None:
        return first
    decision = repetition.confirmed(explanation, first.decision, explanation.search.thresholds)
    judged = None if decision.trial is None else repetition.held_out
    compared = judge.compared(judged)
    lost = (
        first.decision.verdict == Verdict.EFFECT_FOUND
        and decision.verdict == Verdict.UNKNOWN_EFFECT
        and decision.trial is None
    )
    confirmed = Conclusion(decision, judged, compared, judge.table(compared), repetition, lost)
    return _where_it_improves(confirmed, explanation, judge)


def _on_folds(explanation: Explanation, judge: Judge) -> Conclusion:
    """The decision on the folds on which its effects were selected: these say whether they help, not how much."""
    decision = explanation.decision
    judged = judge.held_out(decision)
    compared = judge.compared(judged)
    gap = judge.table(compared)
    if judged is None or improves(gap):
        return Conclusion(decision, judged, compared, gap)
    decision = decision.without_improvement(dispensable=explanation.dispensable)
    judged = judge.held_out(decision)
    compared = _without_effects(compared) if judged is None else judge.compared(judged)
    return Conclusion(decision, judged, compared, judge.table(compared))


def _where_it_improves(conclusion: Conclusion, explanation: Explanation, judge: Judge) -> Conclusion:
    """The conclusion, without its effects where windows that no search saw contradict them, or nothing helps."""
    gap = conclusion.gap
    if conclusion.judged is None or improves(gap):
        return conclusion
    errors = "increase" if gets_worse(gap) else "do not decrease"
    decision = conclusion.decision.without_improvement(errors, dispensable=explanation.dispensable)
    compared = _without_effects(conclusion.compared)
    return replace(conclusion, decision=decision, judged=None, compared=compared, gap=judge.table(compared))


def _without_effects(compared: Sequence[Comparison]) -> tuple[Comparison, ...]:
    """The same windows, where nothing is added."""
    return tuple(replace(entry, after=None) for entry in compared)


@dataclass(frozen=True)
class Measured:
    """What gyro and joints measured whatever the motion shows, and the verdict with it."""

    verdict: Verdict
    effects: tuple[EffectEstimate, ...]
    gap: Mapping[str, GapRow]
    remarks: tuple[str, ...] = ()
    motion_unexplained: bool = False
    """Whether, besides what was measured, the motion is not as predicted, and no effect improves it."""

    @classmethod
    def beside(
        cls,
        verdict: Verdict,
        effects: tuple[EffectEstimate, ...],
        gap: Mapping[str, GapRow],
        sensors: SensorFindings,
        robot: RobotModel,
    ) -> Measured:
        """Add a gyro's bias and a blocked flipper to what the motion shows; neither needs it."""
        remarks: tuple[str, ...] = ()
        unexplained = False
        gyro, bias = sensors.gyro, changed_bias(sensors.gyro, robot)
        if gyro is not None and bias is not None and verdict in (Verdict.NO_DISCREPANCY, Verdict.EFFECT_FOUND):
            effects, gap = (*effects, bias), {**gap, "yaw_rate_gyro": bias_row(gyro)}
            remarks = ("the gyro measures a rotation that the poses do not show",)
            verdict = Verdict.EFFECT_FOUND
        flippers = sensors.flippers
        if flippers is not None:
            remarks = (*remarks, flippers.summary())
            if verdict in (Verdict.NO_DISCREPANCY, Verdict.NO_IMPROVEMENT, Verdict.EFFECT_FOUND):
                others = tuple(effect for effect in effects if effect.name != BLOCKED)
                effects, gap = (*others, flippers.estimate), {**gap, "flippers": flippers.row}
                unexplained = verdict == Verdict.NO_IMPROVEMENT
                verdict = Verdict.EFFECT_FOUND
        return cls(verdict, effects, gap, remarks, unexplained)
