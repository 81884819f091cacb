"""Commissioning: the nominal model of a robot, from drives on which nothing is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from monoforce_ros.discrepancy.fit import Fit, described, fit_effects, flat, with_values
from monoforce_ros.discrepancy.gap import map_floor, noise_floor, noisy_motions, residual_scale
from monoforce_ros.discrepancy.hypothesis import Effects, Evidence, Predictions, window_starts
from monoforce_ros.discrepancy.preflight import complaints
from monoforce_ros.discrepancy.selection import blocks_of
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel

COMMISSIONED: Effects = tuple(
    (effect.name, dict(effect.commissioning_start)) for effect in CATALOGUE.values() if effect.commissioning_start
)
"""What every new robot needs, and where its fit starts."""


def commission(
    drives: Sequence[Evidence],
    robot: RobotModel,
    *,
    samples: Sequence[float] = (0.5, 1.0, 1.5, 2.0),
    stride: float = 0.5,
    progress: Callable[[float, str], None] = lambda share, what: None,
) -> tuple[list[dict], np.ndarray]:
    """Fit friction, effective track width and servo response to drives of a healthy robot.

    Args:
        drives: of the healthy robot.
        robot: the model as shipped.
        samples: times in a window at which residuals are taken [s].
        stride: between windows [s].
        progress: called with the share of the work done and what comes next.

    Returns:
        the effects as in a report, and what still disagrees, root mean square ``[K, 3]`` at ``samples`` beyond the
        noise of the poses.

    Raises:
        ValueError: a drive cannot tell; the message says why.
    """
    times = np.array(samples)
    fits: list[Fit] = []
    prepared = []
    for number, drive in enumerate(drives):
        progress(number / len(drives), "commissioning")
        smoothed = drive.smoothed
        starts = window_starts(smoothed.motion, smoothed.stretches, samples[-1], stride)
        found = complaints(smoothed, drive.commands, starts)
        if found:
            raise ValueError("; ".join(found))
        data = drive.cut(starts, times)
        predictions = Predictions(robot, data)
        floor = np.hypot(
            noise_floor(smoothed.motion, noisy_motions(smoothed), data), map_floor(robot, data, drive.halves)
        )
        # Blocks say something on their own, windows within them hardly: what is believed beforehand counts as a block.
        prior = 1.0 / len(np.unique(blocks_of(starts)))
        scale = residual_scale(floor, None)
        fits.append(fit_effects(predictions, [COMMISSIONED], scale, iterations=12, prior=prior))
        prepared.append((predictions, floor))
    values = np.median([flat(fit.effects) for fit in fits], axis=0)
    merged = replace(fits[0], effects=with_values(fits[0].effects, values))
    squares = []
    for predictions, floor in prepared:
        # With the values that the file will hold, not with each drive's own.
        left = np.nan_to_num(predictions.residuals([merged.effects])[0])
        # Robust: a window in which the robot was pushed says nothing of the model.
        spread = np.quantile(np.abs(left), 0.68, axis=0)
        squares.append(np.maximum(spread**2 - floor**2, 0.0))
    progress(1.0, "done")
    return described(merged, {}), np.sqrt(np.mean(squares, axis=0))
