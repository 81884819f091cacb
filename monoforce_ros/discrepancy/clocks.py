"""Clocks: what an IMU's gyro says of the poses — whether they come late, and whether the gyro shows a rate at rest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, DelayCorrelation

_STEP = 0.02
_LAGS = np.arange(-50, 81) * _STEP
"""Delays of the poses that are tried [s]."""
_PIECE = 8.0
"""Length of the pieces of a drive that are asked one by one [s]."""
_WEAKEST = 0.75
"""Correlation of the two yaw rates below which nothing is concluded."""
_LEAST_TURNING = 0.08
"""Spread of the yaw rate that a piece needs to tell a delay [rad/s]."""
_SMALLEST_OFFSET, _SMALLEST_BIAS = 0.04, 0.008
"""Below these nothing is said [s, rad/s]."""


@dataclass(frozen=True)
class GyroFinding:
    """What the comparison of the poses' headings with the gyro shows."""

    offset: float
    """Stamps of the poses, recorded minus true [s]."""
    offset_half: float
    """Half of its 95 % interval [s]."""
    bias: float
    """Of the gyro [rad/s]."""
    bias_half: float
    spread: float
    """Median difference of the two yaw rates with the bias in it [rad/s], and without it."""
    spread_without: float
    correlation: float
    axis: int
    """Of the IMU that turns with the heading: 0, 1, 2 for x, y, z."""
    sign: int
    """-1 where that axis points down."""

    @property
    def poses_late(self) -> bool:
        """Whether the offset is one, beyond doubt."""
        return abs(self.offset) > max(_SMALLEST_OFFSET, self.offset_half)

    @property
    def biased(self) -> bool:
        """Whether the bias is one, beyond doubt."""
        return abs(self.bias) > max(_SMALLEST_BIAS, 1.5 * self.bias_half)


def compare_with_gyro(smoothed: SmoothedMotion, turning: AngularVelocityTrack | None) -> GyroFinding | None:
    """Delay of the poses and bias of the gyro; None where the drive does not tell.

    Which axis of the IMU is vertical, and whether it points up, is found too: mounts differ, and files are wrong.
    """
    if turning is None or len(turning) < 50:
        return None
    origin = int(smoothed.motion.stamps[0])
    clock = (turning.stamps - origin) * 1e-9
    pieces = []
    for stretch in smoothed.stretches:
        stamps = (smoothed.motion.stamps[stretch] - origin) * 1e-9
        if len(stamps) < 20 or stamps[-1] - stamps[0] < 3.0:
            continue
        times = np.arange(stamps[0], stamps[-1], _STEP)
        rate = np.interp(times, stamps, smoothed.motion.angular_velocities[stretch, 2])
        count = max(1, round((times[-1] - times[0]) / _PIECE))
        pieces += list(zip(np.array_split(times, count), np.array_split(rate, count), strict=True))
    axes = [_correlated(pieces, clock, turning.rates[:, axis]) for axis in range(3)]
    if not all(map(len, axes)):
        return None
    axis = int(np.argmax([np.abs(found.values).max() for found in axes]))
    found = axes[axis]
    peak = found.strongest
    correlation, sign = float(np.abs(found.values[peak])), int(np.sign(found.values[peak]))
    if correlation < _WEAKEST or not 0 < peak < len(_LAGS) - 1:
        return None
    # Leaving out one piece at a time: how far the delay hangs on single turns (jackknife).
    offset = found.peak(peak)
    count = len(found)
    left_out = found.peak_without_each(peak) if count > 2 else np.array([offset])
    spread = np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2))
    differences, medians = [], []
    for times, rate in pieces:
        shown, known = _shown(times - offset, clock, sign * turning.rates[:, axis])
        if known.mean() > 0.5:
            differences.append((shown - rate)[known])
            medians.append(float(np.median(differences[-1])))
    bias = float(np.median(np.concatenate(differences)))
    everything = np.concatenate(differences)
    return GyroFinding(
        offset=float(offset),
        offset_half=float(max(1.96 * spread, 0.01)),
        bias=bias,
        bias_half=float(1.96 * np.std(medians) / np.sqrt(max(1, len(medians)))) if len(medians) > 2 else 0.05,
        spread=float(np.median(np.abs(everything))),
        spread_without=float(np.median(np.abs(everything - bias))),
        correlation=correlation,
        axis=axis,
        sign=sign,
    )


def _shown(times: np.ndarray, clock: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gyro at times, and where it has anything to say there."""
    place = np.clip(np.searchsorted(clock, times), 1, len(clock) - 1)
    near = np.minimum(np.abs(times - clock[place]), np.abs(times - clock[place - 1]))
    return np.interp(times, clock, rates), near < 0.1


def _correlated(pieces: list, clock: np.ndarray, rates: np.ndarray) -> DelayCorrelation:
    """Correlation of both yaw rates over pieces that turn."""
    # About the mean of the whole recording: a piece may turn one way throughout.
    means = np.mean([rate.mean() for _, rate in pieces]) if pieces else 0.0, float(np.mean(rates))

    def delayed(times: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
        measured, known = _shown(times - lag, clock, rates)
        return measured - means[1], known

    turning = [(times, rate) for times, rate in pieces if rate.std() >= _LEAST_TURNING]
    return DelayCorrelation.of(
        ((rate - means[0], partial(delayed, times)) for times, rate in turning), _LAGS, fewest=20
    )
