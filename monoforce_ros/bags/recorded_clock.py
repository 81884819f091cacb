"""Clocks of a recording: time that the poses' stamps and the recorder do not share, and clocks that were set."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from monoforce_ros.core import NANOSECOND

_ANOTHER_CLOCK, _AROUND = 86_400 * 10**9, 60 * 10**9
"""Pause of the poses from which on the clock was set rather than the robot left alone [ns], and how far beyond the
poses of one clock other messages belong to it [ns]."""


def from_reception(received: Mapping[int, int]) -> Callable[[int], int] | None:
    """Time of the poses' clock from a time of reception [ns]; None where both are of one clock, or next to it.

    A simulation has its own time, and Twist has no stamp: received in 2026, the poses stamped from 0 on.

    Args:
        received: time of reception of each pose, by its stamp [ns].
    """
    pairs = np.array(list(received.items()), np.int64).reshape(-1, 2)
    if len(pairs) < 2 or abs(float(np.median(pairs[:, 1] - pairs[:, 0]))) < _ANOTHER_CLOCK:
        return None
    stamps, times = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))].T

    def translated(time: int) -> int:
        before = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        step = max(int(times[before + 1] - times[before]), 1)
        share = (time - int(times[before])) / step
        return int(stamps[before]) + round(share * int(stamps[before + 1] - stamps[before]))

    return translated


def longest_part(stamps: np.ndarray) -> tuple[int, int, str] | None:
    """Start and end of what belongs to the longest part of a recording whose clock was set forward [ns], and why.

    A computer without a battery for its clock starts in 1970, until the network tells it the time.

    Args:
        stamps: of the poses ``[n]`` [ns].

    Returns:
        None where no day or more is missing.
    """
    stamps = np.unique(stamps)
    breaks = np.flatnonzero(np.diff(stamps) > _ANOTHER_CLOCK)
    if not len(breaks):
        return None
    parts = np.split(stamps, breaks + 1)
    kept = max(parts, key=len)
    days = float(np.diff(stamps)[breaks].max()) * NANOSECOND / 86_400.0
    text = (
        f"the clock was set forward by {days:.0f} days during the recording: of {len(parts)} parts the longest is "
        f"used, {float(kept[-1] - kept[0]) * NANOSECOND:.0f} s; set the clock before recording (chrony)"
    )
    return int(kept[0]) - _AROUND, int(kept[-1]) + _AROUND, text
