"""Prediction: from an observation to the robot's motion and contact forces, its uncertainty, and its measured error."""

from monoforce_ros.prediction.ensemble import COVERAGE, EnsembleSettings, Spread, spread
from monoforce_ros.prediction.geometry import (
    FORCE_INTERVAL,
    FORCE_LENGTH,
    cell_points,
    contact_points,
    force_steps,
    usable_steps,
)
from monoforce_ros.prediction.joint_motion import JointMotion
from monoforce_ros.prediction.monitor import HORIZONS, GapSummary, LiveGap
from monoforce_ros.prediction.predictor import Prediction, Predictor, start_states

__all__ = [
    "COVERAGE",
    "FORCE_INTERVAL",
    "FORCE_LENGTH",
    "HORIZONS",
    "EnsembleSettings",
    "GapSummary",
    "JointMotion",
    "LiveGap",
    "Prediction",
    "Predictor",
    "Spread",
    "cell_points",
    "contact_points",
    "force_steps",
    "spread",
    "start_states",
    "usable_steps",
]
