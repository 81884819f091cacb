"""Preflight: whether a drive can tell anything, and what to drive so that it tells more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.selection import EQUIVALENT

FEWEST_WINDOWS = 12

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
        if any({effect["name"], rival} <= group for group in EQUIVALENT for rival in effect["rivals"]):
            told.append("an IMU's gyro tells whether the poses are late or the base waits: record it")
        for rival in effect["rivals"]:
            what = _MANOEUVRES.get(frozenset({effect["name"], rival}))
            if what:
                told.append(f"{what} would tell {effect['name']} from {rival}")
    if verdict == "no_discrepancy":
        told.append("what this drive did not do it cannot show: other speeds, turns, loads and grounds")
    if verdict == "unknown_effect":
        told.append("drive where the error is largest again, once as before and once at half the speed")
    if verdict == "no_improvement":
        told.append("a longer drive may tell: 60 s with steps of the speed and turns to both sides")
    return tuple(dict.fromkeys(told))
