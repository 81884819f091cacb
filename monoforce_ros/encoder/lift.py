"""Lift and splat: image features with depth distributions → bird's-eye-view map (Philion and Fidler 2020)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.camera import CameraModel
from monoforce_ros.encoder.config import EncoderConfig


def depth_values(config: EncoderConfig) -> np.ndarray:
    """Depth of each bin [m], ``[bins]``, evenly spaced in the logarithm."""
    return np.geomspace(config.depth_minimum, config.depth_maximum, config.depth_bins)


def frustum_points(camera: CameraModel, rows: int, columns: int, depths: np.ndarray) -> np.ndarray:
    """Points that an image's feature cells may lie at, in the camera frame.

    Args:
        camera: model of the original image; its distortion is removed here.
        rows, columns: size of the feature map that covers the whole image.
        depths: distances along the optical axis [m], ``[bins]``.

    Returns:
        ``[bins, rows, columns, 3]`` [m].
    """
    u = (np.arange(columns) + 0.5) / columns * camera.width - 0.5
    v = (np.arange(rows) + 0.5) / rows * camera.height - 0.5
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))
    return depths[:, None, None, None] * rays[None]


def map_cells(points: np.ndarray, config: EncoderConfig) -> np.ndarray:
    """Flat index of the map cell of each point ``[..., 3]`` in the terrain frame; -1 outside the map or its heights."""
    grid = config.grid
    rows, columns, inside = grid.cells(points[..., :2])
    inside &= (points[..., 2] > config.lowest) & (points[..., 2] < config.highest)
    return np.where(inside, rows * grid.columns + columns, -1)


def splat(depth: Tensor, features: Tensor, cells: Tensor, size: int) -> Tensor:
    """Sum depth-weighted features into map cells.

    Args:
        depth: probabilities ``[B, bins, rows, columns]``.
        features: ``[B, C, rows, columns]``.
        cells: flat map cells ``[B, bins, rows, columns]`` int64; -1 is left out.
        size: number of map cells.

    Returns:
        ``[B, C + 1, size]``: the summed features and, last, the summed probability (how much was seen there).
    """
    batch, channels = features.shape[:2]
    seen = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)
    weighted = (depth[:, :, None] * seen[:, None]).permute(0, 1, 3, 4, 2).reshape(batch, -1, channels + 1)
    # One row more than there are cells takes what falls outside.
    target = torch.where(cells < 0, size, cells).reshape(batch, -1)
    target = target + (size + 1) * torch.arange(batch, device=cells.device)[:, None]
    summed = torch.zeros(batch * (size + 1), channels + 1, dtype=weighted.dtype, device=weighted.device)
    summed = summed.index_add(0, target.flatten(), weighted.flatten(0, 1))
    return summed.unflatten(0, (batch, size + 1))[:, :size].transpose(1, 2)
