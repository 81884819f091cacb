"""Nominal residual: whether a commissioned model is good enough to find anything with it."""

from __future__ import annotations

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.evidence import MOTION, EvidenceWindows, window_starts
from monoforce_ros.discrepancy.gap import relative_motion

LARGEST_SHARE = 0.1
"""Share of the motion in 2 s above which a nominal residual is reported: effects that change the motion by less than a
tenth are then within what is expected of the healthy robot."""


def residual_complaint(nominal_residual: np.ndarray | None, smoothed: SmoothedMotion, commands: CommandTrack) -> str:
    """Why a commissioned file hides effects, with what to do; empty where its residual is small.

    Args:
        nominal_residual: residual RMS of the healthy robot ``[K, C]``, the last row after 2 s [m, m, rad, …]; or None.
        smoothed: the motion of a recording, whose displacements and turns in 2 s are the measure.
        commands: its commands.
    """
    if nominal_residual is None:
        return ""
    starts = window_starts(smoothed.motion, smoothed.stretches, 2.0, 1.0)
    if not len(starts):
        return ""
    moved = relative_motion(smoothed.motion, EvidenceWindows(smoothed.motion, commands, starts, 2.0, np.array([2.0])))
    distance = float(np.sqrt(np.mean(moved[:, 0, 0] ** 2 + moved[:, 0, 1] ** 2)))
    turn = float(np.sqrt(np.mean(moved[:, 0, 2] ** 2)))
    along, across, heading = nominal_residual[-1, : len(MOTION)]
    position = float(np.hypot(along, across))
    parts = []
    if position > LARGEST_SHARE * max(distance, 1e-9):
        parts.append(f"{100 * position:.0f} cm ({100 * position / max(distance, 1e-9):.0f} % of the way)")
    if heading > LARGEST_SHARE * max(turn, 1e-9):
        parts.append(f"{np.degrees(heading):.1f}° ({100 * heading / max(turn, 1e-9):.0f} % of the turns)")
    if not parts:
        return ""
    return (
        f"the commissioned model misses the healthy robot by {' and '.join(parts)} after 2 s: smaller changes cannot "
        "be found with it; commission again with several recordings on level, firm ground, or with a map of rough one"
    )
