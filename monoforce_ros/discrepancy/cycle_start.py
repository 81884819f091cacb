"""Cycle start: a base controller that reads commands sooner or later in its cycle than when it was commissioned.

A base reads the last command once a cycle. How long a command has lain there differs from one start of the robot to the
next, by up to the time between two commands: that is no fault, but it delays all motion. Where a recording is not
explained without it, or better than by a lag, commands are shifted by it, and the recording is explained again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Explanation, Windows, explain
from monoforce_ros.discrepancy.hypothesis import Effects, correct_measurements
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Aligned:
    """A recording whose commands act when the base read them, and what explains it."""

    evidence: Evidence
    explanation: Explanation
    shift: Effects = ()
    """The effect by which commands were shifted."""
    remark: str = ""
    """By how much commands were shifted, in words; empty where they were not."""


def explain_aligned(
    evidence: Evidence,
    robot: RobotModel,
    windows: Windows,
    nominal: NominalModel | None,
    settings: DiagnosisSettings,
    progress: Callable[[str], None] = lambda step: None,
) -> Aligned:
    """What explains a recording, with commands shifted by less than the time between two where only that does.

    Arguments are those of :func:`~monoforce_ros.discrepancy.explanation.explain`.
    """
    found = explain(evidence, robot, windows, nominal, settings, progress)
    passed = found.findings.fit.passed(settings.thresholds)
    named = len(found.outcome.best.effects) > len(found.search.known)
    if settings.sensors_only or (passed and not named):
        return Aligned(evidence, found)
    shift = found.search.start_of_cycle(found.outcome.best, explained=passed)
    if not shift:
        return Aligned(evidence, found)
    _, commands = correct_measurements(evidence.smoothed.motion, evidence.commands, shift)
    shifted = replace(evidence, commands=commands)
    progress("explaining it with commands that act sooner or later")
    again = explain(
        shifted, robot, replace(windows, data=replace(windows.data, commands=commands)), nominal, settings, progress
    )
    if not again.findings.fit.passed(settings.thresholds):
        return Aligned(evidence, found)
    ((name, values),) = shift
    offset = float(values[CATALOGUE[name].shifts])
    when = "later" if offset < 0.0 else "sooner"
    remark = (
        f"commands act {abs(offset):.3f} s {when} than on the healthy robot: less than the time between two of them, "
        "by which a base may differ from one start to the next"
    )
    return Aligned(shifted, again, shift, remark)
