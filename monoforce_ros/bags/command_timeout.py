"""Command timeout: commands that a base no longer follows, because it stops when it hears no new ones."""

from __future__ import annotations

import numpy as np

from monoforce_ros.core import NANOSECOND, CommandTrack, MotionTrack

TIMEOUT = 0.5
"""Age at which a command expires [s]: the default of diff_drive_controller and of the node's ``command_timeout``."""
_LEAST_SILENCE = 2.0
"""Shortest silence of the commands that shows what a base does [s]."""
_STOPPING, _WATCHED = 1.5, 6.0
"""Time after the last command by which a base has stopped, and up to which it is watched [s]."""
_STOPPED = 0.2
"""Share of the commanded speed below which it has."""
_LEAST_SPEED = 0.1
"""Commands that say whether a base follows them [m/s, rad/s]."""
_AGREEING = 0.8
"""Share of the silences in which the base stopped, from which on it is a base with a timeout."""


def expired(commands: CommandTrack, motion: MotionTrack) -> tuple[CommandTrack, int]:
    """Commands with zeros after those that the base stopped following in silence.

    A base that holds its last command keeps it. Recorders of bases that publish a command only while a key is pressed
    leave silences in which the robot stands: held, the last command would move it on.

    Args:
        commands: as recorded.
        motion: measured poses.

    Returns:
        the commands, and how many expired; unchanged if the base does not stop in most silences.
    """
    if len(commands) < 2 or len(motion) < 2:
        return commands, 0
    ends = np.append(commands.stamps[1:], max(int(motion.stamps[-1]), int(commands.stamps[-1])))
    silence = (ends - commands.stamps) * NANOSECOND
    usual = float(np.median(silence[:-1]))
    moving = np.abs(commands.twists).max(axis=1) >= _LEAST_SPEED
    silent = np.flatnonzero(moving & (silence > max(_LEAST_SILENCE, 5.0 * usual)))
    shares = np.array([_share(motion, commands, int(i), int(ends[i])) for i in silent])
    known = np.isfinite(shares)
    if not known.any() or np.mean(shares[known] < _STOPPED) < _AGREEING:
        return commands, 0
    stamps = np.concatenate([commands.stamps, commands.stamps[silent] + round(TIMEOUT * 1e9)])
    twists = np.concatenate([commands.twists, np.zeros((len(silent), commands.twists.shape[1]))])
    order = np.argsort(stamps, kind="stable")
    return CommandTrack(stamps[order], twists[order]), len(silent)


def _share(motion: MotionTrack, commands: CommandTrack, index: int, end: int) -> float:
    """Measured over commanded motion in the silence after a command; NaN without poses there."""
    start = int(commands.stamps[index]) + round(_STOPPING * 1e9)
    stop = min(end, int(commands.stamps[index]) + round(_WATCHED * 1e9))
    first, last = np.searchsorted(motion.stamps, [start, stop])
    if last - first < 2:
        return float("nan")
    elapsed = float(motion.stamps[last - 1] - motion.stamps[first]) * NANOSECOND
    if elapsed < 0.3:
        return float("nan")
    speed = float(np.linalg.norm(motion.positions[last - 1, :2] - motion.positions[first, :2])) / elapsed
    headings = 2.0 * np.arctan2(motion.quaternions[first:last, 2], motion.quaternions[first:last, 3])
    turning = abs(float(np.unwrap(headings)[-1] - headings[0])) / elapsed
    asked = np.abs(commands.twists[index])
    if asked[0] >= asked[1]:
        return speed / float(asked[0])
    return turning / float(asked[1])
