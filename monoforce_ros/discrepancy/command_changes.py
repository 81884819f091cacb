"""Command changes: what a healthy robot does where commands change harder than it was commissioned with.

Limits of drives show in hard starts only: a motor with little torque follows a ramp and lags behind a step. A robot
that was commissioned with gentle commands is not known to follow hard ones, whether it is healthy or not. Its motion
there is uncertain by :data:`RESPONSE_TIME`, the time by which it may respond earlier or later than the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.discrepancy.evidence import MOTION, Evidence, EvidenceWindows, window_starts
from monoforce_ros.discrepancy.residual_model import BEFORE, STEP, window_commands

RESPONSE_TIME = 0.06
"""Of healthy robots whose commands change harder than in their commissioning drive [s], root mean square. Of 0.04 to
0.1 s that with the smallest spread of the loss between 16 such drives of the choosing set, 0.30 in its logarithm, where
it is 0.38 on the other 34 drives, and 0.73 without it (``benchmarks/platforms/uncovered_changes.py``)."""
_WITHIN = 0.2
"""Time in which commands change [s]: shorter than most drives need, so that a ramp differs from a step."""
_COVERED = 0.95
"""Quantile of the changes in the windows of a commissioning drive up to which they are covered."""
_WORTH_SAYING = 0.5
"""Share of windows beyond which a recording is said to be outside what commissioning covered: most of it."""


def largest_changes(data: EvidenceWindows) -> np.ndarray:
    """Largest changes of speed [m/s] and yaw rate [rad/s] in 0.2 s, shortly before a window or since, ``[W, K, 2]``."""
    return _largest(window_commands(data))[:, _columns(data)]


def covered_changes(recordings: Sequence[EvidenceWindows]) -> np.ndarray:
    """Changes of speed [m/s] and of yaw rate [rad/s] that the commissioning drives covered, ``[2]``."""
    return np.quantile(np.concatenate([largest_changes(data)[:, -1] for data in recordings]), _COVERED, axis=0)


def uncovered_residual(data: EvidenceWindows, covered: np.ndarray) -> np.ndarray:
    """RMS residual of a healthy robot by changes harder than covered, ``[W, K, C]``; none in those of the attitude.

    The robot is where it would be up to :data:`RESPONSE_TIME` earlier or later: along by the change of speed, in
    heading by that of the yaw rate, and by the yaw rate itself where the speed changes. A heading error grows over the
    distance into half of it across.

    Args:
        data: the windows.
        covered: result of :func:`covered_changes`.
    """
    commands, columns = window_commands(data), _columns(data)
    changes = _largest(commands)[:, columns]
    beyond = np.maximum(changes - covered, 0.0)
    share = beyond[..., 0] / np.maximum(changes[..., 0], 1e-9)
    speed, rate = np.moveaxis(np.abs(commands), -1, 0)
    rate = np.maximum.accumulate(rate, axis=1)[:, columns]
    first = round(BEFORE / STEP)
    distance = np.cumsum(speed[:, first:] * STEP, axis=1)[:, columns - first]
    along = RESPONSE_TIME * beyond[..., 0]
    heading = RESPONSE_TIME * np.hypot(beyond[..., 1], rate * share)
    result = np.zeros((*along.shape, len(data.components)))
    result[..., : len(MOTION)] = np.stack([along, 0.5 * distance * heading, heading], axis=-1)
    return result


def uncovered_doubt(evidence: Evidence, horizon: float, covered: np.ndarray | None) -> str:
    """That most of a recording is outside what commissioning covered, with what to do; empty where it is not.

    Args:
        evidence: of the recording.
        horizon: length of the windows [s].
        covered: result of :func:`covered_changes`; None if unknown.
    """
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, horizon, 1.0)
    if covered is None or not len(starts):
        return ""
    data = EvidenceWindows(smoothed.motion, evidence.commands, starts, horizon, np.array([horizon]))
    last = largest_changes(data)[:, -1]
    # A change that moves the robot by less than a centimetre or a third of a degree more is none.
    beyond = (RESPONSE_TIME * (last - covered) > np.array([0.01, np.radians(0.3)])).any(axis=1)
    if beyond.mean() <= _WORTH_SAYING:
        return ""
    speed, rate = np.quantile(last, _COVERED, axis=0)
    return (
        f"commands change by up to {speed:.1f} m/s and {rate:.1f} rad/s in {_WITHIN:g} s, but by {covered[0]:.1f} m/s "
        f"and {covered[1]:.1f} rad/s when the robot was commissioned: how fast the healthy robot follows them is not "
        "known; commission it with a recording of hard starts and stops, too (diagnose --commission BAG BAG)"
    )


def _largest(commands: np.ndarray) -> np.ndarray:
    """Largest changes in 0.2 s so far, ``[W, T, 2]``."""
    length = round(_WITHIN / STEP)
    changes = np.zeros_like(commands)
    changes[:, length:] = np.abs(commands[:, length:] - commands[:, :-length])
    return np.maximum.accumulate(changes, axis=1)


def _columns(data: EvidenceWindows) -> np.ndarray:
    """Columns of the commands at the times of the samples, ``[K]``."""
    return np.rint((data.samples + BEFORE) / STEP).astype(int)
