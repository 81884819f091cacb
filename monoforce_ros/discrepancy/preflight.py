"""Preflight: whether a recording is sufficient for a diagnosis, and which manoeuvres to record next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.effects import separating_manoeuvre, separating_sensor

FEWEST_WINDOWS = 12
"""A diagnosis needs at least as many: they begin a second apart, and lie in three blocks of 4 s, between which a spread
has two degrees of freedom, and in two blocks of 8 s, each predicted without the other."""
_LEAST_CHANGE = np.array([0.03, 0.05, 0.03])
"""Standard deviations of commanded speed [m/s], yaw rate [rad/s] and lateral speed [m/s] below which commands hardly
change: over a window of 2 s they move the robot by 6 cm and 6°. It is a choice, not calibrated: about twice what a
localisation that is off by 3 cm and 3° makes of a robot that keeps its speed."""
_CLOCKS = "synchronise the clocks of planner, base and localisation, and record again: what stays is no clock's error"


def complaints(evidence: Evidence, starts: np.ndarray) -> list[str]:
    """Why a recording whose motion can be compared (:func:`motion_faults`) is not sufficient, each with a remedy; empty
    where it is."""
    commands, found = evidence.commands, []
    if len(starts) < FEWEST_WINDOWS:
        found.append(f"{len(starts)} gap-free windows, expected at least {FEWEST_WINDOWS}: drive for 30 s or longer")
    if (commands.twists.std(axis=0) < _LEAST_CHANGE[: commands.twists.shape[1]]).all():
        found.append("the commands hardly change: step the speed, turn both ways, stop and start again")
    return found


def advice(verdict: Verdict, effects: Sequence[EffectEstimate], *, gyro: bool = False) -> tuple[str, ...]:
    """What to record next.

    Args:
        verdict: of the diagnosis.
        effects: that were found.
        gyro: whether the recording has one: to record an IMU is then no advice.
    """
    hints = []
    for effect in effects:
        sensors = [sensor for other in effect.indistinguishable if (sensor := separating_sensor(effect.name, other))]
        hints += [_CLOCKS] if sensors and gyro else sensors
        for other in (*effect.indistinguishable, *effect.named_otherwise):
            manoeuvre = separating_manoeuvre(effect.name, other)
            if manoeuvre:
                hints.append(f"{manoeuvre} would distinguish {effect.name} from {other}")
    if verdict == Verdict.NO_DISCREPANCY:
        hints.append("the result covers only what was recorded: also record other speeds, turns, loads and grounds")
    if verdict == Verdict.UNKNOWN_EFFECT:
        hints.append("repeat the manoeuvres with the largest error, once as before and once at half the speed")
    if verdict == Verdict.NO_IMPROVEMENT:
        hints.append("record longer: 60 s with steps of the speed and turns both ways")
    return tuple(dict.fromkeys(hints))
