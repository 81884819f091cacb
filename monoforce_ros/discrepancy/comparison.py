"""Comparison: errors at every horizon without and with the identified effects.

Each window is predicted with what was found and fitted without it (:mod:`repetition`), or, in a recording too short
for that, with parameters fitted to the other fold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.core import MotionTrack
from monoforce_ros.discrepancy.evidence import MOTION, Evidence, EvidenceWindows
from monoforce_ros.discrepancy.gap import find_regimes, noise_residuals, relative_motion
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, residuals_by_part
from monoforce_ros.discrepancy.left_out_stretches import LeftOut, overlapping
from monoforce_ros.discrepancy.trial import BLOCK, blocks_of
from monoforce_ros.robots import RobotModel

HORIZONS = (1.0, 2.0, 5.0)
"""At which errors are reported [s]: half and whole of the windows to which effects are fitted, and beyond them, where
only the effects' form predicts. Those of 5 s decide nothing (:data:`JUDGED`)."""
ABOVE_NOISE = 2.0
"""An error counts if it is at least so many times the noise floor: the noise is then the smaller part of it."""
FEWEST_WINDOWS = 6
"""At one horizon: windows begin a second apart, so that six of 2 s are three which do not overlap; fewer are one
manoeuvre."""
_METRICS = (("position", "m"), ("heading", "deg"), ("lean", "deg"), ("height", "m"))
"""Errors and their units; the last two where the ground is known."""


@dataclass(frozen=True)
class HeldOut:
    """Effects by part of a recording, each found or fitted without the part that it predicts."""

    effects: tuple[Effects, ...]
    first: int
    """Start of the first block [ns]."""
    block: float = BLOCK
    """Length of the blocks, which take turns in belonging to each part [s]."""

    @classmethod
    def everywhere(cls, effects: Effects) -> HeldOut:
        """One part: effects of another recording."""
        return cls((effects,), 0)

    def beside(self, others: Effects) -> HeldOut:
        """The same, with further effects in each part that has any."""
        return replace(self, effects=tuple((*effects, *others) if effects else () for effects in self.effects))

    def part_of(self, stamps: np.ndarray) -> np.ndarray:
        """Number of the part in which each stamp [ns] lies."""
        return ((stamps - self.first) // round(self.block * 1e9)).astype(int) % len(self.effects)

    def judged(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Windows that end in their part, or just behind it: the next block belongs to another one."""
        if len(self.effects) == 1:
            return starts
        starts = starts[starts >= self.first]
        into = ((starts - self.first) % round(self.block * 1e9)) * 1e-9
        return starts[into + horizon <= self.block + 0.5]

    def residuals(self, robot: RobotModel, windows: EvidenceWindows) -> np.ndarray:
        """Residuals ``[W, K, C]`` of each window with the effects of its part."""
        return residuals_by_part(robot, windows, self.part_of(windows.starts), self.effects)


@dataclass(frozen=True)
class Comparison:
    """Residuals of windows at one horizon."""

    horizon: float
    """[s]."""
    starts: np.ndarray
    """``[W]`` [ns]."""
    before: np.ndarray
    """By the nominal model, ``[W, C]``."""
    after: np.ndarray | None
    """With the identified effects; None where none was added to the model."""
    floor: np.ndarray
    """Due to pose noise alone, ``[any, C]``."""
    data: EvidenceWindows

    def errors(self, metric: str, which: np.ndarray) -> np.ndarray:
        """Errors by residuals ``[..., C]``: ``position``, ``height`` [m], ``heading``, ``lean`` [deg]."""
        if metric == "position":
            return np.hypot(which[..., 0], which[..., 1])
        if metric == "lean":
            return np.degrees(np.hypot(which[..., 3], which[..., 4]))
        return np.abs(which[..., 5]) if metric == "height" else np.degrees(np.abs(which[..., 2]))


@dataclass(frozen=True)
class GapRow:
    """Median error of one metric at one horizon; ``after`` and the gain are None where no effect was added."""

    horizon: float
    """[s]; 0 for a comparison of sensors."""
    before: float
    after: float | None
    gain_low: float | None
    """95 % confidence interval of the mean gain, by a bootstrap over blocks."""
    gain_high: float | None
    unit: str
    noise: float
    """Median error due to pose noise alone; of headings the difference of poses and gyro, if that is larger."""
    closed: float | None = None
    """Share of the reducible gap, the error above the noise, that is closed."""


@dataclass(frozen=True)
class RegimeRow:
    """Median errors in one motion regime; those after are None where no effect was added."""

    regime: str
    share_of_time: float
    position_before: float
    """[m]."""
    position_after: float | None
    heading_before: float
    """[deg]."""
    heading_after: float | None


@dataclass(frozen=True)
class PathComparison:
    """A measured path and its predictions, ``[K, 3]`` along, across [m], heading [rad] in the frame of its start."""

    start: float
    """Since the start of the recording [s]."""
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray | None


def compare(
    robot: RobotModel,
    data: EvidenceWindows,
    evidence: Evidence,
    left_out: LeftOut,
    held_out: HeldOut | None,
    noisy: Sequence[MotionTrack],
    acting_in: Callable[[EvidenceWindows], np.ndarray] | None = None,
) -> list[Comparison]:
    """Residuals at 1, 2 and 5 s without and with the identified effects.

    Args:
        robot: the nominal model.
        data: the recording.
        evidence: the whole of it.
        left_out: stretches of it that cannot be compared.
        held_out: the effects that predict each window, or None.
        noisy: the motion with other noise, from :func:`noisy_motions`.
        acting_in: mask of those windows in which the effects act, ``[W]``; None for all.
    """
    results = []
    for horizon in HORIZONS:
        starts = left_out.starts(evidence, horizon)
        if held_out is not None:
            starts = held_out.judged(starts, horizon)
        windows = replace(data, starts=starts, horizon=horizon, samples=np.array([horizon]))
        if acting_in is not None and len(starts):
            windows = replace(windows, starts=starts[acting_in(windows)])
        if len(windows.starts) < FEWEST_WINDOWS:
            continue
        floor = noise_residuals(data.motion, noisy, windows)
        predictions = Predictions(robot, windows)
        before = predictions.residuals([()])[0][:, 0]
        after = None if held_out is None else held_out.residuals(robot, windows)[:, 0]
        results.append(Comparison(windows.horizon, windows.starts, before, after, floor[:, 0], windows))
    return results


def gap_table(
    comparisons: Sequence[Comparison], seed: int = 0, heading_noise: Mapping[float, float] | None = None
) -> dict[str, GapRow]:
    """By metric and horizon, such as ``position_2s``: median errors, noise, and the confidence interval of the gain.

    Args:
        comparisons: by horizon.
        seed: of the bootstrap.
        heading_noise: what the gyro shows of the error of the poses' headings, by horizon [deg].
    """
    random = np.random.default_rng(seed)
    table: dict[str, GapRow] = {}
    for found in comparisons:
        for metric, unit in _METRICS if found.data.with_attitude else _METRICS[:2]:
            before = found.errors(metric, found.before)
            noise = float(np.median(found.errors(metric, found.floor)))
            if metric == "heading":
                noise = max(noise, (heading_noise or {}).get(found.horizon, 0.0))
            row = GapRow(found.horizon, float(np.median(before)), None, None, None, unit, noise)
            blocks = blocks_of(found.starts)
            numbers = np.unique(blocks)
            picks = random.integers(0, len(numbers), (1000, len(numbers)))
            if found.after is not None:
                after = found.errors(metric, found.after)
                gains = [before[blocks == b] - after[blocks == b] for b in numbers]
                sums = np.array([[gain.sum(), len(gain)] for gain in gains])
                resampled = sums[picks, 0].sum(axis=1) / sums[picks, 1].sum(axis=1)
                row = replace(
                    row,
                    after=float(np.median(after)),
                    gain_low=float(np.quantile(resampled, 0.025)),
                    gain_high=float(np.quantile(resampled, 0.975)),
                    closed=_closed(row.before, float(np.median(after)), noise),
                )
            table[f"{metric}_{found.horizon:g}s"] = row
    return table


def _closed(before: float, after: float, noise: float) -> float | None:
    """Closed share of the reducible gap; None if the gap is not reducible."""
    reducible = before - noise
    return float(np.clip((before - after) / reducible, -1.0, 1.0)) if reducible > 0 else None


JUDGED = 2.0
"""Longest horizon at which effects are judged [s]: that of the windows to which they are fitted."""


def improves(gap: Mapping[str, GapRow]) -> bool:
    """Whether errors at 1 or 2 s get smaller beyond chance in any metric."""
    return any(
        row.gain_low is not None and row.gain_low > 0 for metric, row in gap.items() if metric.endswith(("_1s", "_2s"))
    )


def gets_worse(gap: Mapping[str, GapRow]) -> bool:
    """Whether an error at 2 s, or at the longest shorter time, gets larger beyond chance and none smaller."""
    rows = [row for row in gap.values() if row.gain_low is not None and 0 < row.horizon <= JUDGED]
    longest = max((row.horizon for row in rows), default=0.0)
    gains = [(row.gain_low or 0.0, row.gain_high or 0.0) for row in rows if row.horizon == longest]
    return any(high < 0 for _, high in gains) and not any(low > 0 for low, _ in gains)


def regime_table(comparison: Comparison) -> list[RegimeRow]:
    """Median errors at one horizon in the whole recording and in each motion regime."""
    rows = []
    everything = {"the whole recording": np.ones(len(comparison.starts), bool)}
    for regime, mask in {**everything, **find_regimes(comparison.data)}.items():
        if mask.sum() < 3:
            continue

        def median(metric: str, values: np.ndarray, mask: np.ndarray = mask) -> float:
            return float(np.median(comparison.errors(metric, values[mask])))

        after = comparison.after
        rows.append(
            RegimeRow(
                regime=regime,
                share_of_time=float(mask.mean()),
                position_before=median("position", comparison.before),
                position_after=None if after is None else median("position", after),
                heading_before=median("heading", comparison.before),
                heading_after=None if after is None else median("heading", after),
            )
        )
    return rows


def measured_paths(
    robot: RobotModel,
    data: EvidenceWindows,
    evidence: Evidence,
    left_out: LeftOut,
    held_out: HeldOut | None,
    count: int = 6,
) -> list[PathComparison]:
    """Predicted and measured paths of some windows with errors above the median, the largest error first.

    Args:
        robot: the nominal model.
        data: the recording.
        evidence: the whole of it; each path lies within a part without gaps.
        left_out: stretches of it that cannot be compared.
        held_out: the effects that predict each window, or None.
        count: largest number of paths.
    """
    horizon, stamps = 5.0, data.motion.stamps
    spans = np.array([(stamps[part.start], stamps[part.stop - 1]) for part in evidence.smoothed.stretches], np.int64)
    spans = spans.reshape(-1, 2)
    begins, ends = data.starts[:, None], data.starts[:, None] + round((horizon + 0.1) * 1e9)
    starts = data.starts[((begins >= spans[:, 0]) & (ends < spans[:, 1])).any(axis=1)]
    starts = starts[~overlapping(left_out.stretches, starts, horizon)]
    if held_out is not None:
        starts = held_out.judged(starts, horizon)
    if not len(starts):
        return []
    times = np.arange(0.25, horizon + 0.01, 0.25)
    windows = replace(data, starts=starts, horizon=horizon, samples=times, components=MOTION)
    measured = relative_motion(windows.motion, windows)
    predictions = Predictions(robot, windows)
    before = predictions.residuals([()])[0]
    after = None if held_out is None else held_out.residuals(robot, windows)
    order = np.argsort(np.hypot(before[:, -1, 0], before[:, -1, 1]))
    picked = order[np.unique(np.linspace(0.5 * len(order), len(order) - 1, count).astype(int))]
    return [
        PathComparison(
            start=float(starts[index] - data.motion.stamps[0]) * 1e-9,
            measured=measured[index],
            before=measured[index] + before[index],
            after=None if after is None else measured[index] + after[index],
        )
        for index in picked[::-1]
    ]
