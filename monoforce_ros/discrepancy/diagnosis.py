"""Diagnosis: whether a robot's model lacks an effect, which one, and how much of the error it explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from monoforce_ros.discrepancy.areas import Area, worst_place
from monoforce_ros.discrepancy.attitude import changed_lean, lean_of
from monoforce_ros.discrepancy.comparable_windows import comparable_windows, windows_of
from monoforce_ros.discrepancy.comparison import (
    ABOVE_NOISE,
    Comparison,
    GapRow,
    HeldOut,
    PathComparison,
    RegimeRow,
    measured_paths,
    regime_table,
)
from monoforce_ros.discrepancy.conclusion import Judge, Measured, conclude
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.cycle_start import explain_aligned
from monoforce_ros.discrepancy.estimates import EffectEstimate, beyond_file
from monoforce_ros.discrepancy.evidence import MOTION, Evidence, EvidenceWindows
from monoforce_ros.discrepancy.explanation import DiagnosisSettings
from monoforce_ros.discrepancy.fit import Fit
from monoforce_ros.discrepancy.gap import (
    Localisation,
    NoiseFloor,
    find_regimes,
    localise,
    noisy_motions,
)
from monoforce_ros.discrepancy.hypothesis import Effects, corrected_evidence
from monoforce_ros.discrepancy.kinematic_baseline import StepComparison
from monoforce_ros.discrepancy.learned import LEARNED
from monoforce_ros.discrepancy.motion_check import motion_faults
from monoforce_ros.discrepancy.motor_efforts import changed_efforts
from monoforce_ros.discrepancy.nominal import NominalModel, with_known_components
from monoforce_ros.discrepancy.preflight import advice, complaints
from monoforce_ros.discrepancy.region import Region
from monoforce_ros.discrepancy.repetition import prepare_processes, repeat
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.sensor_findings import SensorFindings
from monoforce_ros.discrepancy.trial import CandidateScore, Outcome
from monoforce_ros.discrepancy.verdict import Decision, Losses, Verdict
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Details:
    """Arrays for figures."""

    data: EvidenceWindows
    before: np.ndarray
    """Residuals of the nominal model, ``[W, K, C]``."""
    floor: np.ndarray
    """Residuals by noise and map, ``[K, C]``."""
    compared: tuple[Comparison, ...]
    paths: tuple[PathComparison, ...]
    area: Area | None = None
    """Where the effects act, if only there; of an unknown effect where errors are largest at every visit."""
    area_meaning: str = "acts here"
    """Of ``area``, in a legend."""
    stretches: tuple[slice, ...] = ()
    """Parts of the motion without gaps; empty: all of it is one."""


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis."""

    verdict: Verdict
    effects: tuple[EffectEstimate, ...] = ()
    """Effects to add to the model, the most important first; of an ``unknown_effect`` the formula, if it helps."""
    known_parts: tuple[EffectEstimate, ...] = ()
    """Of an ``unknown_effect``: effects of the catalogue that explain a part of it. They are not added to the model."""
    localisation: tuple[Localisation, ...] = ()
    gap: Mapping[str, GapRow] = field(default_factory=dict)
    """By metric, such as ``position_2s``."""
    noise_floor: NoiseFloor | None = None
    advice: tuple[str, ...] = ()
    candidates: tuple[CandidateScore, ...] = ()
    """Every effect that was tried, with its gain."""
    regimes: tuple[RegimeRow, ...] = ()
    """Errors at the end of the windows by motion regime."""
    held_out: Mapping[str, Mapping[str, GapRow]] = field(default_factory=dict)
    """Tables like ``gap`` of further recordings, by their names."""
    fitted: Effects = ()
    """Effects with the values fitted to the whole recording."""
    commissioned: bool = True
    """Whether the robot's file knows the healthy robot."""
    remarks: tuple[str, ...] = ()
    """The reasons for the verdict."""
    shift: Effects = ()
    """The effect by which commands were shifted, since the base reads them later in its cycle; no fault."""
    not_found_again: bool = False
    """Whether the known parts explain the whole recording, and searches without a part of it do not find them."""
    losses: Losses | None = None
    details: Details | None = None
    localisation_error: float | None = None
    """By how much poses and gyro turn apart within the windows, where that is beyond the noise of the poses [deg]."""
    steps: StepComparison | None = None
    """Errors after steps of the command beside those of a kinematic fit."""
    part: str = ""
    """The part of the recording in which alone the effects act, in words; empty if they act in all of it."""
    partial: tuple[str, ...] = ()
    """Names of the effects that act in ``part`` only; what sensors measured acts always."""
    regional: bool = False
    """Whether ``part`` is a part of the ground, rather than the time from some moment on."""
    set_aside: Verdict | None = None
    """Verdict on all effects where only those that sensors measured are kept, since the ground may be the cause of the
    rest, which is listed in ``known_parts``; None where nothing was set aside."""
    healthy: Mapping[str, float] = field(default_factory=dict)
    """Median errors of the healthy robot at the end of a window, ``position`` [m] and ``heading`` [deg]; empty for one
    that was never commissioned."""
    observed: tuple[str, ...] = ()
    """What the recording shows of the robot besides: wheels that turn in place, a lean or currents of the motors that
    have changed."""
    repeated: bool = False
    """Whether the whole search was repeated without parts of the recording, which what it found then predicts; else
    windows are predicted with values fitted to other blocks, and effects were selected on all of them."""
    by_part: HeldOut | None = None
    """Effects that searches without each part of the recording found; None where nothing is added, or the search was
    not repeated."""
    motion_unexplained: bool = False
    """Whether, besides what a sensor measured, the motion is not as predicted, and no effect improves it."""

    def __post_init__(self):
        if self.verdict in _NOTHING_ADDED:
            rows = [*self.gap.values(), *(row for table in self.held_out.values() for row in table.values())]
            if self.effects or self.fitted or any(row.after is not None for row in rows):
                raise ValueError(f"a diagnosis with the verdict {self.verdict} adds no effects and has no errors after")


_NOTHING_ADDED = frozenset({Verdict.NO_DISCREPANCY, Verdict.NO_IMPROVEMENT, Verdict.NOT_IDENTIFIABLE})


def diagnose(
    evidence: Evidence,
    robot: RobotModel,
    *,
    nominal: NominalModel | None = None,
    settings: DiagnosisSettings = DiagnosisSettings(),  # noqa: B008
    ground_explains: Callable[[Decision], bool] = lambda decision: False,
    progress: Callable[[float, str], None] = lambda share, step: None,
) -> Diagnosis:
    """Find the physical effects that a robot's model lacks in a recording.

    Args:
        evidence: motion, commands and ground.
        robot: the nominal model with the effects of its file.
        nominal: what commissioning learned, at ``settings.samples``; None for a robot that was never commissioned.
        settings: settings of the diagnosis.
        ground_explains: whether what a decision names, or leaves without a name, may be the ground's. What gyro, wheel
            speeds and joints measured does not depend on it and is kept.
        progress: called with the share of the work done and the next step.
    """
    progress(0.0, "preflight")
    if settings.processes > 1:
        prepare_processes()
    evidence = corrected_evidence(evidence, robot)
    evidence, nominal = with_known_components(evidence, nominal)
    smoothed = evidence.smoothed
    comparable = comparable_windows(evidence, robot, settings)
    starts, left_out = comparable.starts, comparable.remarks
    leans = (
        changed_lean(lean_of(smoothed.motion), nominal.lean) if nominal is not None and evidence.with_attitude else ""
    )
    known = None if nominal is None else nominal.efforts
    efforts = changed_efforts(
        evidence.commands, evidence.efforts, evidence.wheels, robot, known, settings.thresholds,
        left_out=comparable.left_out.stretches,
    )  # fmt: skip
    faults = motion_faults(smoothed, evidence.commands, evidence.wheels, evidence.efforts)
    if faults:
        return Diagnosis(Verdict.NOT_IDENTIFIABLE, advice=faults, remarks=(*left_out, *efforts))
    found = complaints(evidence, starts)
    if found:
        return Diagnosis(Verdict.NOT_IDENTIFIABLE, advice=(*left_out, *found))
    samples = np.array(settings.samples)
    progress(0.02, "noise floor")
    noisy = noisy_motions(smoothed, settings.seed)
    windows = windows_of(evidence, robot, starts, samples, noisy)
    aligned = explain_aligned(evidence, robot, windows, nominal, settings, _Steps(progress, 0.05, 0.6))
    evidence, explanation = aligned.evidence, aligned.explanation
    part = explanation.part
    area, meaning = (part.area if isinstance(part, Region) else None), "acts here"
    aside = None
    if ground_explains(explanation.decision):
        by_sensors = explanation.by_sensors(settings.thresholds)
        if by_sensors.decision.verdict == Verdict.EFFECT_FOUND:
            aside, explanation = explanation.decision, by_sensors
            settings = replace(settings, sensors_only=True)
    search, outcome, sensors = explanation.search, explanation.outcome, explanation.sensors
    data, uncertainty = explanation.windows.data, explanation.windows.uncertainty
    floor = np.sqrt((uncertainty**2).mean(axis=0))
    before = search.predictions.residuals([()])[0]
    progress(0.6, "comparing before and after")
    judge = Judge.of(evidence, robot, explanation, comparable.left_out, noisy, settings)
    steps = _Steps(progress, 0.62, 0.95)
    concluded = conclude(
        explanation, judge, lambda: repeat(evidence, robot, explanation.windows, nominal, settings, steps)
    )
    decision, repetition = concluded.decision, concluded.repetition
    parts = decision.parts
    if aside is not None:
        parts = aside.trial if aside.verdict == Verdict.EFFECT_FOUND else aside.parts
    known_parts = () if parts is None else _estimated(search, search.refit(parts.effects), outcome, sensors)
    # Values for the robot's file are fitted to the whole recording.
    whole = None if decision.trial is None else search.refit(decision.trial.effects)
    effects = () if whole is None else _ranked(search, whole, _estimated(search, whole, outcome, sensors))
    if repetition is not None:
        effects = repetition.judged(effects, settings.thresholds)
    fitted: Effects = () if whole is None else whole.effects
    measured = Measured.beside(decision.verdict, effects, concluded.gap, sensors, robot)
    verdict = measured.verdict
    remarks = (*decision.remarks, *measured.remarks, *left_out, *filter(None, (aligned.remark, leans, *efforts)))
    if sensors.wheels is not None:
        remarks = (*remarks, sensors.wheels.summary())
    compared = concluded.compared
    at_horizon = next((comparison for comparison in compared if comparison.horizon == settings.horizon), None)
    expected = floor if nominal is None else np.sqrt(floor**2 + (nominal.residual_in(data) ** 2).mean(axis=0))
    paths = tuple(measured_paths(robot, data, evidence, comparable.left_out, concluded.judged))
    regimes = find_regimes(data)
    hints = advice(verdict, measured.effects, gyro=evidence.gyro is not None)
    place = None
    if part is None and verdict == Verdict.UNKNOWN_EFFECT:
        place = worst_place(data, search.loss_of(()), settings.thresholds.comparison_rate)
    if place is not None:
        regimes[place.place.words] = place.inside
        area, meaning = place, "largest errors"
        hints = (
            f"look at the ground {place.place.words}: there errors are largest whenever the robot comes by",
            *hints,
        )
    apart, noise = judge.by_gyro.get(settings.horizon, 0.0), float(np.degrees(floor[-1, 2]))
    progress(1.0, "done")
    return Diagnosis(
        verdict=verdict,
        effects=measured.effects,
        known_parts=known_parts,
        localisation=localise(before, expected, data, regimes),
        gap=measured.gap,
        noise_floor=NoiseFloor(float(samples[-1]), *(float(value) for value in floor[-1, : len(MOTION)])),
        advice=hints,
        candidates=outcome.tried,
        regimes=() if at_horizon is None else tuple(regime_table(at_horizon)),
        fitted=fitted,
        remarks=remarks,
        shift=aligned.shift,
        not_found_again=concluded.not_found_again,
        losses=decision.losses,
        localisation_error=apart if apart > ABOVE_NOISE * noise else None,
        commissioned=search.commissioned,
        details=Details(data, before, floor, compared, paths, area, meaning, smoothed.stretches),
        part="" if part is None or verdict in _NOTHING_ADDED else part.remark,
        partial=() if part is None else tuple(name for name, _ in fitted if name not in dict(search.known)),
        regional=isinstance(part, Region),
        set_aside=None if aside is None else aside.verdict,
        repeated=repetition is not None,
        by_part=None if repetition is None else concluded.judged,
        motion_unexplained=measured.motion_unexplained,
        healthy={} if nominal is None else _medians(expected[-1]),
        observed=tuple(filter(None, (comparable.blocked, leans, *efforts))),
    )


def _medians(rms: np.ndarray) -> dict[str, float]:
    """Median errors of position [m] and heading [deg] that are normal with RMS along, across and in heading [m, rad].

    The median of a distance whose two parts are normal is √(ln 2) of its RMS (Rayleigh), of one such part 0.674.
    """
    return {
        "position": float(np.sqrt(np.log(2.0)) * np.hypot(rms[0], rms[1])),
        "heading": float(np.degrees(0.6745 * rms[2])),
    }


def _estimated(search: Search, fit: Fit, outcome: Outcome, sensors: SensorFindings) -> tuple[EffectEstimate, ...]:
    """Estimates of a fit, with the intervals of sensors that measured them; those of sensors and clocks include what
    the robot's file says already."""
    estimates = beyond_file(search.estimates(fit, outcome.indistinguishable), search.robot)
    return tuple(sensors.with_interval(estimate, search) for estimate in estimates)


def _ranked(search: Search, fit: Fit, estimates: Sequence[EffectEstimate]) -> tuple[EffectEstimate, ...]:
    """Estimates by what the others leave without each; what is no measurement, such as a value at its bound, comes
    last, whatever hangs on it."""
    ranked = [estimates[i] for i in search.ranked(fit)]
    return tuple(sorted(ranked, key=lambda estimate: estimate.name != LEARNED and bool(complaint(estimate))))


class _Steps:
    """Progress of a search of unknown length: each step takes a share of the remainder."""

    def __init__(self, progress: Callable[[float, str], None], start: float, stop: float):
        self._progress, self._at, self._stop = progress, start, stop

    def __call__(self, step: str) -> None:
        self._at += 0.016 * (self._stop - self._at)
        self._progress(self._at, step)
