"""Step errors: the effects of a diagnosis on windows that begin with a step of the command, beside a kinematic fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monoforce_ros.discrepancy.comparison import HeldOut
from monoforce_ros.discrepancy.dead_reckoning import dead_reckoning_errors
from monoforce_ros.discrepancy.evidence import MOTION, Evidence
from monoforce_ros.discrepancy.fit import fit_effects
from monoforce_ros.discrepancy.gap import residual_scale
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, corrected_evidence
from monoforce_ros.discrepancy.kinematic_baseline import HORIZON, StepComparison, compare_on_steps, step_starts
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.robots import RobotModel

_MOST = 120
"""Windows at most, spread over the recording: as many as a diagnosis uses."""
_SPACING = 0.05
"""Time between possible starts [s]."""


def compare_after_steps(
    evidence: Evidence, robot: RobotModel, effects: Effects, parts: HeldOut | None = None
) -> StepComparison | None:
    """Position errors 2 s after steps: nominal model, effects and kinematic fit, each tested where it was not fitted.

    Args:
        evidence: the recording.
        robot: the nominal model.
        effects: those found, with their values. Without ``parts`` they are fitted again to each half of the blocks.
        parts: effects that searches without each part of the recording found, with their values: each part is predicted
            with those, fitted again to the steps of the others, so that it had no say in the selection either.

    Returns:
        None where there are too few steps.
    """
    evidence = replace(corrected_evidence(evidence, robot), components=MOTION)
    motion = evidence.smoothed.motion
    possible = LeftOut.of(evidence, robot).starts(evidence, HORIZON, _SPACING)
    starts = step_starts(evidence.commands, np.sort(possible))
    selected_apart = parts is not None
    if parts is not None:
        starts = parts.judged(starts, HORIZON)
    starts = starts[:: max(1, -(-len(starts) // _MOST))]
    if not len(starts):
        return None
    found = parts or HeldOut((effects, effects), int(starts[0]))
    folds = found.part_of(starts)
    samples = np.array([0.5, 1.0, 1.5, HORIZON])
    scale = residual_scale(np.zeros((len(samples), 3)), evidence.cut(starts, samples), None)

    def predictions(at: np.ndarray) -> Predictions:
        return Predictions(robot, evidence.cut(at, samples))

    def errors(at: np.ndarray, folds: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        before = _distance(predictions(at), ())
        if not effects:
            return before, None
        after = before.copy()
        for part, acting in enumerate(found.effects):
            inside = folds == part
            if acting and inside.any():
                fit = fit_effects(predictions(at[~inside]), [acting], scale, iterations=4)
                after[inside] = _distance(predictions(at[inside]), fit.effects)
        return before, after

    reckoned = dead_reckoning_errors(evidence, robot, starts, samples, folds)
    compared = compare_on_steps(motion, evidence.commands, starts, folds, errors, reckoned)
    return None if compared is None else replace(compared, selected_apart=selected_apart)


def _distance(predictions: Predictions, effects: Effects) -> np.ndarray:
    """Position errors at the end of each window [m]; infinite where a prediction diverged."""
    residuals = predictions.residuals([effects])[0][:, -1]
    return np.nan_to_num(np.hypot(residuals[:, 0], residuals[:, 1]), nan=np.inf)
