"""Preflight: whether a recording is sufficient for a diagnosis, and which manoeuvres to record next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.selection import EQUIVALENT
from monoforce_ros.discrepancy.verdict import Verdict

FEWEST_WINDOWS = 12
"""A diagnosis needs at least as many."""

_MANOEUVRES: dict[frozenset[str], str] = {
    frozenset({"command_delay", "actuator_lag"}): "steps of the speed from standing",
    frozenset({"drive_gain", "actuator_saturation"}): "slow and fast stretches straight ahead",
    frozenset({"drive_gain", "actuator_deadband"}): "slow and fast stretches straight ahead",
    frozenset({"drive_gain", "viscous_drag"}): "slow and fast stretches straight ahead",
    frozenset({"drive_gain", "rolling_resistance"}): "slow and fast stretches straight ahead",
    frozenset({"rolling_resistance", "viscous_drag"}): "slow and fast stretches straight ahead",
    frozenset({"viscous_drag", "quadratic_drag"}): "slow and fast stretches straight ahead",
    frozenset({"friction_scale", "turning_scrub"}): "turns on the spot and hard starts",
    frozenset({"drive_gain", "turning_scrub"}): "straight stretches and turns on the spot",
    frozenset({"drive_gain", "pose_clock_offset"}): "stops and starts",
    frozenset({"drive_asymmetry", "constant_force"}): "the same stretch forward and in reverse",
    frozenset({"drive_asymmetry", "sensor_yaw_offset"}): "turns on the spot to both sides",
    frozenset({"constant_force", "gravity_tilt"}): "the same stretch in opposite directions",
    frozenset({"payload", "turning_scrub"}): "turns on the spot, and driving across a slope",
    frozenset({"payload", "sensor_lever_arm"}): "hard starts and stops straight ahead",
    frozenset({"payload", "friction_scale"}): "driving up and across a slope",
}


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
        if any({effect.name, other} <= group for group in EQUIVALENT for other in effect.indistinguishable):
            hints.append("record an IMU: its gyro shows whether the poses or the base are late")
        for other in effect.indistinguishable:
            manoeuvre = _MANOEUVRES.get(frozenset({effect.name, other}))
            if manoeuvre:
                hints.append(f"{manoeuvre} would distinguish {effect.name} from {other}")
    if verdict == Verdict.NO_DISCREPANCY:
        hints.append("the result covers only what was recorded: also record other speeds, turns, loads and grounds")
    if verdict == Verdict.UNKNOWN_EFFECT:
        hints.append("repeat the manoeuvres with the largest error, once as before and once at half the speed")
    if verdict == Verdict.NO_IMPROVEMENT:
        hints.append("record longer: 60 s with steps of the speed and turns both ways")
    return tuple(dict.fromkeys(hints))
