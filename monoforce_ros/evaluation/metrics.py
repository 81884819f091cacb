"""Errors of predicted trajectories (paper eq. 5 and 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Poses:
    """A trajectory, or a batch of them, sampled at common times."""

    positions: np.ndarray
    """``[..., T, 3]`` [m]."""
    rotations: np.ndarray
    """``[..., T, 3, 3]``."""


def position_errors(predicted: Poses, measured: Poses) -> np.ndarray:
    """Distances ``[..., T]`` [m]: the terms of Δx."""
    return np.linalg.norm(predicted.positions - measured.positions, axis=-1)


def rotation_errors(predicted: Poses, measured: Poses) -> np.ndarray:
    """Angles ``[..., T]`` [deg]: the terms of ΔR."""
    relative = np.swapaxes(predicted.rotations, -1, -2) @ measured.rotations
    flat = relative.reshape(-1, 3, 3)
    finite = np.isfinite(flat).all(axis=(1, 2))
    angles = np.full(len(flat), np.nan)
    if finite.any():
        angles[finite] = np.degrees(Rotation.from_matrix(flat[finite]).magnitude())
    return angles.reshape(relative.shape[:-2])


@dataclass(frozen=True)
class Summary:
    """Statistics of an error over windows at one horizon."""

    windows: int
    median: float
    mean: float
    low: float
    """Lower end of the 95 % confidence interval of the mean."""
    high: float
    """Upper end."""
    mean_along: float
    """Mean over the trajectory up to the horizon and over windows: Δx or ΔR as the paper defines them."""


def summarise(errors: np.ndarray, usable: np.ndarray, index: int) -> Summary:
    """Statistics at time ``index`` of the errors ``[W, T]`` of windows that are ``usable`` ``[W, T]`` until then."""
    chosen = usable[:, : index + 1].all(axis=1) & np.isfinite(errors[:, : index + 1]).all(axis=1)
    values = errors[chosen, index]
    if not len(values):
        return Summary(0, *[float("nan")] * 5)
    low, high = bootstrap_interval(values)
    return Summary(
        windows=len(values),
        median=float(np.median(values)),
        mean=float(values.mean()),
        low=low,
        high=high,
        mean_along=float(errors[chosen, 1 : index + 1].mean()),
    )


def bootstrap_interval(values: np.ndarray, *, level: float = 0.95, block: int = 5) -> tuple[float, float]:
    """Confidence interval of the mean by a moving-block bootstrap, since consecutive windows overlap and correlate."""
    count = len(values)
    block = max(1, min(block, count // 3))
    generator = np.random.default_rng(0)
    starts = generator.integers(0, count - block + 1, size=(1000, -(-count // block)))
    index = (starts[..., None] + np.arange(block)).reshape(1000, -1)[:, :count]
    means = values[index].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
