"""LidarEncoder: one sparse sweep → dense map of the visible surface; the learned lidar baseline (paper IV-B, [22])."""

from __future__ import annotations

from typing import override

import numpy as np
import torch
from torch import nn

from monoforce_ros.encoder.birds_eye import BirdsEyeNetwork
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.terrain_encoder import EncodedMaps, map_heads, maps_from_heads, terrain_maps
from monoforce_ros.encoder.view import EncoderInput, sweep_input
from monoforce_ros.terrain import TerrainMap


class LidarEncoder(nn.Module):
    """Densifies the heights of a sweep, with the bird's-eye-view network and heads of the camera encoder."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        # Lowest and highest hit, hit mask, support plane and its mask.
        self.bird = BirdsEyeNetwork(5, config.map_features)
        self.heads = map_heads(config.map_features)

    @override
    def forward(self, batch: EncoderInput) -> EncodedMaps:
        """Predict maps from a batch with sweeps."""
        outputs = self.heads(self.bird(torch.cat([batch.sweep, batch.support], dim=1))).float()
        hit = batch.sweep[:, 2]
        return maps_from_heads(outputs, batch, self.config, torch.ones_like(hit, dtype=torch.bool), hit)

    @torch.no_grad()
    def terrain(self, points: np.ndarray, support: np.ndarray | None = None) -> TerrainMap:
        """Terrain map from a sweep ``[n, 3]`` in the terrain frame [m]; cells with a hit count as observed."""
        if self.training:
            self.eval()
        batch = sweep_input(points, support, self.config).to(self.heads.weight.device)
        return terrain_maps(self(batch), self.config)[0]
