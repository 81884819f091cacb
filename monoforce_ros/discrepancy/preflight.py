"""Preflight: whether a recording is sufficient for a diagnosis, and which manoeuvres to record next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.effects import separating_manoeuvre, separating_sensor

FEWEST_WINDOWS = 12
"""A diagnosis needs at least as many."""


def complaints(smoothed: SmoothedMotion, commands: CommandTrack, starts: np.ndarray) -> list[str]:
    """Why a recording is not sufficient, each with a remedy; empty where it is."""
    if not len(commands):
        return ["no commands: record the command topic of the base controller"]
    found = []
    motion = smoothed.motion
    if len(motion) and (commands.stamps[-1] < motion.stamps[0] or commands.stamps[0] > motion.stamps[-1]):
        apart = max(int(motion.stamps[0] - commands.stamps[-1]), int(commands.stamps[0] - motion.stamps[-1])) * 1e-9
        return [f"commands and poses are {apart:.0f} s apart: synchronise the robot's clocks before recording"]
    if len(starts) < FEWEST_WINDOWS:
        found.append(f"{len(starts)} gap-free windows, expected at least {FEWEST_WINDOWS}: drive for 30 s or longer")
    speeds = motion.linear_velocities[:, 0]
    if np.abs(speeds).max(initial=0.0) < 0.15 and np.abs(commands.twists).max(initial=0.0) < 0.1:
        found.append("the robot hardly moves: drive forward at changing speed and turn both ways for 30 s")
    elif commands.twists[:, 0].std() < 0.03 and commands.twists[:, 1].std() < 0.05:
        found.append("the commands hardly change: step the speed, turn both ways, stop and start again")
    return found


def advice(verdict: Verdict, effects: Sequence[EffectEstimate]) -> tuple[str, ...]:
    """What to record next."""
    hints = []
    for effect in effects:
        hints += [sensor for other in effect.indistinguishable if (sensor := separating_sensor(effect.name, other))]
        for other in effect.indistinguishable:
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
