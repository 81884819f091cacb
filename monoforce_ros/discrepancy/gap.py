"""Gap: how far predictions are from the drive, how much of it is noise, and where it lives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion, smooth
from monoforce_ros.core import MotionTrack, motion_regimes, wrap_angle
from monoforce_ros.discrepancy.hypothesis import EvidenceWindows, Predictions, sample_motion
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_NOISE_DRAWS = 3
_KNOWN_SHAPE = 0.5
"""Of the ground's influence on the motion: on MuJoCo's hills predictions on the true heights are off by the rest."""
_SMALLEST = np.array([0.01, 0.01, np.radians(0.3)])
"""Residuals below this mean nothing however quiet the data [m, m, rad]."""


def noisy_motions(smoothed: SmoothedMotion, seed: int = 0) -> list[MotionTrack]:
    """The motion as it would have been found from poses with other noise of the same size.

    The smooth motion is taken for the truth, noise of the size that was taken out is put back, and it is smoothed once
    more.
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
        again = smooth(noisy, position_noise=smoothed.position_noise, rotation_noise=smoothed.rotation_noise)
        drawn.append(again.motion)
    return drawn


def noise_residuals(motion: MotionTrack, noisy: Sequence[MotionTrack], data: EvidenceWindows) -> np.ndarray:
    """Residuals that a perfect model would have by the noise of the poses alone, ``[draws W, K, 3]``.

    Args:
        motion: smooth.
        noisy: the same with other noise, of :func:`noisy_motions`.
        data: windows of it.
    """
    own = relative_motion(motion, data)
    return np.concatenate([relative_motion(other, data) - own for other in noisy])


def noise_floor(motion: MotionTrack, noisy: Sequence[MotionTrack], data: EvidenceWindows) -> np.ndarray:
    """Size of :func:`noise_residuals`, ``[K, 3]`` [m, m, rad]: two thirds are smaller, as of a standard deviation.

    Robust: where a localisation jumps, smoothing other noise gives another motion altogether.
    """
    return np.quantile(np.abs(noise_residuals(motion, noisy, data)), 0.683, axis=0)


def map_floor(robot: RobotModel, data: EvidenceWindows, halves: tuple[TerrainMap, TerrainMap] | None) -> np.ndarray:
    """What residuals have by the ground's shape, however right the robot's model is, ``[K, 3]`` [m, m, rad].

    Two parts: predictions on the maps of both halves of the sweeps differ by twice what the whole map's own noise does
    to them; and what hills do to the motion, the difference to predictions on level ground, counts as known to
    ``_KNOWN_SHAPE``, for a map has cells and tyres deform. Zero on level ground.
    """
    if data.terrain is None:
        return np.zeros((len(data.samples), 3))

    def spread(one: TerrainMap | None, other: TerrainMap | None) -> np.ndarray:
        moves = [
            np.nan_to_num(Predictions(robot, replace(data, terrain=ground)).residuals([()])[0])
            for ground in (one, other)
        ]
        # Robust: a window on which one map has a step under a wheel shall not excuse all others.
        return np.quantile(np.abs(moves[0] - moves[1]), 0.68, axis=0)

    shape = (1.0 - _KNOWN_SHAPE) * spread(data.terrain, None)
    return shape if halves is None else np.hypot(shape, 0.5 * spread(*halves))


def relative_motion(motion: MotionTrack, data: EvidenceWindows) -> np.ndarray:
    """Motion since the start of each window in the axes of its start, ``[W, K, 3]`` [m, m, rad]."""
    stamps = data.starts[:, None] + np.rint(np.r_[0.0, data.samples] * 1e9).astype(np.int64)
    positions, rotations, _, _ = sample_motion(motion, stamps)
    headings = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])
    turn = Rotation.from_euler("z", headings[:, 0, None]).as_matrix()
    moved = np.einsum("wji,wkj->wki", turn, positions[:, 1:] - positions[:, :1])
    turned = wrap_angle(headings[:, 1:] - headings[:, :1])
    return np.concatenate([moved[..., :2], turned[..., None]], axis=-1)


def residual_scale(floor: np.ndarray, nominal_residual: np.ndarray | None) -> np.ndarray:
    """Size of a residual that means nothing, ``[K, 3]``: noise, and what disagreed on the healthy robot already."""
    squares = floor**2 + _SMALLEST**2
    if nominal_residual is not None:
        squares = squares + nominal_residual**2
    return np.sqrt(squares)


def find_regimes(data: EvidenceWindows) -> dict[str, np.ndarray]:
    """Motion regimes, each with the mask ``[W]`` of its windows; a window may be in several."""
    count = round((data.horizon + 0.5) / 0.05)
    stamps = data.starts[:, None] + (np.arange(count) * 50_000_000 - 500_000_000)
    commanded = data.commands.sample(stamps)
    rotations = sample_motion(data.motion, stamps)[1]
    speed = np.abs(commanded[..., 0]).mean(axis=1)
    pitch = np.abs(rotations[..., 2, 0]).mean(axis=1)
    # A recording has its own fast windows, whatever the robot could do.
    fast = max(0.3, float(np.quantile(speed, 0.7)))
    masks = motion_regimes(commanded, fast) | {
        "on slopes steeper than 5°": pitch > np.sin(np.radians(5.0)),
        "in the first third of the recording": np.arange(len(speed)) < len(speed) / 3,
        "in the last third of the recording": np.arange(len(speed)) >= 2 * len(speed) / 3,
    }
    return {name: mask for name, mask in masks.items() if 3 <= mask.sum() < len(mask)}


def localise(
    residuals: np.ndarray, floor: np.ndarray, data: EvidenceWindows, regimes: dict[str, np.ndarray]
) -> list[dict]:
    """Where the disagreement lives: shares of the squared error over its floor by axis and regime, strongest first.

    Args:
        residuals: ``[W, K, 3]``.
        floor: ``[K, 3]``.
        data: the drive.
        regimes: of :func:`find_regimes`.
    """
    horizon = float(data.samples[-1])
    names = (("error along the way", "m"), ("error across the way", "m"), ("heading error", "rad"))
    squares = residuals[:, -1] ** 2
    scaled = squares.mean(axis=0) / (floor[-1] ** 2 + _SMALLEST**2)
    entries = []
    for axis, (name, unit) in enumerate(names):
        total = squares[:, axis].sum()
        if total <= 0 or scaled[axis] < 2.0:
            continue
        for regime, mask in regimes.items():
            share, time = float(squares[mask, axis].sum() / total), float(mask.mean())
            lift = share / max(time, 1e-9)
            entries.append(
                {
                    "axis": name,
                    "regime": regime,
                    "share_of_error": share,
                    "share_of_time": time,
                    "rms": float(np.sqrt(squares[mask, axis].mean())),
                    "bias": float(residuals[mask, -1, axis].mean()),
                    "unit": unit,
                    "weight": float(lift * share * min(scaled[axis], 100.0)),
                    "text": f"{100 * share:.0f} % of the {name} at {horizon:g} s arises in {100 * time:.0f} % of the "
                    f"time: {regime}",
                }
            )
    entries = [entry for entry in entries if entry["share_of_error"] > 1.25 * entry["share_of_time"]]
    return sorted(entries, key=lambda entry: -entry["weight"])[:8]
