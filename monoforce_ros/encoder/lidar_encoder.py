"""LidarEncoder: one sparse sweep → dense map of the visible surface; the learned lidar baseline (paper IV-B, [22])."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
import torch
from torch import nn

from monoforce_ros.encoder.birds_eye import BirdsEyeNetwork
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.heads import EncodedMaps, map_heads, maps_from_heads, terrain_of
from monoforce_ros.encoder.sweep import HIT
from monoforce_ros.encoder.view import SUPPORT_CHANNELS, CameraView, EncoderInput, encoder_input
from monoforce_ros.terrain import TerrainMap


class LidarEncoder(nn.Module):
    """Densifies the heights of a sweep, with the bird's-eye-view network and heads of the camera encoder."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        self.bird = BirdsEyeNetwork(config.sweep_channels + SUPPORT_CHANNELS, config.map_features)
        self.heads = map_heads(config)

    @override
    def forward(self, batch: EncoderInput) -> EncodedMaps:
        """Predict maps from a batch with sweeps."""
        sweep = batch.sweep[:, : self.config.sweep_channels]
        features = torch.cat([sweep, batch.support], dim=1).to(self.bird.dtype)
        outputs = self.heads(self.bird(features).to(self.heads.weight.dtype)).float()
        hit = batch.sweep[:, HIT]
        covered = torch.ones_like(hit, dtype=torch.bool)
        return maps_from_heads(outputs, batch, self.config, covered, hit, training=self.training)

    @torch.no_grad()
    def terrain(
        self,
        views: Sequence[CameraView],
        support: np.ndarray | None = None,
        *,
        sweep: np.ndarray | None = None,
        trace: np.ndarray | None = None,
    ) -> TerrainMap:
        """Terrain map from a sweep; cells with a hit count as observed. ``views`` must be empty.

        See :func:`monoforce_ros.encoder.encoder_input` for the arguments.
        """
        if views or sweep is None:
            raise ValueError(
                f"lidar encoder: got {len(views)} images and sweep {sweep is not None}, expected a sweep only"
            )
        if self.training:
            self.eval()
        batch = encoder_input([], support, self.config, sweep=sweep, trace=trace).to(self.heads.weight.device)
        return terrain_of(self(batch), batch, self.config)
