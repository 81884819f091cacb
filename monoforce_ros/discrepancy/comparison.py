"""Comparison: errors before and after at every horizon, on windows that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.gap import find_regimes, noise_residuals, relative_motion
from monoforce_ros.discrepancy.hypothesis import Effects, EvidenceWindows, Predictions, window_starts
from monoforce_ros.discrepancy.selection import BLOCK, blocks_of, folds_of
from monoforce_ros.robots import RobotModel

HORIZONS = (1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Comparison:
    """Errors of windows at one horizon."""

    horizon: float
    starts: np.ndarray
    """``[W]`` [ns]."""
    before: np.ndarray
    """``[W, 3]`` [m, m, rad]."""
    after: np.ndarray | None
    floor: np.ndarray
    """Errors by the noise of the poses alone, ``[any, 3]``."""
    data: EvidenceWindows

    def errors(self, metric: str, which: np.ndarray) -> np.ndarray:
        """``position`` [m] or ``heading`` [deg] of residuals ``[..., 3]``."""
        if metric == "position":
            return np.hypot(which[..., 0], which[..., 1])
        return np.degrees(np.abs(which[..., 2]))


def compare(
    robot: RobotModel,
    data: EvidenceWindows,
    smoothed: SmoothedMotion,
    parts: Sequence[Effects] | None,
    noisy: Sequence[MotionTrack],
    *,
    within_blocks: bool = True,
) -> list[Comparison]:
    """Errors at 1, 2 and 5 s with and without what was found.

    Args:
        robot: the nominal model.
        data: the drive whose windows were cut into folds.
        smoothed: its motion and noise.
        parts: what was found with each fold left out, or None.
        noisy: the motion with other noise, of :func:`noisy_motions`.
        within_blocks: leave out windows that reach into a block that their fit saw.
    """
    prepared = []
    for horizon in HORIZONS:
        starts = window_starts(data.motion, smoothed.stretches, horizon, 1.0)
        if parts is not None and within_blocks:
            # Only windows that end before the next block begins: that one was seen by the fit.
            starts = starts[starts >= data.starts[0]]
            into = ((starts - data.starts[0]) % round(BLOCK * 1e9)) * 1e-9
            starts = starts[into + horizon <= BLOCK + 0.5]
        if len(starts) >= 6:
            prepared.append(replace(data, starts=starts, horizon=horizon, samples=np.array([horizon])))
    results = []
    for own in prepared:
        floor = noise_residuals(data.motion, noisy, own)
        rolled = Predictions(robot, own)
        before = rolled.residuals([()])[0][:, 0]
        after = None if parts is None else _held_out(rolled, data.starts[0], parts)[:, 0]
        results.append(Comparison(own.horizon, own.starts, before, after, floor[:, 0], own))
    return results


def _held_out(rolled: Predictions, first: int, parts: Sequence[Effects]) -> np.ndarray:
    """Residuals ``[W, K, 3]`` of each window by the effects that were found without its fold."""
    which = folds_of(np.r_[first, rolled.data.starts])[1:]
    return rolled.residuals(list(parts))[which, np.arange(len(which))]


def gap_table(comparisons: Sequence[Comparison], seed: int = 0) -> dict[str, dict]:
    """By metric and horizon: medians before and after, the mean gain's interval by whole blocks, and the noise."""
    random = np.random.default_rng(seed)
    table: dict[str, dict] = {}
    for found in comparisons:
        after = found.before if found.after is None else found.after
        for metric, unit in (("position", "m"), ("heading", "deg")):
            errors = [found.errors(metric, values) for values in (found.before, after)]
            blocks = blocks_of(found.starts)
            numbers = np.unique(blocks)
            picks = random.integers(0, len(numbers), (1000, len(numbers)))
            differences = [errors[0][blocks == b] - errors[1][blocks == b] for b in numbers]
            means = np.array([[d.sum(), len(d)] for d in differences])
            resampled = means[picks, 0].sum(axis=1) / means[picks, 1].sum(axis=1)
            noise = float(np.median(found.errors(metric, found.floor)))
            row = {
                "horizon_s": found.horizon,
                "before": float(np.median(errors[0])),
                "after": float(np.median(errors[1])),
                "low": float(np.quantile(resampled, 0.025)),
                "high": float(np.quantile(resampled, 0.975)),
                "unit": unit,
                "noise": noise,
            }
            reducible = row["before"] - noise
            if found.after is not None and reducible > 0:
                row["closed"] = float(np.clip((row["before"] - row["after"]) / reducible, -1.0, 1.0))
            table[f"{metric}_{found.horizon:g}s"] = row
    return table


def regime_table(comparison: Comparison) -> list[dict]:
    """Position and heading error at one horizon in each regime, before and after."""
    rows = []
    after = comparison.before if comparison.after is None else comparison.after
    everything = {"the whole drive": np.ones(len(comparison.starts), bool)}
    for regime, mask in {**everything, **find_regimes(comparison.data)}.items():
        if mask.sum() < 3:
            continue
        rows.append(
            {"regime": regime, "share_of_time": float(mask.mean())}
            | {
                f"{metric}_{when}": float(np.median(comparison.errors(metric, values[mask])))
                for metric in ("position", "heading")
                for when, values in (("before", comparison.before), ("after", after))
            }
        )
    return rows


def measured_paths(
    robot: RobotModel, data: EvidenceWindows, parts: Sequence[Effects] | None, count: int = 6
) -> list[dict]:
    """Predicted and measured paths of some windows, spread over those with the largest errors before.

    Returns:
        for each ``start_s``, and ``measured``, ``before``, ``after`` ``[K, 3]`` along, across [m], heading [rad] in the
        axes of the window's start.
    """
    horizon = 5.0
    into = ((data.starts - data.starts[0]) % round(BLOCK * 1e9)) * 1e-9
    last = data.motion.stamps[-1] - round((horizon + 0.1) * 1e9)
    starts = data.starts[(into + horizon <= BLOCK + 0.5) & (data.starts < last)]
    if not len(starts):
        return []
    own = replace(data, starts=starts, horizon=horizon, samples=np.arange(0.25, horizon + 0.01, 0.25))
    measured = relative_motion(own.motion, own)
    rolled = Predictions(robot, own)
    before = rolled.residuals([()])[0]
    after = None if parts is None else _held_out(rolled, data.starts[0], parts)
    order = np.argsort(np.hypot(before[:, -1, 0], before[:, -1, 1]))
    picked = order[np.unique(np.linspace(0.5 * len(order), len(order) - 1, count).astype(int))]
    return [
        {
            "start_s": float(starts[index] - data.starts[0]) * 1e-9,
            "measured": measured[index],
            "before": measured[index] + before[index],
            "after": None if after is None else measured[index] + after[index],
        }
        for index in picked[::-1]
    ]
