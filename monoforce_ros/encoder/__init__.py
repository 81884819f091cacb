"""Terrain encoder: camera images → terrain map by lift, splat, shoot (paper III-A)."""

from monoforce_ros.encoder.checkpoint import CheckpointError, load_encoder, save_encoder
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.terrain_encoder import CameraView, TerrainEncoder

__all__ = [
    "CameraView",
    "CheckpointError",
    "EncoderConfig",
    "TerrainEncoder",
    "load_encoder",
    "save_encoder",
]
