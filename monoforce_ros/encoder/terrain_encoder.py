"""TerrainEncoder: any number of calibrated cameras → terrain map with material."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from monoforce_ros.encoder.backbone import COARSE_CHANNELS, FINE_CHANNELS, Backbone
from monoforce_ros.encoder.birds_eye import BirdsEyeNetwork
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.heads import EncodedMaps, map_heads, maps_from_heads, terrain_of, with_edges
from monoforce_ros.encoder.image_context import ImageContext, resized
from monoforce_ros.encoder.lift import depth_values, lifted_points, map_cells, splat
from monoforce_ros.encoder.sweep import HIT
from monoforce_ros.encoder.view import SUPPORT_CHANNELS, CameraView, EncoderInput, encoder_input
from monoforce_ros.terrain import TerrainMap

_GEOMETRY_CHANNELS = 5
MOMENTS = 3
"""Channels of the mean height of a cell's features, its variance, and the evidence."""
_NECK_CHANNELS = 64
_CONTEXT_CHANNELS = 96
_LEVEL_GROUND_SPREAD = 0.25
"""Standard deviation of the initial depth prior around level ground, in the logarithm of depth."""
_NEARER = 0.75
"""Share of the bins of relative depth that are nearer than level ground: most things stand on it."""


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
        self.context = ImageContext(COARSE_CHANNELS + _GEOMETRY_CHANNELS, _CONTEXT_CHANNELS)
        self.neck = nn.Sequential(
            nn.Conv2d(FINE_CHANNELS + _CONTEXT_CHANNELS + _GEOMETRY_CHANNELS, _NECK_CHANNELS, 1, bias=False),
            nn.BatchNorm2d(_NECK_CHANNELS),
            nn.ReLU(inplace=True),
            nn.Conv2d(_NECK_CHANNELS, _NECK_CHANNELS, 3, padding=1, bias=False),
            nn.BatchNorm2d(_NECK_CHANNELS),
            nn.ReLU(inplace=True),
        )
        self.lift = nn.Conv2d(_NECK_CHANNELS, config.depth_bins + config.image_features, kernel_size=1)
        self.level_weight = nn.Parameter(torch.tensor(1.0))
        if config.relative_bins:
            self.relative = nn.Conv2d(_NECK_CHANNELS, config.relative_bins, kernel_size=1)
            # At first only the prior around level ground is known.
            nn.init.zeros_(self.relative.weight)
            assert self.relative.bias is not None
            nn.init.zeros_(self.relative.bias)
        self.bird = BirdsEyeNetwork(config.image_features + MOMENTS + self.other_inputs, config.map_features)
        self.heads = map_heads(config)
        depths = torch.from_numpy(depth_values(config)).float()
        self.register_buffer("depths", depths, persistent=False)
        self.backbone_frozen = self.images_frozen = False

    def freeze_backbone(self, *, early_only: bool = False) -> None:
        """Keep the backbone, or its early stages, and the statistics of its norms as they are.

        ImageNet's features hold for photographs; trained on rendered images alone, they would not.
        """
        self.backbone_frozen = True
        frozen = self.backbone.early if early_only else [self.backbone]
        for part in frozen:
            part.requires_grad_(False)
        self.backbone.eval()

    def freeze_images(self) -> None:
        """Keep all that is lifted into the map as it is: only the bird's-eye-view network and the heads are trained."""
        self.images_frozen = True
        for part in self._image_parts:
            part.requires_grad_(False).eval()
        self.level_weight.requires_grad_(False)

    @property
    def other_inputs(self) -> int:
        """Inputs of the bird's-eye-view network besides those of images, the last ones."""
        return SUPPORT_CHANNELS + (self.config.sweep_channels if self.config.takes_sweeps else 0)

    @property
    def _image_parts(self) -> list[nn.Module]:
        relative = [self.relative] if self.config.relative_bins else []
        return [self.backbone, self.context, self.neck, self.lift, *relative]

    @override
    def train(self, mode: bool = True) -> TerrainEncoder:
        """Training or evaluation mode; frozen parts stay in evaluation mode."""
        super().train(mode)
        if self.backbone_frozen:
            self.backbone.eval()
        if self.images_frozen:
            for part in self._image_parts:
                part.eval()
        return self

    @override
    def forward(self, batch: EncoderInput) -> EncodedMaps:
        """Predict maps from a batch."""
        config, grid = self.config, self.config.grid
        shape = (batch.maps, grid.rows, grid.columns)
        parts = [batch.support]
        if config.takes_sweeps:
            parts.append(batch.sweep[:, : config.sweep_channels])
        if len(batch.images):
            image_features, covered, evidence, depth = self._splat(batch)
            parts = [image_features, *(part.to(image_features.dtype) for part in parts)]
        else:
            # The bird's-eye-view network takes what is left out for zeros.
            covered, evidence, depth = torch.zeros(shape, dtype=torch.bool, device=batch.support.device), None, None
        features = torch.cat(parts, dim=1).to(self.lift.weight.dtype)
        if not features.is_cuda:
            features = features.contiguous(memory_format=torch.channels_last)
        outputs = self.heads(self.bird(features).to(self.heads.weight.dtype)).float()
        hit = batch.sweep[:, HIT]
        evidence = hit if evidence is None else evidence + hit
        maps = maps_from_heads(outputs, batch, config, covered | (hit > 0), evidence, depth, training=self.training)
        return with_edges(maps, config) if config.edges and not self.training else maps

    def _splat(self, batch: EncoderInput) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features of the images ``[B, C, rows, columns]``, the cells in view, the summed depth probability per cell,
        and the logarithm of the depth probabilities."""
        config, grid = self.config, self.config.grid
        size = grid.rows * grid.columns
        depth, features = self.lifted(*self.image_features(batch.images), batch.rays, batch.origins)
        probability = depth.exp()
        points = lifted_points(batch.rays, batch.origins, self.depths)
        cells = map_cells(points, config)
        cells = torch.where(batch.seen[:, None], cells, -1)
        cells = torch.where(cells < 0, cells, cells + (batch.map_of * size)[:, None, None, None])
        summed, totals = splat(probability, features, cells, points[..., 2], batch.maps * size)
        shape = (batch.maps, grid.rows, grid.columns, -1)
        evidence = totals[:, 0]
        mean = totals[:, 1:] / (evidence + 0.05)[:, None]
        variance = (mean[:, 1] - mean[:, 0] ** 2).clamp_min(0.0)
        moments = torch.stack([mean[:, 0], variance, torch.log1p(evidence)], dim=1)
        joined = torch.cat([summed / (evidence + 0.1)[:, None], moments.to(summed.dtype)], dim=1)
        hits = torch.zeros(batch.maps * size, device=cells.device)
        hits[cells[cells >= 0]] = 1.0
        covered = functional.max_pool2d(hits.view(batch.maps, 1, grid.rows, grid.columns), 5, 1, 2)[:, 0] > 0
        return joined.view(shape).permute(0, 3, 1, 2), covered, evidence.view(shape[:-1]), depth

    @property
    def backbone_channels(self) -> tuple[int, int]:
        """Channels of the backbone's features at stride 8 and at stride 16."""
        return FINE_CHANNELS, COARSE_CHANNELS

    def image_features(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Backbone features ``[N, 40, rows, columns]`` and ``[N, 112, rows / 2, columns / 2]`` of RGB images uint8
        ``[N, 3, image_height, image_width]``."""
        return self.backbone((images.float() / 127.5 - 1.0).to(self.lift.weight.dtype))

    def lifted(self, fine: Tensor, coarse: Tensor, rays: Tensor, origins: Tensor) -> tuple[Tensor, Tensor]:
        """What is lifted into the map.

        Args:
            fine, coarse: from :meth:`image_features`.
            rays, origins: of :class:`~monoforce_ros.encoder.view.EncoderInput`.

        Returns:
            the logarithm of the depth probabilities ``[N, bins, rows, columns]``, and features ``[N, C, rows,
            columns]``.
        """
        config = self.config
        down = rays[..., 2]
        height = origins[:, 2, None, None]
        # Depth at which the ray meets level ground; beyond every bin for rays that do not.
        level = torch.where(down < -1e-3, -height / down.clamp_max(-1e-3), 1e3).clamp(0.1, 1e3).log()
        low, high = float(np.log(config.depth_minimum)), float(np.log(config.depth_maximum))
        geometry = torch.stack(
            [*rays.unbind(-1), height.expand_as(down), ((level - low) / (high - low)).clamp(-0.5, 1.5)], dim=1
        )
        geometry = geometry.to(fine.dtype)
        coarse = self.context(torch.cat([coarse, resized(geometry, coarse.shape[-2:])], dim=1))
        neck = self.neck(torch.cat([fine, resized(coarse, fine.shape[-2:]), geometry], dim=1))
        lifted = self.lift(neck)
        distance = (self.depths.log()[:, None, None] - level.clamp_max(high)[:, None]) / _LEVEL_GROUND_SPREAD
        logits = lifted[:, : config.depth_bins].float() - self.level_weight * 0.5 * distance**2
        if config.relative_bins:
            logits = logits + self._from_level_ground(self.relative(neck).float(), level.clamp_max(high))
        return logits.log_softmax(dim=1), lifted[:, config.depth_bins :].float()

    def _from_level_ground(self, relative: Tensor, level: Tensor) -> Tensor:
        """Logits of the depth bins from logits of depths relative to level ground.

        A network can say "as far away as level ground" of every pixel in the same way, and so can it say "a third
        nearer"; in bins of absolute depth each row of an image needs words of its own.

        Args:
            relative: logits ``[N, relative bins, rows, columns]``; bins are as wide as those of depth.
            level: logarithm of the depth of level ground ``[N, rows, columns]``.
        """
        last = relative.shape[1] - 1
        step = float(self.depths[1].log() - self.depths[0].log())
        start = (self.depths[0].log() - level) / step + _NEARER * last
        whole = start.floor()
        share = (start - whole)[:, None]
        place = whole.long()[:, None] + torch.arange(len(self.depths), device=level.device)[:, None, None]
        lower, upper = (relative.gather(1, (place + i).clamp(0, last)) for i in (0, 1))
        return lower + share * (upper - lower)

    @torch.no_grad()
    def terrain(
        self,
        views: Sequence[CameraView],
        support: np.ndarray | None = None,
        *,
        sweep: np.ndarray | None = None,
        trace: np.ndarray | None = None,
    ) -> TerrainMap:
        """Terrain map in the views' terrain frame; cells with enough image evidence or a lidar hit count as observed.

        See :func:`monoforce_ros.encoder.encoder_input` for the arguments.
        """
        if self.training:
            self.eval()
        batch = encoder_input(views, support, self.config, sweep=sweep, trace=trace).to(self.depths.device)
        return terrain_of(self(batch), batch, self.config)
