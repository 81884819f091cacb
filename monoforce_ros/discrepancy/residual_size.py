"""Residual size: how much larger residuals are than a healthy robot's, and how likely that is on a healthy drive.

Mean losses of two healthy drives differ because each is the mean over a few manoeuvres: by the standard errors of both,
which the blocks of this drive and the segments of the commissioning drive show. Beyond that drives differ by
``drive_spread`` of the thresholds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_distribution

from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import blocks_of


@dataclass(frozen=True)
class ResidualSize:
    """The size of residuals beside those of a healthy robot."""

    above: float
    """Logarithm of the ratio of the losses."""
    spread: float
    """Standard deviation of this logarithm on healthy drives."""
    p: float
    """p-value of a healthy drive as large."""


def residual_size(
    losses: np.ndarray, starts: np.ndarray, expected: float, healthy: NominalModel, thresholds: Thresholds
) -> ResidualSize:
    """The size of residuals beside an expected one; degrees of freedom by Satterthwaite (1946).

    Args:
        losses: of each window, ``[W]``.
        starts: of the windows, ``[W]``.
        expected: mean loss that is expected of them.
        healthy: the healthy robot, of at least two segments.
        thresholds: how much healthy drives differ.
    """
    blocks = len(np.unique(blocks_of(starts)))
    above = float(np.log(max(float(losses.mean()), 1e-9) / expected))
    learned = healthy.loss_spread / np.sqrt(healthy.segments)
    variances = np.square([thresholds.drive_spread, loss_error(losses, starts), learned])
    degrees = np.array([thresholds.calibration_degrees, max(blocks - 1, 1), healthy.segments - 1])
    total = max(float(variances.sum()), 1e-12)
    spread = float(np.sqrt(total))
    freedom = total**2 / max(float((variances**2 / degrees).sum()), 1e-24)
    return ResidualSize(above, spread, float(student_distribution.sf(above / spread, freedom)))


def drive_spread(healthy: NominalModel, thresholds: Thresholds) -> float:
    """Standard deviation of the logarithm of a healthy drive's mean loss about what commissioning learned.

    By how much drives differ, and by the standard error of the mean over the segments of commissioning.
    """
    return float(np.hypot(thresholds.drive_spread, healthy.loss_spread / np.sqrt(max(healthy.segments, 1))))


def loss_error(losses: np.ndarray, starts: np.ndarray) -> float:
    """Standard error of the logarithm of a mean loss, from blocks that count as independent (delta method).

    Where a few blocks hold most of a loss, another drive of the same robot may well have none of it.

    Args:
        losses: of each window, ``[W]``.
        starts: of the windows, ``[W]``.
    """
    blocks = blocks_of(starts)
    deviations = np.array([(losses[blocks == block] - losses.mean()).sum() for block in np.unique(blocks)])
    return relative_error(deviations, float(losses.sum()))


def relative_error(deviations: np.ndarray, total: float) -> float:
    """Standard error of a sum over independent blocks, relative to it, from their deviations from the mean."""
    count = len(deviations)
    return float(np.sqrt(count / max(count - 1, 1) * (deviations**2).sum()) / max(total, 1e-12))
