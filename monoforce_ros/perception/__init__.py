"""TODO."""

from monoforce_ros.perception.ground_alignment import support_points
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.perception.terrain_sources import (
    SOURCES,
    CameraTerrain,
    FlatTerrain,
    LidarCameraTerrain,
    LidarNetworkTerrain,
    LidarTerrain,
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
    "TerrainSource",
    "choose_terrain_source",
    "support_points",
]
