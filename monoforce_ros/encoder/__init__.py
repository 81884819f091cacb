"""Terrain encoders: camera images → terrain map by lift-splat-shoot (paper III-A), and lidar sweep → dense map."""

from monoforce_ros.encoder.backbone import WeightsError
from monoforce_ros.encoder.checkpoint import (
    CheckpointError,
    Encoder,
    extended,
    load_encoder,
    new_encoder,
    save_encoder,
)
from monoforce_ros.encoder.config import HEIGHT_CHANNELS, SENSORS, SPREAD_FACTORS, EncoderConfig
from monoforce_ros.encoder.heads import SMALLEST_DECREASE, EncodedMaps
from monoforce_ros.encoder.inference import fused, multiplies_bfloat16, packed
from monoforce_ros.encoder.lidar_encoder import LidarEncoder
from monoforce_ros.encoder.lift import feature_rays, letterbox
from monoforce_ros.encoder.terrain_encoder import TerrainEncoder
from monoforce_ros.encoder.view import CameraView, EncoderInput, assemble, encoder_input, network_image

__all__ = [
    "HEIGHT_CHANNELS",
    "SENSORS",
    "SMALLEST_DECREASE",
    "SPREAD_FACTORS",
    "CameraView",
    "CheckpointError",
    "EncodedMaps",
    "Encoder",
    "EncoderConfig",
    "EncoderInput",
    "LidarEncoder",
    "TerrainEncoder",
    "WeightsError",
    "assemble",
    "encoder_input",
    "extended",
    "feature_rays",
    "fused",
    "letterbox",
    "load_encoder",
    "multiplies_bfloat16",
    "network_image",
    "new_encoder",
    "packed",
    "save_encoder",
]
