"""Preflight: whether a drive can tell anything, and what to drive so that it tells more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.effects import separating_manoeuvre, separating_sensor

FEWEST_WINDOWS = 12


def complaints(smoothed: SmoothedMotion, commands: CommandTrack, starts: np.ndarray) -> list[str]:
    """Why a drive cannot tell anything, each with what would help; empty where it can."""
    if not len(commands):
        return ["there are no commands: record what the base controller is told"]
    found = []
    motion = smoothed.motion
    if len(motion) and (commands.stamps[-1] < motion.stamps[0] or commands.stamps[0] > motion.stamps[-1]):
        apart = max(int(motion.stamps[0] - commands.stamps[-1]), int(commands.stamps[0] - motion.stamps[-1])) * 1e-9
        return [f"commands and poses are {apart:.0f} s apart: set the robot's clocks before you record"]
    if len(starts) < FEWEST_WINDOWS:
        found.append(
            f"{len(starts)} windows without a gap, at least {FEWEST_WINDOWS} are needed: drive for 30 s or longer"
        )
    speeds = motion.linear_velocities[:, 0]
    if np.abs(speeds).max(initial=0.0) < 0.15 and np.abs(commands.twists).max(initial=0.0) < 0.1:
        found.append("the robot hardly moves: drive forward at changing speed and turn to both sides for 30 s")
    elif commands.twists[:, 0].std() < 0.03 and commands.twists[:, 1].std() < 0.05:
        found.append("the commands hardly change: step the speed, turn to both sides, stop and start again")
    return found


def advice(verdict: str, effects: Sequence[dict]) -> tuple[str, ...]:
    """What would tell more."""
    told = []
    for effect in effects:
        told += [sensor for rival in effect["rivals"] if (sensor := separating_sensor(effect["name"], rival))]
        for rival in effect["rivals"]:
            what = separating_manoeuvre(effect["name"], rival)
            if what:
                told.append(f"{what} would tell {effect['name']} from {rival}")
    if verdict == "no_discrepancy":
        told.append("what this drive did not do it cannot show: other speeds, turns, loads and grounds")
    if verdict == "unknown_effect":
        told.append("drive where the error is largest again, once as before and once at half the speed")
    if verdict == "no_improvement":
        told.append("a longer drive may tell: 60 s with steps of the speed and turns to both sides")
    return tuple(dict.fromkeys(told))
