"""Repetition: the diagnosis repeated without parts of a recording, so that errors are judged on data it never saw.

The recording is cut into blocks of 16 s, which take turns in being left out. Without each part sensors are compared,
effects selected and their values fitted again; what is found there predicts the part. An effect that is found again
each time does not hang on a single manoeuvre.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import forkserver

import numpy as np
import torch

from monoforce_ros.core import WheelTrack
from monoforce_ros.discrepancy.comparison import HeldOut
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Explanation, Windows, explain
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.jackknife import widened
from monoforce_ros.discrepancy.learned import LEARNED
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import BLOCK
from monoforce_ros.discrepancy.verdict import Decision, Verdict, decide
from monoforce_ros.robots import RobotModel

LENGTH = 2 * BLOCK
"""Length of the blocks that are left out together [s]: two of those that the search itself holds out."""
_COUNTS = (3, 4, 5, 7)
"""Numbers of parts, the preferred one first: a long recording is subsampled to every so many blocks, and must not lose
all of them at once."""
FEWEST_PARTS = 3
"""Of two parts only half of the recording would be left, on which a search finds less."""
FEWEST_WINDOWS = 8
"""On which a search is repeated: as many as a block of the search holds."""
_CONTEXT = multiprocessing.get_context("forkserver")


@dataclass(frozen=True)
class Repeated:
    """What a diagnosis without one part of a recording found."""

    effects: Effects = ()
    """With the values fitted without the part; empty where nothing is added to the model."""
    named: tuple[str, ...] = ()
    """Effects that are found, known parts of an unknown one included."""


@dataclass(frozen=True)
class Repetition:
    """The diagnosis repeated without each part of a recording."""

    first: int
    """Start of the first block [ns]."""
    repeated: tuple[Repeated | None, ...]
    """By part; None for a part without windows."""

    @property
    def held_out(self) -> HeldOut:
        """The effects that predict each part."""
        return HeldOut(tuple(() if r is None else r.effects for r in self.repeated), self.first, LENGTH)

    def confirmed(self, explanation: Explanation, decision: Decision, thresholds: Thresholds) -> Decision:
        """The decision without the effects beside others that fewer than half of the repetitions find (stability
        selection, Meinshausen and Bühlmann 2010), where another one that takes their place is the same finding.

        The rest is judged anew: without them it may leave what does not look like the healthy robot. Where none of
        several effects is found again, or a single one by no repetition, the recording does not say what is wrong, or
        nothing is where its errors are no larger than a healthy robot's. An effect without which the values of the
        others are no measurements belongs to them, and stays, as does one that explains most of the rest, on held-out
        windows and beyond chance: a search in two thirds of a recording misses much of what is there.
        """
        trial, search = decision.trial, explanation.search
        if trial is None or decision.verdict != Verdict.EFFECT_FOUND:
            return decision
        alike, known = explanation.outcome.indistinguishable, dict(search.known)
        supported = {name: self._support(name, alike, trial.names) for name in trial.names if name not in known}
        missing = [name for name, support in supported.items() if not support.often]
        if len(trial.names) == 1:
            missing = [name for name in missing if not supported[name].found]
        else:
            missing = [name for name in missing if not search.needs(trial, name)]
        if not missing:
            return decision
        dropped = " and ".join(missing)
        how_often = "none" if len(trial.names) == 1 else "fewer than half"
        remark = f"{dropped} found again in {how_often} of the searches without a part of the recording"
        kept = tuple(entry for entry in trial.effects if entry[0] not in missing)
        if not kept:
            others = dict.fromkeys(n for r in self.repeated if r is not None for n in r.named if n not in trial.names)
            instead = f"; these name {' or '.join(others)}" if others else ""
            remarks = (*decision.remarks, f"{remark}{instead}")
            if explanation.dispensable:
                return replace(decision, verdict=Verdict.NO_DISCREPANCY, trial=None, remarks=remarks)
            return replace(decision, verdict=Verdict.UNKNOWN_EFFECT, trial=None, parts=trial, remarks=remarks)
        best = search.judge(kept)
        if search.credible(trial) and not search.credible(best):
            return decision
        findings = explanation.findings
        findings = replace(findings, best=best, fit=search.fit_test(best, findings.nominal), formula=None)
        again = decide(findings, thresholds)
        losses = replace(again.losses, variance_ratio=decision.losses.variance_ratio)
        return replace(again, remarks=(*again.remarks, f"not added: {remark}"), losses=losses)

    def judged(
        self,
        effects: Sequence[EffectEstimate],
        thresholds: Thresholds = Thresholds(),  # noqa: B008
    ) -> tuple[EffectEstimate, ...]:
        """The effects of the whole recording, each with how often it was found again, and with intervals as wide as
        the values that were found then ask for.

        Where another effect is found in its place half of the time, the recording does not tell the two apart. Where
        fewer than half of the repetitions find it, it is one class with all that they name in its place.
        """
        done = [entry for entry in self.repeated if entry is not None]
        names = [effect.name for effect in effects]
        alike = {effect.name: effect.indistinguishable for effect in effects}
        result = []
        for effect in effects:
            if effect.name == LEARNED:
                result.append(effect)
                continue
            support = self._support(effect.name, alike, names)
            again = [values for entry in done for name, values in entry.effects if name == effect.name]
            result.append(
                replace(
                    widened(effect, again, len(done), thresholds.confidence),
                    indistinguishable=(*effect.indistinguishable, *support.instead),
                    found_again=(support.found, support.repetitions),
                    named_otherwise=support.named_otherwise,
                )
            )
        return tuple(result)

    def _support(self, name: str, alike: Mapping[str, Sequence[str]], names: Sequence[str]) -> _Support:
        """How often an effect, or one that is indistinguishable from it, is found again beside the others."""
        done = [entry for entry in self.repeated if entry is not None]
        same = {name, *alike.get(name, ())}
        missed = [r for r in done if not same & set(r.named)]
        instead = [other for r in missed for other in r.named if other not in names]
        often = tuple(other for other in dict.fromkeys(instead) if 2 * instead.count(other) >= len(done))
        return _Support(len(done) - len(missed), len(done), often, tuple(dict.fromkeys(instead)))


@dataclass(frozen=True)
class _Support:
    """How often an effect is found again."""

    found: int
    repetitions: int
    instead: tuple[str, ...]
    """Other effects that take its place in at least half of the repetitions."""
    others: tuple[str, ...]
    """All that take its place in any of them."""

    @property
    def often(self) -> bool:
        """Whether it, or another one in its place, is found in at least half of them."""
        return bool(self.instead) or 2 * self.found >= self.repetitions

    @property
    def named_otherwise(self) -> tuple[str, ...]:
        """The other names of an effect that fewer than half of them find, without those that mean the same."""
        if 2 * self.found >= self.repetitions:
            return ()
        return tuple(name for name in self.others if name not in self.instead)


def prepare_processes() -> None:
    """Let a server load the package from which the processes of :func:`repeat` are forked, while other work goes on."""
    _CONTEXT.set_forkserver_preload([__name__])
    forkserver.ensure_running()


def repeat(
    evidence: Evidence,
    robot: RobotModel,
    windows: Windows,
    nominal: NominalModel | None,
    settings: DiagnosisSettings,
    progress: Callable[[str], None] = lambda step: None,
) -> Repetition | None:
    """What is found without each part of the windows; None for a recording too short for it.

    Arguments are those of :func:`~monoforce_ros.discrepancy.explanation.explain`.
    """
    starts = windows.data.starts
    first = int(starts[0])
    numbers = np.unique((starts - first) // round(LENGTH * 1e9))
    count = next((count for count in _COUNTS if len(np.unique(numbers % count)) >= FEWEST_PARTS), 0)
    if not count:
        return None
    places = HeldOut(((),) * count, first, LENGTH)
    part, end = places.part_of(starts), places.part_of(starts + round(windows.data.horizon * 1e9))
    chosen = [(part != number) & (end != number) for number in range(count)]
    present = [number for number in range(count) if (part == number).any()]
    if min(chosen[number].sum() for number in present) < FEWEST_WINDOWS:
        return None
    tasks = [
        (without_part(evidence, places, number), robot, windows[chosen[number]], nominal, settings)
        for number in present
    ]
    repeated: list[Repeated | None] = [None] * count
    if settings.processes > 1:
        # More of them than cores: none is idle while the last of an odd number of parts is repeated.
        workers = min(2 * settings.processes - 1, len(tasks))
        with ProcessPoolExecutor(workers, _CONTEXT, torch.set_num_threads, (1,)) as pool:
            running = [pool.submit(_found, *task) for task in tasks]
            for number, done in zip(present, running, strict=True):
                progress("repeating it without parts of the recording")
                repeated[number] = done.result()
    else:
        for number, task in zip(present, tasks, strict=True):
            progress("repeating it without parts of the recording")
            repeated[number] = _found(*task)
    return Repetition(first, tuple(repeated))


def _found(
    evidence: Evidence, robot: RobotModel, windows: Windows, nominal: NominalModel | None, settings: DiagnosisSettings
) -> Repeated:
    found = explain(evidence, robot, windows, nominal, settings, repeated=True)
    trial = found.decision.trial
    listed = trial or found.decision.parts
    return Repeated(
        () if trial is None else found.search.refit(trial.effects).effects,
        () if listed is None else tuple(name for name in listed.names if name != LEARNED),
    )


def without_part(evidence: Evidence, places: HeldOut, number: int) -> Evidence:
    """The sensors of a recording without what they measured in one part.

    Commands of the part stay, to wheels and to flippers: they say nothing of how the robot answered, and one that was
    given in the part may hold behind it.
    """
    smoothed = evidence.smoothed
    stretches: list[slice] = []
    for stretch in smoothed.stretches:
        poses = np.arange(stretch.start, stretch.stop)
        kept = poses[places.part_of(smoothed.motion.stamps[poses]) != number]
        runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
        stretches += [slice(int(run[0]), int(run[-1]) + 1) for run in runs if len(run) > 1]
    wheels, gyro, joints = evidence.wheels, evidence.gyro, evidence.joints
    if wheels is not None:
        chosen = places.part_of(wheels.stamps) != number
        wheels = WheelTrack(wheels.stamps[chosen], wheels.speeds[chosen])
    if gyro is not None:
        chosen = places.part_of(gyro.stamps) != number
        gyro = replace(gyro, stamps=gyro.stamps[chosen], rates=gyro.rates[chosen])
    if joints is not None and joints.measured is not None:
        chosen = places.part_of(joints.measured.stamps) != number
        measured = replace(
            joints.measured, stamps=joints.measured.stamps[chosen], angles=joints.measured.angles[chosen]
        )
        joints = replace(joints, measured=measured)
    smoothed = replace(smoothed, stretches=tuple(stretches))
    return replace(evidence, smoothed=smoothed, wheels=wheels, gyro=gyro, joints=joints)
