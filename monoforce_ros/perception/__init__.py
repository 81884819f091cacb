"""Perception: terrain maps from the robot's sensors (lidar, cameras, both, or none), each behind one interface."""

from monoforce_ros.perception.camera import CameraTerrain
from monoforce_ros.perception.flat import FlatTerrain
from monoforce_ros.perception.fusion import LidarCameraTerrain
from monoforce_ros.perception.ground_alignment import support_points
from monoforce_ros.perception.lidar import LidarNetworkTerrain, LidarTerrain
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.perception.sources import SOURCES, choose_terrain_source

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
