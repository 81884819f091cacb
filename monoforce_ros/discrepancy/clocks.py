"""Clocks: the delay of the poses and the bias of the gyro, by comparing both yaw rates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, DelayCorrelation

_OUTLIER = 6.0
"""Median distances from the median: four standard deviations of normal noise."""
_STEP = 0.02
"""Between the delays that are tested [s]: below the time between poses of any odometry up to 50 Hz, which is the
finding's own resolution; the peak is interpolated."""
_LAGS = np.arange(-50, 81) * _STEP
"""Delays of the poses that are tested [s]."""
_PIECE = 8.0
"""Length of the pieces into which a recording is cut [s]."""
_APART, _LONGEST_GAP, _FEWEST_WINDOWS = 1.0, 0.2, 10
"""Time between windows in which headings are compared [s], longest one between measurements of the gyro inside of one
[s], and fewest of these windows."""
_WEAKEST = np.sqrt(0.5)
"""Smallest correlation of the two yaw rates for a conclusion: they share at least half of their variance."""
_LEAST_TURNING = 0.08
"""Smallest standard deviation of the yaw rate in a piece that is used for the delay [rad/s]: about ten times the
largest bias of a healthy gyro, so that the robot's turns and not the sensors' errors are correlated."""
_SCALES = np.arange(0.7, 1.301, 0.02)
"""Factors on the gyro's rate that are tried when headings are compared."""
_HEALTHY_BIAS = np.radians(0.5)
"""Largest bias of a healthy gyro [rad/s]: data sheets of robots' MEMS gyros allow 0.2 to 0.5 °/s after switching on."""


@dataclass(frozen=True)
class GyroFinding:
    """Result of comparing the yaw rate of the poses with the gyro."""

    offset: float
    """Stamps of the poses, recorded minus true [s]."""
    offset_half_width: float
    """Half-width of its 95 % confidence interval [s]."""
    bias: float
    """Of the gyro [rad/s]."""
    bias_half_width: float
    """Half-width of its 95 % confidence interval [rad/s]."""
    spread: float
    """Median absolute difference of the two yaw rates [rad/s]."""
    spread_without: float
    """The same without the bias [rad/s]."""
    correlation: float
    axis: int
    """Axis of the IMU that is vertical: 0, 1, 2 for x, y, z."""
    sign: int
    """-1 if that axis points down."""
    resolution: float = 0.0
    """Half the time between poses plus half that between gyro measurements [s]: a driver may stamp a measurement at the
    beginning, the middle or the end of its interval, so that a smaller offset is none of a clock."""

    @property
    def poses_late(self) -> bool:
        """Whether the offset is significant."""
        return abs(self.offset) > max(self.resolution, self.offset_half_width)

    def biased(self, known: float = 0.0) -> bool:
        """Whether the bias differs significantly from a known one [rad/s], by more than that of a healthy gyro."""
        return abs(self.bias - known) > max(_HEALTHY_BIAS, self.bias_half_width)


def compare_with_gyro(smoothed: SmoothedMotion, gyro: AngularVelocityTrack | None) -> GyroFinding | None:
    """Delay of the poses and bias of the gyro; None where the recording does not determine them.

    The vertical axis of the IMU and its sign are estimated too: mounts differ, and their description may be wrong.
    """
    if gyro is None or len(gyro) < 50:
        return None
    origin = int(smoothed.motion.stamps[0])
    clock = (gyro.stamps - origin) * 1e-9
    pieces = []
    for stretch in smoothed.stretches:
        stamps = (smoothed.motion.stamps[stretch] - origin) * 1e-9
        if len(stamps) < 20 or stamps[-1] - stamps[0] < 3.0:
            continue
        times = np.arange(stamps[0], stamps[-1], _STEP)
        rate = np.interp(times, stamps, smoothed.motion.angular_velocities[stretch, 2])
        count = max(1, round((times[-1] - times[0]) / _PIECE))
        pieces += list(zip(np.array_split(times, count), np.array_split(rate, count), strict=True))
    axes = [_correlated(pieces, clock, gyro.rates[:, axis]) for axis in range(3)]
    if not all(map(len, axes)):
        return None
    axis = int(np.argmax([np.abs(found.values).max() for found in axes]))
    found = axes[axis]
    peak = found.strongest
    correlation, sign = float(np.abs(found.values[peak])), int(np.sign(found.values[peak]))
    if correlation < _WEAKEST or not 0 < peak < len(_LAGS) - 1:
        return None
    # Jackknife over pieces: how much the delay depends on single turns.
    offset = found.peak(peak)
    count = len(found)
    left_out = found.peak_without_each(peak) if count > 2 else np.array([offset])
    spread = np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2))
    both = []
    for times, rate in pieces:
        measured, known = _gyro_rate(times - offset, clock, sign * gyro.rates[:, axis])
        if known.mean() > 0.5:
            both.append(np.stack([measured, rate])[:, known])
    if not both:
        # Too few measurements for their mean.
        return None
    # An IMU that leans measures a share of each turn: in laps one way round that looks like a bias.
    least, most = _scale_range(np.concatenate(both, axis=1))
    scale = float(np.sqrt(least * most))
    differences = [measured - scale * rate for measured, rate in both]
    everything = np.concatenate(differences)
    bias = float(np.median(everything))
    # Poses that follow quick turns late or by a part, and not slow ones, make a factor of both: none may be true, too.
    away = max(abs(end - scale) for end in (least, most, 1.0))
    by_scale = away * abs(float(np.median(np.concatenate([rate for _, rate in both]))))
    by_chance = _mean_half_width([float(np.median(piece)) for piece in differences])
    return GyroFinding(
        offset=float(offset),
        offset_half_width=float(max(1.96 * spread, 0.01)),
        bias=bias,
        bias_half_width=by_chance + by_scale,
        spread=float(np.median(np.abs(everything))),
        spread_without=float(np.median(np.abs(everything - bias))),
        correlation=correlation,
        axis=axis,
        sign=sign,
        resolution=0.5e-9 * float(np.median(np.diff(smoothed.motion.stamps)) + np.median(np.diff(gyro.stamps))),
    )


def heading_disagreement(
    smoothed: SmoothedMotion, gyro: AngularVelocityTrack, found: GyroFinding, horizon: float
) -> float | None:
    """By how much poses and gyro turn apart within ``horizon`` [s]: the median over windows [rad]; None without any.

    Delay and bias are corrected, and the factor on the gyro's rate is that of the best agreement, so that neither clock
    nor calibration counts. No model predicts headings better than the localisation that measured them: its lag may vary
    from turn to turn, which the scatter of its poses does not show.
    """
    clock, rates = (gyro.stamps - gyro.stamps[0]) * 1e-9, found.sign * gyro.rates[:, found.axis] - found.bias
    turned = cumulative_trapezoid(rates, clock, initial=0.0)
    apart, gaps = [], np.r_[0, np.cumsum(np.diff(clock) > _LONGEST_GAP)]
    motion = smoothed.motion
    for stretch in smoothed.stretches:
        times = (motion.stamps[stretch] - gyro.stamps[0]) * 1e-9
        starts = np.arange(times[0], times[-1] - horizon, _APART) if len(times) > 1 else np.zeros(0)
        yaw = np.unwrap(Rotation.from_quat(motion.quaternions[stretch]).as_euler("ZYX")[:, 0])
        ends = np.stack([starts, starts + horizon])
        poses = np.diff(np.interp(ends, times, yaw), axis=0)[0]
        place = np.searchsorted(clock, ends - found.offset)
        inside = (place > 0) & (place < len(clock))
        same = gaps[np.clip(place[0] - 1, 0, None)] == gaps[np.clip(place[1], 0, len(clock) - 1)]
        known = inside.all(axis=0) & same
        measured = np.diff(np.interp(ends - found.offset, clock, turned), axis=0)[0]
        apart.append(np.stack([poses, measured])[:, known])
    poses, measured = np.concatenate(apart, axis=1) if apart else np.zeros((2, 0))
    if len(poses) < _FEWEST_WINDOWS:
        return None
    return float(min(np.median(np.abs(poses - scale * measured)) for scale in _SCALES))


def _scale_range(rates: np.ndarray) -> tuple[float, float]:
    """Smallest and largest factor from the yaw rate of the poses to that of a gyro, from both, ``[2, N]`` [rad/s].

    Both are noisy: the factor lies between the slope of either's regression on the other (Frisch 1934). What is far
    from all others, such as a jump of the poses, does not count.
    """
    measured, rate = rates
    away = np.abs(measured - rate - np.median(measured - rate))
    measured, rate = rates[:, away <= _OUTLIER * max(float(np.median(away)), 1e-9)]
    (of_gyro, shared), (_, of_poses) = np.cov(measured, rate)
    if shared <= 0.0:
        return 1.0, 1.0
    return float(shared / of_poses), float(of_gyro / shared)


def _mean_half_width(values: list[float]) -> float:
    """Half-width of the 95 % interval of the mean, by Student's distribution; infinite for fewer than two values."""
    count = len(values)
    if count < 2:
        return float("inf")
    return float(student.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count))


def _gyro_rate(times: np.ndarray, clock: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gyro's rate at given times, and the mask of times with a measurement nearby."""
    place = np.clip(np.searchsorted(clock, times), 1, len(clock) - 1)
    near = np.minimum(np.abs(times - clock[place]), np.abs(times - clock[place - 1]))
    return np.interp(times, clock, rates), near < 0.1


def _correlated(pieces: list[tuple[np.ndarray, np.ndarray]], clock: np.ndarray, rates: np.ndarray) -> DelayCorrelation:
    """Correlation of both yaw rates over pieces in which the robot turns."""
    # The mean of the whole recording is subtracted: within a piece the robot may turn one way only.
    means = np.mean([rate.mean() for _, rate in pieces]) if pieces else 0.0, float(np.mean(rates))

    def delayed(times: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
        measured, known = _gyro_rate(times - lag, clock, rates)
        return measured - means[1], known

    turning = [(times, rate) for times, rate in pieces if rate.std() >= _LEAST_TURNING]
    return DelayCorrelation.of(
        ((rate - means[0], partial(delayed, times)) for times, rate in turning), _LAGS, fewest=20
    )
