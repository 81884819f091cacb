"""Comparable windows: those of a recording in which the model's motion can be compared with the measured one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.evidence import Evidence, subsampled, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Windows
from monoforce_ros.discrepancy.gap import noise_floor
from monoforce_ros.discrepancy.left_out_stretches import LeftOut, overlapping
from monoforce_ros.discrepancy.terrain_evidence import terrain_uncertainty
from monoforce_ros.discrepancy.trial import BLOCK
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Comparable:
    """Windows in which the model's motion can be compared."""

    starts: np.ndarray
    """``[W]`` [ns]."""
    remarks: tuple[str, ...]
    """In words what was left out for which reason."""
    left_out: LeftOut
    """Stretches that windows must not overlap."""
    blocked: str
    """When wheels turn while the robot, or one side of it, stays where it is; empty where they do not."""


def comparable_windows(evidence: Evidence, robot: RobotModel, settings: DiagnosisSettings) -> Comparable:
    """Windows of a recording in which the ground moves the robot as its commands ask."""
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, settings.horizon, settings.stride)
    left_out = LeftOut.of(evidence, robot)
    blocked = "" if left_out.spinning is None else left_out.spinning.summary()
    remarks = []
    if overlapping(left_out.undriven, starts, settings.horizon).any():
        remarks.append(
            f"{_seconds(left_out.undriven)} are left out in which the robot moved without commands (a joystick?)"
        )
    if overlapping(left_out.off_map, starts, settings.horizon).any():
        remarks.append(
            f"{_seconds(left_out.off_map)} are left out in which the robot was at the edge of the map or beyond it: "
            "give a larger map (--terrain)"
        )
    if blocked and len(starts) and len(evidence.commands):
        remarks.append(blocked + ("; this time is left out" if len(left_out.in_place) else ""))
    kept = ~overlapping(left_out.stretches, starts, settings.horizon)
    # Of what is left: a recording that is long beside its map would lose nearly all of it otherwise.
    starts = subsampled(starts[kept], BLOCK, settings.max_windows)
    return Comparable(starts, tuple(remarks), left_out, blocked)


def _seconds(stretches: np.ndarray) -> str:
    return f"{float(np.diff(stretches, axis=1).sum()) * 1e-9:.0f} s"


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
