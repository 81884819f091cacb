"""Explanation: the effects that explain a recording, from its sensors by a search and a formula to a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from monoforce_ros.discrepancy.gap import residual_scale
from monoforce_ros.discrepancy.hypothesis import Evidence, EvidenceWindows, Predictions
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.onset import Onset, find_onset
from monoforce_ros.discrepancy.preflight import FEWEST_WINDOWS
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.sensor_findings import SensorFindings, refined_clock
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import Outcome, paired
from monoforce_ros.discrepancy.verdict import Decision, Findings, decide, leaves_most
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a recording is diagnosed."""

    horizon: float = 2.0
    """Length of the windows [s]."""
    stride: float = 1.0
    """Time between their starts [s]."""
    samples: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    """Times in a window at which residuals are computed [s]."""
    max_effects: int = 4
    max_windows: int = 120
    """A longer recording is subsampled to about as many, spread over all of it."""
    seed: int = 0
    processes: int = 1
    """In which the diagnosis is repeated without parts of the recording."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    sensors_only: bool = False
    """Only effects that gyro, wheel speeds or joints measured: of the rest something else may be the cause."""


@dataclass(frozen=True)
class Windows:
    """Windows of a recording with what noise and map leave uncertain in each."""

    data: EvidenceWindows
    uncertainty: np.ndarray
    """Residuals by noise and map, ``[W, K, C]``."""

    def __getitem__(self, chosen: np.ndarray) -> Windows:
        return Windows(replace(self.data, starts=self.data.starts[chosen]), self.uncertainty[chosen])


@dataclass(frozen=True)
class Explanation:
    """The effects that explain a recording, and the search that found them."""

    windows: Windows
    """Those that were searched: after an onset the later ones."""
    sensors: SensorFindings
    search: Search
    outcome: Outcome
    findings: Findings
    """From which the decision follows."""
    decision: Decision
    onset: Onset | None = None

    def by_sensors(self, thresholds: Thresholds) -> Explanation:
        """What gyro, wheel speeds and joints measured, without the effects that the motion showed in addition."""
        return _measured(self.windows, self.sensors, self.search, thresholds)


def explain(
    evidence: Evidence,
    robot: RobotModel,
    windows: Windows,
    nominal: NominalModel | None,
    settings: DiagnosisSettings,
    progress: Callable[[str], None] = lambda step: None,
    *,
    repeated: bool = False,
) -> Explanation:
    """Find the effects that explain the windows of a recording.

    Args:
        evidence: the recording, corrected for what the robot's file says of its sensors.
        robot: the nominal model with the effects of its file.
        windows: the windows to explain.
        nominal: what commissioning learned; None for a robot that was never commissioned.
        settings: settings of the diagnosis.
        progress: called with each step.
        repeated: the windows are a part of those that were explained already: they begin after an onset, and what could
            stand in an effect's place is known.
    """
    thresholds = settings.thresholds
    sensors = SensorFindings.of(evidence, robot, commissioned=nominal is not None)

    def searched(part: Windows) -> Search:
        scale, known = residual_scale(part.uncertainty, part.data, nominal), sensors.known
        if sensors.gyro is not None:
            known = refined_clock(known, sensors.gyro, Predictions(robot, part.data), scale)
        return Search(
            robot,
            part.data,
            scale,
            nominal=nominal,
            known=known,
            hints=sensors.hints,
            excluded=sensors.excluded,
            thresholds=thresholds,
            seed=settings.seed,
            progress=progress,
        )

    search = searched(windows)
    if settings.sensors_only:
        return _measured(windows, sensors, search, thresholds)
    outcome = search.run(settings.max_effects, exchange=not repeated)
    onset = None
    passed, found = outcome.fit.passed(thresholds), len(outcome.best.effects) > len(search.known)
    late_only = not repeated and passed and not found and search.onset_p() <= thresholds.effect_rate
    if not repeated and (late_only or not passed):
        starts = windows.data.starts
        trials = [outcome.best]
        second = starts >= np.median(starts)
        unexplained = not outcome.best.effects or outcome.fit.explained < thresholds.explained_share
        if unexplained and second.sum() >= FEWEST_WINDOWS:
            # An effect that begins late may be too weak over the whole recording, or another one stand in for it.
            found_late = searched(windows[second]).run(1, exchange=False, missing=late_only)
            trials.append(search.judge(found_late.best.effects))
        onsets = [found for found in (find_onset(search, trial) for trial in trials) if found is not None]
        onset = min(onsets, key=lambda found: found.loss, default=None)
        late = starts >= (starts[0] if onset is None else onset.stamp)
        after = None
        if onset is not None and late.sum() >= FEWEST_WINDOWS:
            later = searched(windows[late])
            after = later.run(settings.max_effects, missing=late_only)
        if after is None or (late_only and not after.best.effects):
            # What a whole recording does not show, and no effect explains from an onset on, is nothing.
            onset = None
        else:
            windows, search, outcome = windows[late], later, after
    findings = _findings(search, outcome)
    doubtful = bool(outcome.best.effects) and not findings.commissioned and leaves_most(findings, thresholds)
    if doubtful or not findings.fit.passed(thresholds):
        starts = windows.data.starts
        learned = search.learn(outcome.best.effects)
        if len(outcome.best.effects) > len(search.known):
            alone = search.learn()
            _, low = paired(alone.held_out_loss, learned.held_out_loss, starts, thresholds.comparison_rate)
            # A formula that predicts as well without the effects takes their place.
            learned = learned if low > 0 else alone
        gain = paired(outcome.best.held_out_loss, learned.held_out_loss, starts, thresholds.comparison_rate)
        findings = replace(findings, formula=learned, formula_gain=gain)
    decision = decide(findings, thresholds)
    decision = replace(decision, losses=replace(decision.losses, variance_ratio=outcome.variance_ratio))
    return Explanation(windows, sensors, search, outcome, findings, decision, onset)


def _measured(windows: Windows, sensors: SensorFindings, search: Search, thresholds: Thresholds) -> Explanation:
    """The explanation by the effects that sensors measured alone."""
    outcome = search.measured()
    findings = _findings(search, outcome)
    return Explanation(windows, sensors, search, outcome, findings, decide(findings, thresholds))


def _findings(search: Search, outcome: Outcome) -> Findings:
    """What a search found, without a formula."""
    return Findings(
        outcome.nominal, outcome.best, outcome.fit,
        healthy_loss=search.healthy_loss,
        commissioned=search.commissioned,
        known=search.known,
    )  # fmt: skip
