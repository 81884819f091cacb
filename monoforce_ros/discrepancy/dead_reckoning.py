"""Dead reckoning: what measured wheel speeds and yaw rates say of the motion, without any model of commands or contact.

Beside predictions from commands it shows how much of their error lies in the poses: a localisation that is late by
another time in each turn contradicts the wheels and the gyro by as much as it contradicts a perfect prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

from monoforce_ros.core import wrap_angle
from monoforce_ros.discrepancy.clocks import compare_with_gyro
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.gap import relative_motion
from monoforce_ros.discrepancy.wheel_motion import half_track
from monoforce_ros.robots import RobotModel

_STEP = 0.02
"""Time step of the integration [s]."""
_LONGEST_GAP = 0.3
"""Between measurements inside a window [s]; windows with a longer one are not reckoned."""
_DELAYS = (0.0, 0.3, 0.6)
"""Delays of the poses at which fits start [s]."""
_LATEST = 1.5
"""Largest delay of the poses [s]."""


@dataclass(frozen=True)
class MeasuredDrive:
    """Speed and yaw rate over time, as sensors measured them."""

    times: np.ndarray
    """``[n]`` [s] since the first."""
    origin: int
    """Stamp of the first [ns]."""
    speeds: np.ndarray
    """Mean of both sides' wheels, ``[n]`` [m/s]."""
    yaw_rates: np.ndarray
    """Of the gyro, else of the wheels, ``[n]`` [rad/s]."""

    @classmethod
    def of(cls, evidence: Evidence, robot: RobotModel) -> MeasuredDrive | None:
        """None without wheel speeds, or for steered robots, whose sides do not say how the robot turns."""
        wheels = evidence.wheels
        if wheels is None or len(wheels) < 50 or robot.wheel_radius is None or robot.steered is not None:
            return None
        origin = int(wheels.stamps[0])
        times = (wheels.stamps - origin) * 1e-9
        left, right = (wheels.speeds * robot.wheel_radius).T
        turning = (right - left) / (2.0 * half_track(robot))
        found = compare_with_gyro(evidence.smoothed, evidence.gyro)
        if found is not None and evidence.gyro is not None:
            clock = (evidence.gyro.stamps - origin) * 1e-9
            turning = np.interp(times, clock, found.sign * evidence.gyro.rates[:, found.axis] - found.bias)
        return cls(times, origin, 0.5 * (left + right), turning)

    def covers(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Whether windows lie within the measurements, without a gap, ``[W]``; before one the first speed holds."""
        first = (starts - self.origin) * 1e-9
        gaps = np.flatnonzero(np.diff(self.times) > _LONGEST_GAP)
        inside = (first >= self.times[0] - _LONGEST_GAP) & (first + horizon <= self.times[-1] + _LONGEST_GAP)
        for gap in gaps:
            inside &= (first + horizon <= self.times[gap] + _LONGEST_GAP) | (
                first >= self.times[gap + 1] - _LONGEST_GAP
            )
        return inside

    def reckoned(self, starts: np.ndarray, samples: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Displacement in the start's frame, ``[W, K, 3]`` [m, m, rad].

        Args:
            starts: of the windows ``[W]`` [ns].
            samples: times since the start ``[K]`` [s].
            values: gain of the speed, gain of the yaw rate, delay of the poses [s].
        """
        steps = np.arange(round(samples[-1] / _STEP) + 1) * _STEP
        times = ((starts - self.origin) * 1e-9)[:, None] - values[2] + steps
        heading = cumulative_trapezoid(values[1] * np.interp(times, self.times, self.yaw_rates), dx=_STEP, initial=0.0)
        speed = values[0] * np.interp(times, self.times, self.speeds)
        path = [cumulative_trapezoid(speed * turned(heading), dx=_STEP, initial=0.0) for turned in (np.cos, np.sin)]
        return np.stack([*path, heading], axis=-1)[:, np.rint(samples / _STEP).astype(int)]


def dead_reckoning_errors(
    evidence: Evidence, robot: RobotModel, starts: np.ndarray, samples: np.ndarray, folds: np.ndarray
) -> np.ndarray | None:
    """Position errors of dead reckoning at the end of each window, ``[W]`` [m].

    Two gains and the delay of the poses are fitted without the part of the recording on which they are tested.

    Args:
        evidence: the recording.
        robot: its wheels' radius and track.
        starts: of the windows ``[W]`` [ns].
        samples: times since the start ``[K]`` [s].
        folds: part of the recording in which each window lies ``[W]``.

    Returns:
        None without measured wheel speeds over all windows.
    """
    drive = MeasuredDrive.of(evidence, robot)
    if drive is None or not drive.covers(starts, float(samples[-1])).all() or len(set(folds.tolist())) < 2:
        return None
    measured = relative_motion(evidence.smoothed.motion, evidence.cut(starts, samples))[..., :3]
    scale = max(float(np.median(np.abs(measured[:, -1, :2]))), 0.05)

    def differences(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        return drive.reckoned(starts[chosen], samples, values) - measured[chosen]

    def residuals(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        found = differences(values, chosen)
        return np.concatenate([(found[..., :2] / scale).ravel(), wrap_angle(found[..., 2]).ravel()])

    errors = np.zeros(len(starts))
    for fold in np.unique(folds):
        fits = [
            least_squares(
                residuals, (1.0, 0.9, delay), bounds=((0.2, 0.1, 0.0), (2.0, 2.0, _LATEST)), loss="soft_l1",
                f_scale=0.2, diff_step=1e-3, args=(folds != fold,),
            )
            for delay in _DELAYS
        ]  # fmt: skip
        best = min(fits, key=lambda fit: fit.cost)
        errors[folds == fold] = np.hypot(*differences(best.x, folds == fold)[:, -1, :2].T)
    return errors
