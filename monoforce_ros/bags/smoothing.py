"""Smoothing: noisy poses → consistent poses, velocities and yaw rates, and an estimate of the noise."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial.transform import Rotation

from monoforce_ros.bags.natural_spline import NaturalSplines
from monoforce_ros.core import NANOSECOND, MotionTrack

LARGEST_GAP = 1.0
"""Time between poses beyond which they are not smoothed together [s]."""
FASTEST = 15.0
"""Speed between neighbouring poses beyond which they are a jump of the localisation [m/s]."""
_PIECE, _PIECES = 400, 3
_EXPONENTS = (-9.0, 4.0)
"""Range of the decimal logarithm of the curvature weight [m² s³ or rad² s³ per squared residual]."""
SHORTEST = 8
"""Number of poses below which a stretch is not smoothed."""


@dataclass(frozen=True)
class SmoothedMotion:
    """Smoothed motion and the estimated noise of the recorded one."""

    motion: MotionTrack
    """At the recorded stamps; velocities are derivatives of the smoothed poses, in base axes."""
    position_noise: float
    """Standard deviation of each recorded coordinate about the smoothed path [m]."""
    rotation_noise: float
    """Standard deviation of the recorded rotation about each axis [rad]."""
    stretches: tuple[slice, ...]
    """Ranges of poses without gaps or jumps."""
    weights: np.ndarray | None = None
    """Curvature weight of each coordinate and angle in each stretch, ``[S, 6]``; NaN where nothing was smoothed."""


def smooth(
    motion: MotionTrack,
    *,
    position_noise: float | None = None,
    rotation_noise: float | None = None,
    like: SmoothedMotion | None = None,
) -> SmoothedMotion:
    """Smooth a recorded motion.

    A cubic smoothing spline over time (Reinsch 1967) is fitted to each coordinate and each angle. Its smoothness
    follows from the noise if given, else from cross-validation of every other pose against the curve through the rest,
    unless the motion is smoothed as much as a similar one.
    The yaw rate is that of the unwrapped heading and not of the path, so it is also valid when the robot reverses,
    stands or turns on the spot.

    Args:
        motion: recorded poses; velocities are ignored.
        position_noise: standard deviation of a recorded coordinate [m], if known.
        rotation_noise: standard deviation about an axis [rad], if known.
        like: a motion at the same stamps: its stretches and its curvature weights are used.

    Raises:
        ValueError: a given noise is negative, a pose is not finite, or ``like`` has other stamps.
    """
    for name, value in (("position noise", position_noise), ("rotation noise", rotation_noise)):
        if value is not None and not value >= 0.0:
            raise ValueError(f"{name}: got {value}, expected 0 or more, or None to estimate it")
    if not (np.isfinite(motion.positions).all() and np.isfinite(motion.quaternions).all()):
        raise ValueError("motion: some poses are not finite; remove them first")
    positions, angles = motion.positions.copy(), _angles(motion.quaternions)
    speeds, turns = np.zeros_like(positions), np.zeros_like(angles)
    if like is not None and not np.array_equal(like.motion.stamps, motion.stamps):
        raise ValueError(f"like: got {len(like.motion)} other stamps, expected the {len(motion)} of the motion")
    stretches = tuple(_stretches(motion)) if like is None else like.stretches
    given = np.full((len(stretches), 6), np.nan) if like is None or like.weights is None else like.weights
    used = np.full_like(given, np.nan)
    squares = [0.0, 0.0]
    freedom = [0.0, 0.0]
    for number, stretch in enumerate(stretches):
        times = (motion.stamps[stretch] - motion.stamps[stretch.start]) * NANOSECOND
        for kind, (values, rates, noise) in enumerate(
            ((positions, speeds, position_noise), (angles, turns, rotation_noise))
        ):
            for axis in range(3):
                place = number, 3 * kind + axis
                used[place], residual, degrees = _fit(
                    times, values[stretch, axis], rates[stretch, axis], noise, float(given[place])
                )
                squares[kind] += residual
                freedom[kind] += degrees
    rotations = Rotation.from_euler("ZYX", angles[:, ::-1])
    smoothed = replace(
        motion,
        positions=positions,
        quaternions=rotations.as_quat(),
        linear_velocities=rotations.inv().apply(speeds),
        angular_velocities=_body_rates(angles, turns),
    )
    found = [float(np.sqrt(s / f)) if f > 0 else 0.0 for s, f in zip(squares, freedom, strict=True)]
    return SmoothedMotion(smoothed, found[0], found[1], stretches, used)


def _angles(quaternions: np.ndarray) -> np.ndarray:
    """Roll, pitch and unwrapped yaw ``[n, 3]`` [rad]; ground robots stay far from a pitch of 90°."""
    yaw, pitch, roll = Rotation.from_quat(quaternions).as_euler("ZYX").T
    return np.stack([np.unwrap(roll), np.unwrap(pitch), np.unwrap(yaw)], axis=1)


def _body_rates(angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Angular velocity ``[n, 3]`` in base axes from roll, pitch and yaw and their rates."""
    roll, pitch, _ = angles.T
    roll_rate, pitch_rate, yaw_rate = rates.T
    return np.stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
        ],
        axis=1,
    )


def _stretches(motion: MotionTrack) -> list[slice]:
    if not len(motion):
        return []
    steps = np.diff(motion.stamps) * NANOSECOND
    moved = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
    # A jump must also exceed the noise: at 100 Hz, a centimetre of noise looks fast.
    broken = (steps > LARGEST_GAP) | ((moved > FASTEST * steps) & (moved > 0.5))
    edges = np.r_[0, np.flatnonzero(broken) + 1, len(motion)]
    return [slice(int(low), int(high)) for low, high in itertools.pairwise(edges)]


def _fit(
    times: np.ndarray, values: np.ndarray, rates: np.ndarray, noise: float | None, given: float
) -> tuple[float, float, float]:
    """Replace ``values`` by a smooth curve and ``rates`` by its slope.

    Args:
        times: of the values [s].
        values: replaced.
        rates: replaced.
        noise: standard deviation of the values, if known.
        given: curvature weight; NaN to find it.

    Returns:
        the curvature weight, the sum of the squared residuals, and their degrees of freedom.
    """
    if len(times) < SHORTEST:
        if len(times) > 1:
            rates[:] = np.gradient(values, times)
        return np.nan, 0.0, 0.0
    centred = values - values.mean()
    if np.abs(centred).max() < 1e-12:
        rates[:] = 0.0
        return np.nan, 0.0, 0.0
    if np.isfinite(given):
        weight = given
    else:
        weight = _penalty(times, centred) if noise is None else _with_noise(times, centred, noise)
    spline = make_smoothing_spline(times, centred, lam=weight)
    residuals = centred - spline(times)
    values[:] = values - residuals
    rates[:] = spline.derivative()(times)
    # A curve that partly follows the noise has residuals smaller than the noise, by its degrees of freedom.
    freedom = max(len(times) - _degrees(residuals), 0.25 * len(times))
    return weight, float((residuals**2).sum()), freedom


def _pieces(length: int) -> list[slice]:
    """Pieces of a stretch, spread over it: the curvature weight of all of it follows from them."""
    count = min(_PIECES, max(1, length // _PIECE))
    return [slice(start, start + _PIECE) for start in np.linspace(0, max(0, length - _PIECE), count).astype(int)]


def _penalty(times: np.ndarray, values: np.ndarray) -> float:
    """The curvature weight that best predicts left-out poses, from a few pieces of the stretch."""
    if len(times) < 2 * SHORTEST:
        return 1e-3
    halves = [
        (NaturalSplines(times[piece][kept]), values[piece][kept], times[piece][left], values[piece][left])
        for piece in _pieces(len(times))
        for kept, left in ((slice(0, None, 2), slice(1, -1, 2)), (slice(1, None, 2), slice(2, -1, 2)))
    ]

    def error(exponent: float) -> float:
        return sum(
            float(((splines.between(measured, 10.0**exponent, at) - left) ** 2).sum())
            for splines, measured, at, left in halves
        )

    found = minimize_scalar(error, bounds=_EXPONENTS, method="bounded", options={"xatol": 0.1})
    return float(10.0**found.x)


def _with_noise(times: np.ndarray, values: np.ndarray, noise: float) -> float:
    """The curvature weight whose residuals have the given standard deviation, judged on a few pieces of the stretch."""
    pieces = [(NaturalSplines(times[piece]), values[piece]) for piece in _pieces(len(times))]

    def excess(exponent: float) -> float:
        left = [measured - splines.fitted(measured, 10.0**exponent)[0] for splines, measured in pieces]
        return float(np.std(np.concatenate(left)) - noise)

    low, high = _EXPONENTS
    if excess(low) >= 0.0:
        return float(10.0**low)
    if excess(high) <= 0.0:
        return float(10.0**high)
    return float(10.0 ** brentq(excess, low, high, xtol=0.05))


def _degrees(residuals: np.ndarray) -> float:
    """Degrees of freedom used by a smoothing spline, from the correlation of neighbouring residuals.

    A curve too stiff to follow white noise leaves uncorrelated residuals; one that follows it leaves alternating ones.
    The correlation of neighbours is about minus half the fraction of the degrees of freedom used.
    """
    spread = float((residuals**2).sum())
    if spread <= 0.0:
        return 0.0
    neighbours = float((residuals[1:] * residuals[:-1]).sum()) / spread
    return float(np.clip(-2.0 * neighbours, 0.0, 0.75)) * len(residuals)
