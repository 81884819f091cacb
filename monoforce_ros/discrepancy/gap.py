"""Gap: prediction errors on a recording, their noise floor, and the regimes with the largest errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion, smooth
from monoforce_ros.core import MotionTrack, motion_regimes, wrap_angle
from monoforce_ros.discrepancy.attitude import vertical
from monoforce_ros.discrepancy.evidence import ATTITUDE, EvidenceWindows, rate_means, rate_stamps, sample_motion
from monoforce_ros.discrepancy.nominal import NominalModel, smallest_of

_NOISE_DRAWS = 3
"""Motions with other noise: three times 120 windows tell a root mean square within 4 %, one over √(2 · 360), or where
overlapping windows count half within 5 %."""
_ERRORS = (
    ("along-track error", "m"),
    ("cross-track error", "m"),
    ("heading error", "rad"),
    ("roll error", "rad"),
    ("pitch error", "rad"),
    ("height error", "m"),
    ("roll rate error", "rad/s"),
    ("pitch rate error", "rad/s"),
    ("climb rate error", "m/s"),
)
"""Names and units of the components of a residual."""


@dataclass(frozen=True)
class NoiseFloor:
    """Residuals due to noise alone at the end of a window."""

    horizon: float
    """[s]."""
    along: float
    """[m]."""
    across: float
    """[m]."""
    heading: float
    """[rad]."""


@dataclass(frozen=True)
class Localisation:
    """A motion regime whose share of one component's squared error exceeds its share of time."""

    axis: str
    regime: str
    horizon: float
    """[s]."""
    share_of_error: float
    """Of the squared error of the whole recording."""
    share_of_time: float
    rms: float
    bias: float
    """Mean of predicted minus measured."""
    unit: str
    weight: float
    """By which entries are ordered."""

    @property
    def text(self) -> str:
        """In one sentence."""
        return (
            f"{self.regime}: {100 * self.share_of_error:.0f} % of the squared {self.axis} after {self.horizon:g} s in "
            f"{100 * self.share_of_time:.0f} % of the time"
        )


def noisy_motions(smoothed: SmoothedMotion, seed: int = 0) -> list[MotionTrack]:
    """The motion as smoothed from other draws of the pose noise.

    The smoothed motion serves as truth; noise of the estimated size is added to it, and the result is smoothed again,
    as much as the recorded one was.
    """
    random = np.random.default_rng(seed)
    motion = smoothed.motion
    drawn = []
    for _ in range(_NOISE_DRAWS):
        noise = Rotation.from_rotvec(smoothed.rotation_noise * random.standard_normal((len(motion), 3)))
        noisy = replace(
            motion,
            positions=motion.positions + smoothed.position_noise * random.standard_normal(motion.positions.shape),
            quaternions=(Rotation.from_quat(motion.quaternions) * noise).as_quat(),
        )
        again = smooth(
            noisy,
            position_noise=smoothed.position_noise,
            rotation_noise=smoothed.rotation_noise,
            like=smoothed,
        )
        drawn.append(again.motion)
    return drawn


def noise_residuals(motion: MotionTrack, noisy: Sequence[MotionTrack], data: EvidenceWindows) -> np.ndarray:
    """Residuals of a perfect model due to pose noise alone, ``[draws W, K, C]``.

    Args:
        motion: smoothed.
        noisy: the same motion with other noise, from :func:`noisy_motions`.
        data: its windows.
    """
    reference = relative_motion(motion, data)
    return np.concatenate([relative_motion(other, data) - reference for other in noisy])


def noise_floor(motion: MotionTrack, noisy: Sequence[MotionTrack], data: EvidenceWindows) -> np.ndarray:
    """Size of :func:`noise_residuals`, ``[K, C]``: their 68 % quantile, a robust standard deviation.

    Where a localisation jumps, smoothing with other noise gives an entirely different motion.
    """
    return np.quantile(np.abs(noise_residuals(motion, noisy, data)), 0.683, axis=0)


def relative_motion(motion: MotionTrack, data: EvidenceWindows) -> np.ndarray:
    """Motion since the start of each window, in the frame of the start pose, ``[W, K, C]`` [m, m, rad].

    With attitude: roll and pitch themselves [rad], the height since the start [m], and how fast they change, as means
    [rad/s, m/s], too.
    """
    stamps = data.starts[:, None] + np.rint(np.r_[0.0, data.samples] * 1e9).astype(np.int64)
    positions, rotations, _, _ = sample_motion(motion, stamps)
    headings = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])
    turn = Rotation.from_euler("z", headings[:, 0, None]).as_matrix()
    moved = np.einsum("wji,wkj->wki", turn, positions[:, 1:] - positions[:, :1])
    turned = wrap_angle(headings[:, 1:] - headings[:, :1])
    parts = [moved[..., :2], turned[..., None]]
    if data.with_attitude:
        lean = vertical(rotations[:, 1:])
        parts += [lean[..., 1:], -lean[..., :1], moved[..., 2:]]
    if len(data.components) > len(ATTITUDE):
        _, rotations, linear, angular = sample_motion(motion, rate_stamps(data))
        climbing = np.einsum("wtj,wtj->wt", rotations[..., 2, :], linear)
        parts.append(rate_means(np.concatenate([angular[..., :2], climbing[..., None]], axis=-1), data.samples))
    return np.concatenate(parts, axis=-1)


def residual_scale(floor: np.ndarray, data: EvidenceWindows, nominal: NominalModel | None) -> np.ndarray:
    """Expected size of a residual by noise, map and the healthy robot's own error, like ``floor`` ``[..., K, C]``.

    With a nominal model it depends on the windows' commands, ``[W, K, C]``.
    """
    squares = floor**2 + smallest_of(floor) ** 2
    if nominal is not None:
        squares = squares + nominal.residual_in(data) ** 2
    return np.sqrt(squares)


def find_regimes(data: EvidenceWindows) -> dict[str, np.ndarray]:
    """Motion regimes, each with the mask ``[W]`` of its windows; a window may be in several."""
    count = round((data.horizon + 0.5) / 0.05)
    stamps = data.starts[:, None] + (np.arange(count) * 50_000_000 - 500_000_000)
    commanded = data.commands.sample(stamps)
    rotations = sample_motion(data.motion, stamps)[1]
    speed = np.abs(commanded[..., 0]).mean(axis=1)
    pitch = np.abs(rotations[..., 2, 0]).mean(axis=1)
    # "Fast" is relative to the recording, not to the top speed of the robot.
    fast = max(0.3, float(np.quantile(speed, 0.7)))
    masks = motion_regimes(commanded, fast) | {
        "on slopes steeper than 5°": pitch > np.sin(np.radians(5.0)),
        "in the first third of the recording": np.arange(len(speed)) < len(speed) / 3,
        "in the last third of the recording": np.arange(len(speed)) >= 2 * len(speed) / 3,
    }
    return {name: mask for name, mask in masks.items() if 3 <= mask.sum() < len(mask)}


def localise(
    residuals: np.ndarray, floor: np.ndarray, data: EvidenceWindows, regimes: dict[str, np.ndarray]
) -> tuple[Localisation, ...]:
    """Where errors above the floor are largest: shares of the squared error by component and motion regime.

    Args:
        residuals: ``[W, K, C]``.
        floor: ``[K, C]``.
        data: the windows.
        regimes: result of :func:`find_regimes`.

    Returns:
        the strongest entries, in order.
    """
    horizon = float(data.samples[-1])
    names = _ERRORS[: residuals.shape[-1]]
    squares = residuals[:, -1] ** 2
    scaled = squares.mean(axis=0) / (floor[-1] ** 2 + smallest_of(floor) ** 2)
    entries = []
    for axis, (name, unit) in enumerate(names):
        total = squares[:, axis].sum()
        if total <= 0 or scaled[axis] < 2.0:
            continue
        for regime, mask in regimes.items():
            share, time = float(squares[mask, axis].sum() / total), float(mask.mean())
            lift = share / max(time, 1e-9)
            entries.append(
                Localisation(
                    axis=name,
                    regime=regime,
                    horizon=horizon,
                    share_of_error=share,
                    share_of_time=time,
                    rms=float(np.sqrt(squares[mask, axis].mean())),
                    bias=float(residuals[mask, -1, axis].mean()),
                    unit=unit,
                    weight=float(lift * share * min(scaled[axis], 100.0)),
                )
            )
    entries = [entry for entry in entries if entry.share_of_error > 1.25 * entry.share_of_time]
    return tuple(sorted(entries, key=lambda entry: -entry.weight)[:8])
