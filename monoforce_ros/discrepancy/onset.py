"""Onset: the time at which an effect begins in the middle of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.discrepancy.evidence import EvidenceWindows
from monoforce_ros.discrepancy.fit import fit_effects, robust
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import BLOCK, Trial, paired

_FEWEST_BLOCKS = 2
"""Blocks before and after an onset: four half blocks on each side count as independent, and differences that all have
one sign do so by chance in one of sixteen cases with four of them."""


@dataclass(frozen=True)
class Onset:
    """A recording that is healthy before a time and has effects after it."""

    stamp: int
    """[ns]."""
    since_start: float
    """Since the start of the recording [s]."""
    losses: np.ndarray
    """Of each window, ``[W]``."""
    acting: np.ndarray
    """Windows after it, ``[W]`` bool."""
    place: None = None
    """They act everywhere."""

    def acting_in(self, data: EvidenceWindows) -> np.ndarray:
        """Windows of any length in which the effects act, ``[W]`` bool."""
        return data.starts >= self.stamp

    @property
    def remark(self) -> str:
        """When, in words."""
        return f"It begins {self.since_start:.0f} s after the start; these figures are of the time after that."


def find_onset(search: Search, trial: Trial) -> Onset | None:
    """The time from which effects act, if that explains a recording better than effects that always act.

    The effects are fitted to the last third of the recording. Before the onset the residuals with what sensors measured
    count, which always acts, after it those with the effects; the onset with the smallest loss is taken, and must gain
    beyond chance over blocks.

    Args:
        search: search on the whole recording.
        trial: effects that it found.
    """
    starts = search.data.starts
    begin = starts[0]
    length = float(starts[-1] - begin) * 1e-9
    edges = np.arange(_FEWEST_BLOCKS * BLOCK, length - (_FEWEST_BLOCKS - 0.5) * BLOCK, 0.25 * BLOCK)
    late = starts >= begin + round(length / 1.5 * 1e9)
    if not len(edges) or not trial.effects or late.sum() < 4:
        return None
    fixed = search.fixed_count(trial.effects)
    last = Predictions(search.robot, replace(search.data, starts=starts[late]))
    whole = search.refit(trial.effects).effects
    fit = fit_effects(last, [whole, trial.effects], search.scale[late], iterations=6, free=fixed)
    before, after = search.loss_of(search.known), search.loss_of(fit.effects)
    times = (starts - begin) * 1e-9
    # Half a window before the onset belongs to neither.
    losses = [float(np.where(times < edge - 0.5 * search.data.horizon, before, after).mean()) for edge in edges]
    edge = float(edges[int(np.argmin(losses))])
    combined = np.where(times < edge - 0.5 * search.data.horizon, before, after)
    always = robust(search.predictions.residuals([whole])[0] / search.scale)
    gain, low = paired(always, combined, starts, search.thresholds.comparison_rate)
    nominal_gain, nominal_low = paired(before, combined, starts, search.thresholds.comparison_rate)
    least = search.thresholds.smallest_share * float(before.mean())
    if low <= 0 or nominal_low <= 0 or min(gain, nominal_gain) < least:
        return None
    stamp = int(begin + round(edge * 1e9))
    since_start = float(stamp - search.data.motion.stamps[0]) * 1e-9
    return Onset(stamp, since_start, combined, starts >= stamp)
