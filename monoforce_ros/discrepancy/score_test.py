"""Score test: whether residuals contain a consistent change in given directions, with a null distribution of its own.

A direction is the change of all residuals that an effect would cause. Its coefficient is estimated by weighted least
squares after the directions of effects that are fitted already have been projected out. Blocks of the recording are
taken as independent, windows within a block are not: the coefficient's variance comes from the scores of the blocks
(White 1980; Liang and Zeger 1986), with degrees of freedom for the blocks that really inform it (Carter, Schnepel and
Steigerwald 2017). To it the variance is added with which the same coefficient varies on the healthy robot.

The significance of the strongest of many directions is judged by a bootstrap over blocks: the deviations of the scores
get random signs, the same for all directions (wild cluster bootstrap; Cameron, Gelbach and Miller 2008), once in their
own blocks and once with the residuals of blocks exchanged at random, for a direction of which a single block holds
nearly all has no deviation of its own. The smallest p-value of each draw gives the null distribution (Westfall and
Young 1993); of the two bootstraps the more cautious one counts. Nothing in it depends on the robot, the units
or the pose rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from monoforce_ros.discrepancy.evidence import MOTION

_RIDGE = 1e-6
"""Relative size of a ridge that keeps singular directions finite."""


@dataclass(frozen=True)
class Direction:
    """A change of the residuals whose coefficients are tested together."""

    name: str
    columns: np.ndarray
    """Change of the scaled residuals by a unit of each coefficient, ``[q, W, K, C]``."""
    variation: float = 0.0
    """RMS change in this direction on the healthy robot, in nominal units."""
    degrees: float = 0.0
    """Degrees of freedom with which ``variation`` was estimated; 0 if it is unknown."""


@dataclass(frozen=True)
class ScoreResult:
    """The test of one direction."""

    name: str
    coefficients: np.ndarray
    """``[q]``."""
    covariance: np.ndarray
    """Of the coefficients, healthy variation included, ``[q, q]``."""
    degrees: float
    """Of freedom."""
    p: float
    """p-value of this direction alone."""
    adjusted: float
    """p-value for the strongest of all directions that were tested together."""
    gain: float
    """Mean reduction of the loss by the coefficients, to first order."""
    excess: float = 0.0
    """Mean square change by a coefficient beyond what its own blocks explain, in squared nominal units."""


@dataclass(frozen=True)
class _Scores:
    """Block scores of one direction."""

    name: str
    information: np.ndarray
    """By block, ``[B, q, q]``."""
    inverse: np.ndarray
    """Of the sum, ``[q, q]``."""
    deviations: np.ndarray
    """Scores minus those expected from the estimate, ``[B, q]``."""
    estimate: np.ndarray
    """``[q]``."""
    nominal: np.ndarray
    """Covariance of the coefficients on the healthy robot, ``[q, q]``."""
    blocks: float
    """Number of blocks that inform the estimate."""
    nominal_degrees: float
    """Degrees of freedom of ``nominal``."""
    squares: np.ndarray
    """Mean squares and products of the changes in nominal units, ``[q, q]``."""
    crossed: np.ndarray
    """Deviations if the residuals of each block (second index) had occurred in each other one, ``[B, B, q]``."""
    transplanted: np.ndarray
    """Covariance of the estimate if residuals of blocks were exchanged at random, ``[q, q]``."""

    @property
    def count(self) -> int:
        """Number of blocks."""
        return len(self.information)

    def excess(self, covariance: np.ndarray) -> float:
        """Mean square change by a coefficient in nominal units, less that by the sampling part of a covariance."""
        sampling = covariance - self.nominal
        estimate = self.estimate
        return float(estimate @ self.squares @ estimate - np.trace(sampling @ self.squares)) / len(estimate)

    def smallest_p(self, signed: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """p-values ``[N]`` of drawn block scores ``[N, B, q]`` and drawn nominal coefficients ``[N, q]``."""
        estimates = signed.sum(axis=1) @ self.inverse
        drawn = signed - np.einsum("bpq,nq->nbp", self.information, estimates)
        return self.p_values(estimates + nominal, drawn)[0]

    def p_values(self, estimates: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """p-values ``[N]``, covariances ``[N, q, q]`` and degrees of freedom ``[N]``.

        Args:
            estimates: ``[N, q]``.
            deviations: ``[N, B, q]``.
        """
        q = self.inverse.shape[0]
        correction = self.blocks / max(self.blocks - q, 0.5)
        meat = np.einsum("nbp,nbq->npq", deviations, deviations)
        sampling = correction * self.inverse @ meat @ self.inverse
        # Where a few blocks hold all that a direction does, their own scores say little about chance.
        smaller = np.trace(sampling, axis1=1, axis2=2) < np.trace(self.transplanted)
        sampling = np.where(smaller[:, None, None], self.transplanted, sampling)
        blocks = np.where(smaller, float(self.count), self.blocks)
        total = sampling + self.nominal
        size = np.maximum(np.trace(total, axis1=1, axis2=2), 1e-30)
        inverse = np.linalg.inv(total + (_RIDGE * size)[:, None, None] * np.eye(q))
        statistic = np.einsum("np,npq,nq->n", estimates, inverse, estimates) / q
        share = np.clip(np.trace(inverse @ sampling, axis1=1, axis2=2) / q, 0.0, 1.0)
        degrees = 1.0 / (share**2 / np.maximum(blocks - q, 1.0) + (1.0 - share) ** 2 / max(self.nominal_degrees, 1.0))
        return f_distribution.sf(statistic, q, np.maximum(degrees, 1.0)), total, degrees


def motion_count(residuals: np.ndarray) -> int:
    """Number of residuals of the motion among ``[..., C]``: what means over residuals are taken over.

    Roll, pitch, height and their rates add to what the motion shows and do not dilute it.
    """
    return residuals[..., : len(MOTION)].size


def block_numbers(starts: np.ndarray, length: float) -> np.ndarray:
    """Number of the block of ``length`` [s] in which each window starts, ``[W]``."""
    return ((starts - starts[0]) // round(length * 1e9)).astype(int)


def score_tests(
    residuals: np.ndarray,
    weights: np.ndarray,
    blocks: np.ndarray,
    directions: Sequence[Direction],
    *,
    fitted: np.ndarray | None = None,
    metric: np.ndarray | float = 1.0,
    draws: int = 400,
    seed: int = 0,
) -> list[ScoreResult]:
    """Test every direction, and adjust the p-values for having tested all of them.

    Args:
        residuals: scaled, ``[W, K, C]``.
        weights: robust weights, ``[W, K, C]``.
        blocks: number of the block of each window, ``[W]``.
        directions: at least one; a direction without any change gets the p-value 1.
        fitted: changes by parameters that are fitted already, ``[p, W, K, C]``.
        metric: factor from the scale of the residuals to nominal units, which ``Direction.variation`` is given in.
        draws: of the null distribution.
        seed: of the draws.
    """
    numbers, index = np.unique(blocks, return_inverse=True)
    random = np.random.default_rng(seed)
    signs = random.choice((-1.0, 1.0), (draws, len(numbers)))
    exchanged = random.integers(0, len(numbers), (draws, len(numbers)))
    used = np.nan_to_num(residuals)
    known = np.zeros((0, used.size)) if fitted is None else np.nan_to_num(fitted).reshape(len(fitted), -1)
    smallest = np.ones((2, draws))
    found: list[_Scores | None] = []
    for direction in directions:
        scores = _scores(direction, used, weights, index, known, np.asarray(metric))
        found.append(scores)
        if scores is None:
            continue
        q = len(scores.estimate)
        nominal = random.standard_normal((draws, q)) @ np.linalg.cholesky(scores.nominal + 1e-12 * np.eye(q)).T
        own, foreign = scores.deviations, scores.crossed[np.arange(scores.count), exchanged]
        for number, drawn in enumerate((own, foreign)):
            values = scores.smallest_p(signs[:, :, None] * drawn, nominal)
            smallest[number] = np.minimum(smallest[number], values)
    results = []
    for direction, scores in zip(directions, found, strict=True):
        if scores is None:
            q = len(direction.columns)
            results.append(ScoreResult(direction.name, np.zeros(q), np.zeros((q, q)), 0.0, 1.0, 1.0, 0.0))
            continue
        p, covariance, degrees = scores.p_values(scores.estimate[None], scores.deviations[None])
        adjusted = float((1 + (smallest <= p[0]).sum(axis=1).max()) / (1 + draws))
        results.append(
            ScoreResult(
                direction.name,
                scores.estimate,
                covariance[0],
                float(degrees[0]),
                float(p[0]),
                max(adjusted, float(p[0])),
                0.5 * float(scores.estimate @ scores.information.sum(axis=0) @ scores.estimate) / motion_count(used),
                scores.excess(covariance[0]),
            )
        )
    return results


def variation(
    residuals: np.ndarray,
    weights: np.ndarray,
    segments: np.ndarray,
    columns: np.ndarray,
    metric: np.ndarray | float = 1.0,
) -> float | None:
    """RMS change by a direction's coefficients as they vary over the segments of a healthy recording, in nominal units.

    None if the recording does not show the direction in more than one segment.

    Args:
        residuals: scaled, ``[W, K, C]``.
        weights: robust weights, ``[W, K, C]``.
        segments: number of the segment of each window, ``[W]``.
        columns: ``[q, W, K, C]``.
        metric: factor from the scale of the residuals to nominal units.
    """
    _, index = np.unique(segments, return_inverse=True)
    if len(columns) > 1:
        # One at a time: a handful of segments does not determine several coefficients together.
        single = [variation(residuals, weights, segments, column[None], metric) for column in columns]
        return None if None in single else float(np.linalg.norm(np.array(single, float)))
    scores = _scores(
        Direction("", columns), np.nan_to_num(residuals), weights, index, np.zeros((0, residuals.size)), np.ones(())
    )
    if scores is None:
        return None
    flat = (np.nan_to_num(columns) * metric).reshape(len(columns), -1)
    squares = flat @ flat.T / motion_count(columns[0])
    total = scores.information.sum(axis=0)
    size = np.trace(total)
    shares, values = [], []
    for information, deviation in zip(scores.information, scores.deviations, strict=True):
        # A segment that hardly informs the coefficient must not yield an arbitrary one: it is drawn towards the whole.
        within = information + 0.1 * total / len(scores.information) + _RIDGE * size * np.eye(len(total))
        change = np.linalg.solve(within, deviation + information @ scores.estimate)
        shares.append(np.trace(information) / size)
        values.append(float(change @ squares @ change))
    return float(np.sqrt(np.average(values, weights=np.maximum(shares, 1e-9))))


def _scores(
    direction: Direction, residuals: np.ndarray, weights: np.ndarray, index: np.ndarray, known: np.ndarray,
    metric: np.ndarray,
) -> _Scores | None:  # fmt: skip
    columns = np.nan_to_num(direction.columns)
    q, weight = len(columns), weights.ravel()
    flat = columns.reshape(q, -1)
    if not flat.any():
        return None
    raw = flat.copy()
    if len(known):
        gram = (known * weight) @ known.T
        gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
        flat = flat - np.linalg.solve(gram, (known * weight) @ flat.T).T @ known
        if (flat**2 * weight).sum() < 1e-4 * (raw**2 * weight).sum():
            # The fitted parameters do all that this direction does.
            return None
    shaped = flat.reshape(q, len(index), -1)
    shaped_weight = weights.reshape(len(index), -1)
    target = (weights * residuals).reshape(len(index), -1)
    count = index.max() + 1
    by_window = np.einsum("pwk,wk,qwk->wpq", shaped, shaped_weight, shaped)
    pull = -np.einsum("pwk,wk->wp", shaped, target)
    information, scores = np.zeros((count, q, q)), np.zeros((count, q))
    np.add.at(information, index, by_window)
    np.add.at(scores, index, pull)
    total = information.sum(axis=0)
    inverse = np.linalg.inv(total + _RIDGE * np.trace(total) * np.eye(q))
    estimate = inverse @ scores.sum(axis=0)
    sizes = np.trace(information, axis1=1, axis2=2)
    informed = float(sizes.sum() ** 2 / (sizes**2).sum())
    if informed < q + 1.0:
        # Nothing is repeated: the motion that shows this direction occurred in one block only.
        return None
    # The part that fitted parameters do not do: whatever its shape, the healthy robot varies by about as much.
    scaled = (flat.reshape(columns.shape) * metric).reshape(q, -1)
    squares = scaled @ scaled.T / motion_count(columns[0])
    squares += _RIDGE * np.trace(squares) * np.eye(q)
    nominal = direction.variation**2 / q * np.linalg.inv(squares)
    deviations = scores - np.einsum("bpq,q->bp", information, estimate)
    around = target + shaped_weight * np.einsum("p,pwk->wk", estimate, shaped)
    crossed = _crossed_scores(shaped, around, index)
    transplanted = inverse @ (np.einsum("bcp,bcq->pq", crossed, crossed) / count) @ inverse
    return _Scores(
        direction.name, information, inverse, deviations, estimate, nominal, informed, direction.degrees,
        squares, crossed, transplanted,
    )  # fmt: skip


def _crossed_scores(columns: np.ndarray, residuals: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Scores of directions ``[q, W, N]`` of each block with the residuals ``[W, N]`` of each block, ``[B, B, q]``."""
    count = index.max() + 1
    place = np.arange(len(index)) - np.searchsorted(index, index)
    length = place.max() + 1
    rows = np.zeros((count, length, residuals.shape[1]))
    rows[index, place] = residuals
    shaped = np.zeros((len(columns), count, length, residuals.shape[1]))
    shaped[:, index, place] = columns
    return np.einsum("pbln,cln->bcp", shaped, rows, optimize=True)
