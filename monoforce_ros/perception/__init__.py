"""Perception: terrain maps from the robot's sensors (lidar, cameras, both, or none), each behind one interface."""

from monoforce_ros.perception.clearance import with_clear_start
from monoforce_ros.perception.encoder_terrain import EncoderTerrain
from monoforce_ros.perception.flat import FlatTerrain
from monoforce_ros.perception.fusion import LidarCameraTerrain
from monoforce_ros.perception.ground_alignment import ground_around, support_points
from monoforce_ros.perception.lidar import LidarTerrain
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.perception.seen_obstacles import SeenObstacles
from monoforce_ros.perception.sources import (
    CAMERA_SOURCES,
    LIDAR_RETENTION_TIME,
    SOURCES,
    choose_terrain_source,
)
from monoforce_ros.perception.trace import DrivenGround, traced_ground, unbroken
from monoforce_ros.perception.trust import TerrainTrust, TrustReport
from monoforce_ros.perception.trusted_terrain import TrustedTerrain

__all__ = [
    "CAMERA_SOURCES",
    "LIDAR_RETENTION_TIME",
    "SOURCES",
    "DrivenGround",
    "EncoderTerrain",
    "FlatTerrain",
    "LidarCameraTerrain",
    "LidarTerrain",
    "Observation",
    "SeenObstacles",
    "TerrainSource",
    "TerrainTrust",
    "TrustReport",
    "TrustedTerrain",
    "choose_terrain_source",
    "ground_around",
    "support_points",
    "traced_ground",
    "unbroken",
    "with_clear_start",
]
