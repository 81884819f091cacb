"""One observation → terrain and rollout: what the node and the evaluation have in common."""

from monoforce_ros.prediction.contact_view import (
    FORCE_INTERVAL,
    FORCE_LENGTH,
    cell_points,
    contact_points,
    force_steps,
    usable_steps,
)
from monoforce_ros.prediction.ensemble import EnsembleSettings, Spread, spread
from monoforce_ros.prediction.monitor import HORIZONS, GapSummary, LiveGap
from monoforce_ros.prediction.predictor import Prediction, Predictor, start_states

__all__ = [
    "FORCE_INTERVAL",
    "FORCE_LENGTH",
    "HORIZONS",
    "EnsembleSettings",
    "GapSummary",
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
