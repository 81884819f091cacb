"""Comparable windows: those of a recording in which the model's motion can be compared with the measured one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.evidence import Evidence, subsampled, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Windows
from monoforce_ros.discrepancy.gap import noise_floor
from monoforce_ros.discrepancy.terrain_evidence import off_map_stretches, terrain_uncertainty
from monoforce_ros.discrepancy.trial import BLOCK
from monoforce_ros.discrepancy.wheel_motion import WheelsWithoutMotion, undriven_stretches, wheels_without_motion
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Comparable:
    """Windows in which the model's motion can be compared."""

    starts: np.ndarray
    """``[W]`` [ns]."""
    left_out: tuple[str, ...]
    """In words what was left out for which reason."""
    stretches: np.ndarray
    """Start and end of each stretch that windows must not overlap, ``[n, 2]`` [ns]."""
    blocked: str
    """When wheels turn while the robot, or one side of it, stays where it is; empty where they do not."""


def comparable_windows(evidence: Evidence, robot: RobotModel, settings: DiagnosisSettings) -> Comparable:
    """Windows of a recording in which the ground moves the robot as its commands ask."""
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, settings.horizon, settings.stride)
    starts = subsampled(starts, BLOCK, settings.max_windows)
    undriven, in_place, off_map, spinning = _left_out(evidence, robot)
    blocked = "" if spinning is None else spinning.summary()
    remarks = []
    if _overlapping(undriven, starts, settings.horizon).any():
        remarks.append(f"{_seconds(undriven)} are left out in which the robot moved without commands (a joystick?)")
    if _overlapping(off_map, starts, settings.horizon).any():
        remarks.append(
            f"{_seconds(off_map)} are left out in which the robot was at the edge of the map or beyond it: give a "
            "larger map (--terrain)"
        )
    if blocked and len(starts) and len(evidence.commands):
        remarks.append(blocked + ("; this time is left out" if len(in_place) else ""))
    stretches = np.concatenate([undriven, in_place, off_map])
    left_out = _overlapping(stretches, starts, settings.horizon)
    return Comparable(starts[~left_out], tuple(remarks), stretches, blocked)


def not_comparable(evidence: Evidence, robot: RobotModel, starts: np.ndarray, horizon: float) -> np.ndarray:
    """Windows in which something else than ground and commands moves or holds the robot, or in which it is off the
    map, ``[W]`` bool."""
    return _overlapping(left_out_stretches(evidence, robot), starts, horizon)


def left_out_stretches(evidence: Evidence, robot: RobotModel) -> np.ndarray:
    """Start and end of each stretch in which something else moves or holds the robot, or in which it is off the map,
    ``[n, 2]`` int64 [ns]."""
    return np.concatenate(_left_out(evidence, robot)[:3])


def _overlapping(stretches: np.ndarray, starts: np.ndarray, horizon: float) -> np.ndarray:
    low, high = stretches.T
    return ((starts[:, None] < high) & (starts[:, None] + round(horizon * 1e9) > low)).any(axis=1)


def _seconds(stretches: np.ndarray) -> str:
    return f"{float(np.diff(stretches, axis=1).sum()) * 1e-9:.0f} s"


def _left_out(
    evidence: Evidence, robot: RobotModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, WheelsWithoutMotion | None]:
    """Stretches driven without commands, those in which all wheels turn in place, and those off the map, each
    ``[n, 2]`` [ns]; and when wheels turn in place."""
    motion, nothing = evidence.smoothed.motion, np.zeros((0, 2), np.int64)
    spinning = wheels_without_motion(motion, evidence.wheels, evidence.commands, robot)
    off_map = off_map_stretches(evidence, robot)
    if not len(evidence.commands):
        return nothing, nothing, off_map, spinning
    undriven = undriven_stretches(evidence.commands, evidence.wheels, motion, robot)
    if spinning is None or spinning.side != "both":
        return undriven, nothing, off_map, spinning
    return undriven, np.array(spinning.stretches, np.int64).reshape(-1, 2), off_map, spinning


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
