"""TerrainEncoder: any number of calibrated cameras → terrain map with material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from monoforce_ros.encoder.backbone import COARSE_CHANNELS, FINE_CHANNELS, Backbone
from monoforce_ros.encoder.birds_eye import BirdsEyeNetwork
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.edges import restore_edges
from monoforce_ros.encoder.lift import depth_values, lifted_points, map_cells, splat
from monoforce_ros.encoder.view import CameraView, EncoderInput, encoder_input
from monoforce_ros.terrain import TerrainMap

_GEOMETRY_CHANNELS = 5
_NECK_CHANNELS = 64
_LEVEL_GROUND_SPREAD = 0.25
"""Standard deviation of the initial depth prior around level ground, in the logarithm of depth."""
_SOFTPLUS_BETA = 5.0
"""Sharpness β of the softplus that keeps H_d ≥ 0 [1/m]. Its gradient vanishes far below 0: a sharper bend starts there,
or firm ground pushes the whole map there before grass is distinguished from it."""
_OBSERVED = 0.05
"""Least summed depth probability of an observed cell."""


@dataclass(frozen=True)
class EncodedMaps:
    """Predictions for a batch; each ``[B, rows, columns]``, heights in the terrain frame [m]."""

    geometric_height: Tensor
    decrease: Tensor
    """H_d ≥ 0: depth of the supporting ground below the visible surface."""
    stiffness: Tensor
    """[N/m³]."""
    damping: Tensor
    """[N s/m³]."""
    friction: Tensor
    covered: Tensor
    """Whether a cell is in the field of view (bool)."""
    evidence: Tensor
    """Summed depth probability of the features in a cell."""

    @property
    def height(self) -> Tensor:
        """H_t = H_g - H_d (paper III-A)."""
        return self.geometric_height - self.decrease


class TerrainEncoder(nn.Module):
    """Lift-splat-shoot with heads for geometric height, its decrease and the ground's material (paper III-A).

    Besides the image, the network gets each pixel's ray in the gravity-aligned terrain frame and the depth at which it
    meets level ground, so that intrinsics, distortion and mounting may differ from those in training. Heights are
    relative to the ground under the wheels, so that the robot may differ too.
    """

    depths: Tensor

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        self.backbone = Backbone()
        self.neck = nn.Sequential(
            nn.Conv2d(FINE_CHANNELS + COARSE_CHANNELS + _GEOMETRY_CHANNELS, _NECK_CHANNELS, 1, bias=False),
            nn.BatchNorm2d(_NECK_CHANNELS),
            nn.ReLU(inplace=True),
            nn.Conv2d(_NECK_CHANNELS, _NECK_CHANNELS, 3, padding=1, bias=False),
            nn.BatchNorm2d(_NECK_CHANNELS),
            nn.ReLU(inplace=True),
        )
        self.lift = nn.Conv2d(_NECK_CHANNELS, config.depth_bins + config.image_features, kernel_size=1)
        self.level_weight = nn.Parameter(torch.tensor(1.0))
        # Features, mean height and its variance, evidence, support plane and its mask.
        self.bird = BirdsEyeNetwork(config.image_features + 5, config.map_features)
        self.heads = map_heads(config.map_features)
        depths = torch.from_numpy(depth_values(config)).float()
        self.register_buffer("depths", depths, persistent=False)

    def forward(self, batch: EncoderInput) -> EncodedMaps:
        """Predict maps from a batch."""
        config, grid = self.config, self.config.grid
        size = grid.rows * grid.columns
        depth, features = self._lift(batch)
        points = lifted_points(batch.rays, batch.origins, self.depths)
        cells = map_cells(points, config)
        cameras = len(batch.images) // batch.maps
        first = torch.arange(len(cells), device=cells.device).div(cameras, rounding_mode="floor") * size
        cells = torch.where(cells < 0, cells, cells + first[:, None, None, None])
        summed, totals = splat(depth, features, cells, points[..., 2], batch.maps * size)
        shape = (batch.maps, grid.rows, grid.columns, -1)
        evidence = totals[:, 0]
        mean = totals[:, 1:] / (evidence + 0.05)[:, None]
        variance = (mean[:, 1] - mean[:, 0] ** 2).clamp_min(0.0)
        flat = [
            summed / (evidence + 0.1)[:, None],
            torch.stack([mean[:, 0], variance, torch.log1p(evidence)], dim=1),
        ]
        features = torch.cat([part.view(shape) for part in flat], dim=-1).permute(0, 3, 1, 2)
        features = torch.cat([features.to(summed.dtype), batch.support.to(summed.dtype)], dim=1)
        features = features.to(self.lift.weight.dtype)
        if not features.is_cuda:
            features = features.contiguous(memory_format=torch.channels_last)
        outputs = self.heads(self.bird(features).to(self.heads.weight.dtype)).float()
        hits = torch.zeros(batch.maps * size, device=cells.device)
        hits[cells[cells >= 0]] = 1.0
        covered = functional.max_pool2d(hits.view(batch.maps, 1, grid.rows, grid.columns), 5, 1, 2)[:, 0] > 0
        maps = maps_from_heads(outputs, batch, config, covered, evidence.view(shape[:-1]))
        return with_edges(maps, config) if config.edges else maps

    def _lift(self, batch: EncoderInput) -> tuple[Tensor, Tensor]:
        """Depth probabilities ``[N, bins, rows, columns]`` and features ``[N, C, rows, columns]``."""
        config = self.config
        fine, coarse = self.backbone((batch.images.float() / 127.5 - 1.0).to(self.lift.weight.dtype))
        coarse = functional.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
        down = batch.rays[..., 2]
        height = batch.origins[:, 2, None, None]
        # Depth at which the ray meets level ground; beyond every bin for rays that do not.
        level = torch.where(down < -1e-3, -height / down.clamp_max(-1e-3), 1e3).clamp(0.1, 1e3).log()
        low, high = float(np.log(config.depth_minimum)), float(np.log(config.depth_maximum))
        geometry = torch.stack(
            [*batch.rays.unbind(-1), height.expand_as(down), ((level - low) / (high - low)).clamp(-0.5, 1.5)], dim=1
        )
        lifted = self.lift(self.neck(torch.cat([fine, coarse, geometry.to(fine.dtype)], dim=1)))
        distance = (self.depths.log()[:, None, None] - level.clamp_max(high)[:, None]) / _LEVEL_GROUND_SPREAD
        logits = lifted[:, : config.depth_bins].float() - self.level_weight * 0.5 * distance**2
        return logits.softmax(dim=1), lifted[:, config.depth_bins :].float()

    @torch.no_grad()
    def terrain(self, views: Sequence[CameraView], support: np.ndarray | None = None) -> TerrainMap:
        """Terrain map in the views' terrain frame; cells with enough image evidence count as observed.

        Args:
            views: one of each camera.
            support: contact points of the wheels ``[m, 3]`` in that frame [m].
        """
        if self.training:
            self.eval()
        batch = encoder_input(views, support, self.config).to(self.depths.device)
        return terrain_maps(self(batch), self.config)[0]


def map_heads(features: int) -> nn.Conv2d:
    """Untrained heads for H_g, H_d, stiffness, damping and friction.

    Material heads start at zero, which encodes the configuration's material; without a loss they stay there.
    """
    heads = nn.Conv2d(features, 5, kernel_size=1)
    assert heads.bias is not None
    with torch.no_grad():
        heads.weight[2:] = 0.0
        heads.bias[2:] = 0.0
    return heads


def maps_from_heads(
    outputs: Tensor, batch: EncoderInput, config: EncoderConfig, covered: Tensor, evidence: Tensor
) -> EncodedMaps:
    """Heights and material from the outputs of the heads ``[B, 5, rows, columns]``, each within its bounds."""
    geometric, decrease, stiffness, damping, friction = outputs.unbind(1)
    return EncodedMaps(
        geometric_height=geometric + batch.ground[:, None, None],
        decrease=functional.softplus(decrease, beta=_SOFTPLUS_BETA) if config.decreases else torch.zeros_like(decrease),
        stiffness=config.stiffness * torch.exp(stiffness.clamp(-4.0, 4.0)),
        damping=config.damping * torch.exp(damping.clamp(-4.0, 4.0)),
        friction=config.friction * torch.exp(friction.clamp(-3.0, 1.0)),
        covered=covered,
        evidence=evidence,
    )


def with_edges(maps: EncodedMaps, config: EncoderConfig) -> EncodedMaps:
    """Maps with steps restored in H_t; H_g changes by the same amount, so that H_d is unchanged."""
    change = restore_edges(maps.height, config.resolution) - maps.height
    return replace(maps, geometric_height=maps.geometric_height + change)


def terrain_maps(maps: EncodedMaps, config: EncoderConfig) -> list[TerrainMap]:
    """The predictions of a batch as terrain maps on the CPU."""
    values = {
        name: getattr(maps, name).detach().cpu()
        for name in ("height", "geometric_height", "stiffness", "damping", "friction")
    }
    observed = ((maps.evidence > _OBSERVED) & maps.covered).detach().cpu()
    return [
        TerrainMap(**{name: value[i] for name, value in values.items()}, observed=observed[i], grid=config.grid)
        for i in range(len(observed))
    ]
