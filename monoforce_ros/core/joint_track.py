"""JointTrack: angles of joints over time, measured or commanded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monoforce_ros.core.tracks import NANOSECOND


@dataclass(frozen=True)
class JointTrack:
    """Angles of joints over time; drivers may publish some joints at a time."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], increasing."""
    names: tuple[str, ...]
    """Of the joints."""
    angles: np.ndarray
    """``[n, J]`` [rad]; NaN where a message does not contain a joint."""

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, stamps: np.ndarray, *, maximum_gap: float = 0.5) -> np.ndarray:
        """Interpolated angles at stamps ``[...]`` [ns].

        Args:
            stamps: times.
            maximum_gap: largest time to the nearest angle of a joint [s].

        Returns:
            ``[..., J]`` [rad]; NaN where a joint has no angle close enough.
        """
        stamps = np.asarray(stamps, np.int64)
        result = np.full((*stamps.shape, len(self.names)), np.nan)
        for joint in range(len(self.names)):
            known = np.isfinite(self.angles[:, joint])
            if not known.any():
                continue
            # Differences of stamps are exact, stamps as floating-point numbers are not.
            origin = int(self.stamps[0])
            times, wanted = (self.stamps[known] - origin) * NANOSECOND, (stamps - origin) * NANOSECOND
            after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
            gap = np.minimum(np.abs(times[after] - wanted), np.abs(times[np.maximum(after - 1, 0)] - wanted))
            values = np.interp(wanted, times, self.angles[known, joint])
            result[..., joint] = np.where(gap <= maximum_gap, values, np.nan)
        return result

    def held(self, stamps: np.ndarray) -> np.ndarray:
        """The last angles at or before stamps ``[...]`` [ns], as commands hold until the next; NaN before the first."""
        stamps = np.asarray(stamps, np.int64)
        result = np.full((*stamps.shape, len(self.names)), np.nan)
        for joint in range(len(self.names)):
            known = np.isfinite(self.angles[:, joint])
            if known.any():
                index = np.searchsorted(self.stamps[known], stamps, side="right") - 1
                values = self.angles[known, joint][np.maximum(index, 0)]
                result[..., joint] = np.where(index >= 0, values, np.nan)
        return result
