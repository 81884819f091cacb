"""Trial: effects judged on held-out blocks of a recording, and the results of a search over them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from monoforce_ros.discrepancy.fit import robust
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.score_test import ScoreResult, block_numbers
from monoforce_ros.discrepancy.thresholds import Thresholds

HEALTHY_LOSS = 0.5
"""Robust loss of residuals as large as their scale: half the square of a standard deviation."""
FOLDS = 8
"""Parts that are held out in turn: each block of a recording of a minute. Half of a recording shows an effect in half
as many manoeuvres, and its values scatter twice as much."""
_OTHER_FOLDS = (7, 9, 11, 5)
"""Numbers of parts for long recordings of which only every so many blocks are used: of eight these would fill a few."""
_FILLED = 6
"""Parts that hold windows, at least."""
BLOCK = 8.0
"""Length of the blocks that are held out together [s]: longer than a window."""


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted and judged by their held-out loss."""

    effects: Effects
    """With the values fitted to the whole recording."""
    parts: tuple[Effects, ...]
    """Effects with the values that they have without each fold."""
    held_out_loss: np.ndarray
    """Loss of each window with the effects fitted without its fold, ``[W]``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(name for name, _ in self.effects)

    @property
    def loss(self) -> float:
        """Mean held-out loss."""
        return float(self.held_out_loss.mean())


@dataclass(frozen=True)
class CandidateScore:
    """The score of one candidate effect in one round of the search."""

    name: str
    round: int
    """From 1 on."""
    gain: float
    """Reduction of the loss: held out where ``judged``, else of the screening fit."""
    p: float
    """p-value of the effect, adjusted for all candidates of the round."""
    judged: bool
    """Whether the candidate was cross-validated."""


@dataclass(frozen=True)
class FitTest:
    """Whether what effects leave unexplained looks like a healthy robot."""

    p: float
    """Smallest adjusted p-value."""
    strongest: str
    """What the residuals contain most significantly."""
    tests: tuple[ScoreResult, ...] = ()
    explained: float = 1.0
    """Share of the excess loss, that above what a healthy robot may well have, which the effects explain; 1 without
    effects, and where a healthy robot's loss is unknown."""

    def passed(self, thresholds: Thresholds) -> bool:
        """Whether the effects are the explanation: they explain most, and the rest looks like a healthy robot's."""
        return self.p > thresholds.fit_rate and self.explained >= thresholds.explained_share


@dataclass(frozen=True)
class Outcome:
    """The result of a search."""

    nominal: Trial
    best: Trial
    """The nominal trial where no effect was added."""
    fit: FitTest
    """Of the best trial."""
    tried: tuple[CandidateScore, ...] = ()
    variance_ratio: float | None = None
    """See :class:`Search`; on healthy recordings its mean is ``drive_share`` of the thresholds."""
    indistinguishable: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """By selected effect: others that explain the recording about as well in its place."""


def excess_share(before: float, after: float, healthy: float, spread: float = 0.0) -> float:
    """Share of the loss above a healthy robot's that is gone afterwards, at most 1; all of it where there is none.

    Args:
        before: loss without the effects.
        after: loss with them.
        healthy: mean loss of the healthy robot.
        spread: standard deviation of its logarithm between drives. What a drive may well have by itself, the mean and
            one of these, is no excess that effects would have to explain.
    """
    usual = healthy * math.exp(spread)
    if before <= usual:
        return 1.0 if after <= usual else 0.0
    return min((before - after) / (before - usual), 1.0)


def expected_loss(healthy: float, change: np.ndarray, model_error: float) -> float:
    """Loss that is expected beside effects of the right kind: a healthy robot's, and that of their formula's error.

    Judged by the robust loss as the residuals are: of windows that an effect changes by fifty times a healthy error, an
    error's square would excuse nearly anything.

    Args:
        healthy: mean loss of the healthy robot.
        change: what the effects change, scaled, ``[W, K, C]``.
        model_error: error of a formula as a share of what it changes.
    """
    return healthy + float(robust(model_error * change).mean())


def folds_of(starts: np.ndarray, count: int) -> np.ndarray:
    """Fold of each window, of ``count``: blocks take turns."""
    return ((starts - starts[0]) // round(BLOCK * 1e9)).astype(int) % count


def fold_count(starts: np.ndarray) -> int:
    """Number of parts into which the blocks of windows are dealt: the first of several of which enough hold windows."""
    blocks = np.unique((starts - starts[0]) // round(BLOCK * 1e9))
    wanted = min(_FILLED, len(blocks))
    filled = {count: len(np.unique(blocks % count)) for count in (FOLDS, *_OTHER_FOLDS)}
    return next((count for count, parts in filled.items() if parts >= wanted), FOLDS)


def blocks_of(starts: np.ndarray) -> np.ndarray:
    """Number of the half block in which each window starts."""
    return block_numbers(starts, 0.5 * BLOCK)


def paired(
    before: np.ndarray, after: np.ndarray, starts: np.ndarray, rate: float, seed: int = 0
) -> tuple[float, float]:
    """Mean gain of a trial over another one, and its lower bound at a one-sided error rate (bootstrap over blocks)."""
    blocks = blocks_of(starts)
    numbers = np.unique(blocks)
    # Clipped, so that a few windows that no effect explains do not dominate.
    difference = np.clip(before - after, -50.0, 50.0)
    sums = np.array([difference[blocks == block].sum() for block in numbers]) / len(starts)
    picked = np.random.default_rng(seed).integers(0, len(sums), (2000, len(sums)))
    return float(sums.sum()), float(np.quantile(sums[picked].sum(axis=1), rate))
