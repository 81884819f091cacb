"""Explanation: the effects that explain a recording, from its sensors by a search and a formula to a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows, Place
from monoforce_ros.discrepancy.gap import residual_scale
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.onset import find_onset
from monoforce_ros.discrepancy.preflight import FEWEST_WINDOWS
from monoforce_ros.discrepancy.region import find_region
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.sensor_findings import SensorFindings, refined_clock
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import Outcome, Trial, paired
from monoforce_ros.discrepancy.verdict import Decision, Findings, decide, leaves_most
from monoforce_ros.effects import CATALOGUE
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


class Part(Protocol):
    """A part of a recording in which effects act, while the robot is healthy in the rest."""

    @property
    def acting(self) -> np.ndarray:
        """Windows in which they act, ``[W]`` bool."""
        ...

    def acting_in(self, data: EvidenceWindows) -> np.ndarray:
        """Windows of any length in which they act, ``[W]`` bool."""
        ...

    @property
    def losses(self) -> np.ndarray:
        """Of each window, ``[W]``."""
        ...

    @property
    def place(self) -> Place | None:
        """The ground on which they act while such a window lasts; None: they act in the whole of it."""
        ...

    @property
    def remark(self) -> str:
        """When or where, in words."""
        ...


@dataclass(frozen=True)
class Windows:
    """Windows of a recording with what noise and map leave uncertain in each."""

    data: EvidenceWindows
    uncertainty: np.ndarray
    """Residuals by noise and map, ``[W, K, C]``."""

    def __getitem__(self, chosen: np.ndarray) -> Windows:
        return Windows(replace(self.data, starts=self.data.starts[chosen]), self.uncertainty[chosen])

    def on(self, place: Place | None) -> Windows:
        """The same windows, with effects that act on a part of the ground."""
        return replace(self, data=replace(self.data, place=place))


@dataclass(frozen=True)
class Explanation:
    """The effects that explain a recording, and the search that found them."""

    windows: Windows
    """Those that were searched: of an effect that acts in a part of the recording, these."""
    sensors: SensorFindings
    search: Search
    outcome: Outcome
    findings: Findings
    """From which the decision follows."""
    decision: Decision
    part: Part | None = None
    """The part in which the effects act; None if that is the whole recording."""

    @property
    def dispensable(self) -> bool:
        """Whether without the effects a recording would look like the healthy robot's: no sensor measured them, they
        act in all of it, and it has no errors larger than that robot's."""
        if self.part is not None or self.search.known:
            return False
        size_p = self.search.size_p(self.findings.nominal)
        return size_p is not None and size_p > self.search.thresholds.fit_rate

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
        repeated: the windows are a part of those that were explained already: the effects act in all of them, and what
            could stand in an effect's place is known.
    """
    thresholds = settings.thresholds
    healthy = None if nominal is None else nominal.wheels
    sensors = SensorFindings.of(
        evidence, robot, commissioned=nominal is not None, healthy=healthy, thresholds=thresholds
    )

    def searched(part: Windows, *, of_time: bool = False) -> Search:
        scale, known = residual_scale(part.uncertainty, part.data, nominal), sensors.known
        excluded = sensors.excluded
        if part.data.place is not None:
            excluded = (*excluded, *(effect.name for effect in CATALOGUE.values() if effect.everywhere))
        if sensors.gyro is not None:
            known = refined_clock(known, sensors.gyro, Predictions(robot, part.data), scale)
        return Search(
            robot,
            part.data,
            scale,
            nominal=nominal,
            known=known,
            hints=sensors.hints,
            excluded=excluded,
            of_time=of_time,
            thresholds=thresholds,
            seed=settings.seed,
            progress=progress,
        )

    search = searched(windows)
    if settings.sensors_only:
        return _measured(windows, sensors, search, thresholds)
    outcome = search.run(settings.max_effects, exchange=not repeated)
    whole, first = windows, outcome.best
    part: Part | None = None
    passed, found = outcome.fit.passed(thresholds), len(outcome.best.effects) > len(search.known)
    partly = not repeated and passed and not found and search.part_p() <= thresholds.part_rate
    if not repeated and (partly or not passed):
        starts = windows.data.starts
        trials = [outcome.best]
        second = starts >= np.median(starts)
        unexplained = not outcome.best.effects or outcome.fit.explained < thresholds.explained_share
        if unexplained and second.sum() >= FEWEST_WINDOWS:
            # An effect that begins late may be too weak over the whole recording, or another one stand in for it.
            found_late = searched(windows[second]).run(1, exchange=False, missing=partly)
            trials.append(search.judge(found_late.best.effects))
        found_part = _part(search, trials)
        if found_part is not None and found_part.acting.sum() >= FEWEST_WINDOWS:
            acting = windows[found_part.acting].on(found_part.place)
            there = searched(acting)
            after = there.run(settings.max_effects, missing=partly)
            # What a whole recording does not show, and no effect explains in a part of it, is nothing.
            named = len(after.best.effects) > len(search.known)
            doubted = named and search.follows_heading(after.best.effects, found_part.acting)
            if not doubted and (after.best.effects or not partly):
                part, windows, search, outcome = found_part, acting, there, after
    if (partly or found or not passed) and search.grows_with_time(first):
        # From one block to the next, like a supply that drains, rather than from some time on or from the beginning.
        growing = searched(whole, of_time=True)
        after = growing.run(settings.max_effects, exchange=not repeated, missing=partly)
        if _grows(after.best) and after.fit.passed(thresholds):
            losses = first.held_out_loss if part is None else part.losses
            if after.best.loss < float(losses.mean()):
                part, windows, search, outcome = None, whole, growing, after
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
    return Explanation(windows, sensors, search, outcome, findings, decision, part)


def _grows(trial: Trial) -> bool:
    """Whether effects are among those of a trial that grow with time."""
    return any(CATALOGUE[name].clock for name in trial.names)


def _part(search: Search, trials: Sequence[Trial]) -> Part | None:
    """The part of a recording in which effects act: from a time on, or in a region of the ground."""
    parts: list[Part] = [found for found in (find_onset(search, trial) for trial in trials) if found is not None]
    best = min(parts, key=lambda part: part.losses.mean(), default=None)
    region = find_region(search, trials)
    if best is None or region is None:
        return region if best is None else best
    # There are more regions than onsets to choose from: one must predict better beyond chance.
    _, low = paired(best.losses, region.losses, search.data.starts, search.thresholds.comparison_rate)
    return region if low > 0 else best


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
