"""Commissioning: the nominal model of a robot, fitted to recordings of the healthy robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.fit import Fit, estimate_effects, fit_effects, flat, with_values
from monoforce_ros.discrepancy.gap import map_floor, noise_floor, noisy_motions, residual_scale
from monoforce_ros.discrepancy.hypothesis import Effects, Evidence, Predictions, window_starts
from monoforce_ros.discrepancy.preflight import complaints
from monoforce_ros.discrepancy.selection import blocks_of
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel

COMMISSIONED: Effects = tuple(
    (effect.name, dict(effect.commissioning_start)) for effect in CATALOGUE.values() if effect.commissioning_start
)
"""Effects that every robot needs, with the values at which their fit starts."""


def commission(
    recordings: Sequence[Evidence],
    robot: RobotModel,
    *,
    samples: Sequence[float] = (0.5, 1.0, 1.5, 2.0),
    stride: float = 0.5,
    progress: Callable[[float, str], None] = lambda share, step: None,
) -> tuple[tuple[EffectEstimate, ...], np.ndarray]:
    """Fit friction, effective track width and servo response to recordings of a healthy robot.

    Args:
        recordings: recordings of the healthy robot.
        robot: the model as shipped.
        samples: times in a window at which residuals are computed [s].
        stride: time between windows [s].
        progress: called with the share of the work done and the next step.

    Returns:
        the effects, and the nominal residual RMS ``[K, 3]`` at ``samples`` beyond the noise of the poses [m, m, rad].

    Raises:
        ValueError: a recording is not sufficient; the message says why.
    """
    times = np.array(samples)
    fits: list[Fit] = []
    prepared = []
    for number, evidence in enumerate(recordings):
        progress(number / len(recordings), "commissioning")
        smoothed = evidence.smoothed
        starts = window_starts(smoothed.motion, smoothed.stretches, samples[-1], stride)
        found = complaints(smoothed, evidence.commands, starts)
        if found:
            raise ValueError("; ".join(found))
        data = evidence.cut(starts, times)
        predictions = Predictions(robot, data)
        floor = np.hypot(
            noise_floor(smoothed.motion, noisy_motions(smoothed), data), map_floor(robot, data, evidence.split_maps)
        )
        # Blocks are roughly independent, windows within a block are not: the prior weighs as much as one block.
        prior = 1.0 / len(np.unique(blocks_of(starts)))
        scale = residual_scale(floor, None)
        fits.append(fit_effects(predictions, [COMMISSIONED], scale, iterations=12, prior=prior))
        prepared.append((predictions, floor))
    values = np.median([flat(fit.effects) for fit in fits], axis=0)
    merged = replace(fits[0], effects=with_values(fits[0].effects, values))
    squares = []
    for predictions, floor in prepared:
        # With the values that go into the file, not with those of each recording.
        residuals = np.nan_to_num(predictions.residuals([merged.effects])[0])
        # Robust: single windows with a disturbance must not raise the nominal residual.
        spread = np.quantile(np.abs(residuals), 0.68, axis=0)
        squares.append(np.maximum(spread**2 - floor**2, 0.0))
    progress(1.0, "done")
    return estimate_effects(merged, {}), np.sqrt(np.mean(squares, axis=0))
