"""Kept effects: those of a robot's file that commissioning does not fit, and whether its recordings still show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import wilcoxon

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.hypothesis import Predictions, corrected_evidence
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.trial import blocks_of
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel

_HORIZON = 2.0
"""At which errors with and without an effect are compared [s]: that of a diagnosis' windows."""
_FEWEST_BLOCKS = 6
"""Blocks with a difference below which no ranks are improbable enough: five on one side are so by chance in 3 % of
cases."""
_ALPHA = 0.05
"""Probability that an effect which is absent passes for needed, over position and heading."""


def kept_effects(
    recordings: Sequence[Evidence], robot: RobotModel, fitted: Sequence[EffectEstimate]
) -> tuple[str, ...]:
    """Which effects of a robot's file stay as they are when it is commissioned, one sentence each.

    The file may have them from an earlier commissioning, from a diagnosis, or from somebody who knows the robot. Those
    without which recordings are predicted no worse beyond chance, block by block (Wilcoxon's signed-rank test), may be
    out of date.

    Args:
        recordings: of the healthy robot, as they were read.
        robot: with the effects of its file.
        fitted: by commissioning, in place of the file's.
    """
    new = {effect.name: {key: entry.value for key, entry in effect.parameters.items()} for effect in fitted}
    together = replace(robot, effects=tuple({**dict(robot.effects), **new}.items()))
    texts = []
    for name, values in robot.effects:
        if name in new:
            continue
        units = {parameter.name: parameter.unit for parameter in CATALOGUE[name].parameters}
        listed = ", ".join(
            f"{key} {float(value):.3g}{'' if units[key] == '-' else ' ' + units[key]}" for key, value in values.items()
        )
        text = f"{name}: {listed} stays as in the robot's file; it was not fitted"
        if CATALOGUE[name].stage != "measurement" and not _needed(recordings, robot, together, name):
            text += ", and the recordings are predicted no worse without it: remove it if the robot no longer has it"
        texts.append(text)
    return tuple(texts)


def _needed(recordings: Sequence[Evidence], robot: RobotModel, together: RobotModel, name: str) -> bool:
    """Whether errors are larger beyond chance without an effect."""
    without = replace(together, effects=tuple(entry for entry in together.effects if entry[0] != name))
    gains: list[np.ndarray] = []
    for evidence in recordings:
        evidence = corrected_evidence(evidence, robot)
        starts = LeftOut.of(evidence, robot).starts(evidence, _HORIZON)
        if not len(starts):
            continue
        data = evidence.cut(starts, np.array([_HORIZON]))
        with_it, without_it = (_errors(Predictions(model, data)) for model in (together, without))
        blocks = blocks_of(starts)
        gains += [(without_it - with_it)[blocks == block].mean(axis=0) for block in np.unique(blocks)]
    if np.count_nonzero(np.any(gains, axis=-1)) < _FEWEST_BLOCKS:
        return True
    return any(
        bool(part.any()) and wilcoxon(part, alternative="greater").pvalue < 0.5 * _ALPHA for part in np.array(gains).T
    )


def _errors(predictions: Predictions) -> np.ndarray:
    """Errors of position [m] and heading [rad] at the end of each window, ``[W, 2]``."""
    residuals = np.nan_to_num(predictions.residuals([()])[0][:, -1])
    return np.stack([np.hypot(residuals[:, 0], residuals[:, 1]), np.abs(residuals[:, 2])], axis=1)
