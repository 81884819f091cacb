"""One observation → terrain and rollout: what the node and the evaluation have in common."""

from monoforce_ros.prediction.predictor import Prediction, Predictor
from monoforce_ros.prediction.terrain_sources import (
    SOURCES,
    CameraTerrain,
    FlatTerrain,
    LidarCameraTerrain,
    LidarNetworkTerrain,
    LidarTerrain,
    Observation,
    choose_terrain_source,
)

__all__ = [
    "SOURCES",
    "CameraTerrain",
    "FlatTerrain",
    "LidarCameraTerrain",
    "LidarNetworkTerrain",
    "LidarTerrain",
    "Observation",
    "Prediction",
    "Predictor",
    "choose_terrain_source",
]
