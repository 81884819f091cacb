"""Terrain encoder: camera images → terrain map by lift, splat, shoot (paper III-A)."""

from monoforce_ros.encoder.checkpoint import CheckpointError, load_encoder, save_encoder
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.terrain_encoder import EncodedMaps, TerrainEncoder
from monoforce_ros.encoder.view import CameraView, EncoderInput, encoder_input

__all__ = [
    "CameraView",
    "CheckpointError",
    "EncodedMaps",
    "EncoderConfig",
    "EncoderInput",
    "TerrainEncoder",
    "encoder_input",
    "load_encoder",
    "save_encoder",
]
