"""Comparable windows: those of a recording in which the model's motion can be compared with the measured one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.evidence import Evidence, subsampled, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Windows
from monoforce_ros.discrepancy.gap import noise_floor
from monoforce_ros.discrepancy.terrain_evidence import terrain_uncertainty
from monoforce_ros.discrepancy.trial import BLOCK
from monoforce_ros.discrepancy.wheel_motion import undriven_stretches, wheels_without_motion
from monoforce_ros.robots import RobotModel


def comparable_starts(
    evidence: Evidence, robot: RobotModel, settings: DiagnosisSettings
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Starts ``[W]`` [ns] of windows in which the ground moves the robot as its commands ask.

    Returns:
        the starts, and in words what was left out for which reason.
    """
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, settings.horizon, settings.stride)
    starts = subsampled(starts, BLOCK, settings.max_windows)
    left_out, remarks = not_comparable(evidence, robot, starts, settings.horizon)
    return starts[~left_out], remarks


def not_comparable(
    evidence: Evidence, robot: RobotModel, starts: np.ndarray, horizon: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Windows in which something else than ground and commands moves or holds the robot, ``[W]`` bool, and why."""
    if not len(starts) or not len(evidence.commands):
        return np.zeros(len(starts), bool), ()
    smoothed = evidence.smoothed

    def overlapping(stretches: np.ndarray) -> np.ndarray:
        low, high = stretches.reshape(-1, 2).T
        return ((starts[:, None] < high) & (starts[:, None] + round(horizon * 1e9) > low)).any(axis=1)

    remarks = []
    undriven = undriven_stretches(evidence.commands, evidence.wheels, smoothed.motion, robot)
    left_out = overlapping(undriven)
    if left_out.any():
        seconds = float(np.diff(undriven, axis=1).sum()) * 1e-9
        remarks.append(f"{seconds:.0f} s are left out in which the robot moved without commands (a joystick?)")
    spinning = wheels_without_motion(smoothed.motion, evidence.wheels, evidence.commands, robot)
    if spinning is not None:
        remarks.append(spinning.summary())
        if spinning.side == "both":
            left_out |= overlapping(np.array(spinning.stretches, np.int64))
            remarks[-1] += "; this time is left out"
    return left_out, tuple(remarks)


def blocked_wheels(evidence: Evidence, robot: RobotModel) -> str:
    """When wheels turn while the robot, or one side of it, stays where it is, in words; empty where they do not."""
    found = wheels_without_motion(evidence.smoothed.motion, evidence.wheels, evidence.commands, robot)
    return "" if found is None else found.summary()


def windows_of(
    evidence: Evidence, robot: RobotModel, starts: np.ndarray, samples: np.ndarray, noisy: Sequence[MotionTrack]
) -> Windows:
    """The windows that begin at ``starts``, with what the noise of the poses and the map leave uncertain in each.

    Args:
        evidence: corrected for what the robot's file says of its sensors.
        robot: with the effects of its file.
        starts: ``[W]`` [ns].
        samples: times in a window at which residuals are computed [s], ``[K]``.
        noisy: the motion with other noise, from :func:`~monoforce_ros.discrepancy.gap.noisy_motions`.
    """
    data = evidence.cut(starts, samples)
    floor = noise_floor(evidence.smoothed.motion, noisy, data)
    return Windows(data, np.hypot(floor, terrain_uncertainty(robot, data, evidence.split_maps)))
