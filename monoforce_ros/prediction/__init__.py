"""One observation → terrain and rollout: what the node and the evaluation have in common."""

from monoforce_ros.prediction.predictor import Prediction, Predictor
from monoforce_ros.prediction.terrain_sources import (
    CameraTerrain,
    FlatTerrain,
    LidarNetworkTerrain,
    LidarTerrain,
    Observation,
)

__all__ = [
    "CameraTerrain",
    "FlatTerrain",
    "LidarNetworkTerrain",
    "LidarTerrain",
    "Observation",
    "Prediction",
    "Predictor",
]
