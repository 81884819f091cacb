"""Lift and splat: image features with depth distributions → bird's-eye-view map (Philion and Fidler 2020)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.core import CameraModel
from monoforce_ros.encoder.config import EncoderConfig

_LARGEST_SLOPE = 5.67
"""Largest tangent of the angle between a ray and the optical axis."""


def depth_values(config: EncoderConfig) -> np.ndarray:
    """Depth of each bin [m], ``[bins]``, evenly spaced in the logarithm."""
    return np.geomspace(config.depth_minimum, config.depth_maximum, config.depth_bins)


def letterbox(width: int, height: int, aspect: float) -> np.ndarray:
    """Affine map ``[2, 3]`` from the network's view to an image, both in 0..1; the view contains the whole image.

    The image keeps its aspect ratio and is centred; the rest of the view, outside of 0..1, is empty.

    Args:
        width, height: size of the image [px].
        aspect: width of the view divided by its height.
    """
    wide = max(1.0, aspect * height / width)
    high = max(1.0, width / (aspect * height))
    return np.array([[wide, 0.0, 0.5 - wide / 2], [0.0, high, 0.5 - high / 2]])


def feature_rays(camera: CameraModel, rows: int, columns: int, view_from_crop: np.ndarray | None = None) -> np.ndarray:
    """Undistorted ray through the centre of each feature cell.

    Args:
        camera: model of the original image.
        rows, columns: size of the feature map of the letterboxed image.
        view_from_crop: affine map ``[2, 3]`` from a crop of the letterboxed image to the whole of it, both in 0..1; for
            training on crops.

    Returns:
        ``[rows, columns, 3]`` in camera axes with z = 1: a ray times a depth is a point. NaN outside of the image and
        outside of the lens' field of view.
    """
    if view_from_crop is None:
        matrix, distortion = (np.asarray(v, np.float64) for v in (camera.matrix, camera.distortion))
        intrinsics = (matrix.tobytes(), distortion.tobytes(), camera.distortion_model)
        return _whole_image_rays(camera.width, camera.height, *intrinsics, rows, columns)
    return _rays(camera, rows, columns, view_from_crop)


def _rays(camera: CameraModel, rows: int, columns: int, view_from_crop: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    for affine in (view_from_crop, letterbox(camera.width, camera.height, columns / rows)):
        x, y = (a * x + b * y + c for a, b, c in affine)
    rays = camera.rays(np.stack([x * camera.width - 0.5, y * camera.height - 0.5], axis=-1))
    inside = (x >= 0.0) & (x <= 1.0) & (y >= 0.0) & (y <= 1.0)
    # Beyond this slope, 80° off the axis, a lens shows nothing that the map could use.
    inside &= np.abs(rays[..., :2]).max(axis=-1) < _LARGEST_SLOPE
    return np.where(inside[..., None], rays, np.nan)


@lru_cache(maxsize=64)
def _whole_image_rays(
    width: int, height: int, matrix: bytes, distortion: bytes, model: str, rows: int, columns: int
) -> np.ndarray:
    """Rays of an uncropped image, cached per camera because undistortion takes a millisecond."""
    camera = CameraModel(width, height, np.frombuffer(matrix).reshape(3, 3), np.frombuffer(distortion), model)
    rays = _rays(camera, rows, columns, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    rays.flags.writeable = False
    return rays


def lifted_points(rays: Tensor, origins: Tensor, depths: Tensor) -> Tensor:
    """Points at each depth along the ray of each feature cell.

    Args:
        rays: rays in terrain axes ``[N, rows, columns, 3]``.
        origins: camera positions in the terrain frame ``[N, 3]`` [m].
        depths: ``[bins]`` [m].

    Returns:
        ``[N, bins, rows, columns, 3]`` [m].
    """
    return origins[:, None, None, None] + depths[:, None, None, None] * rays[:, None]


def map_cells(points: Tensor, config: EncoderConfig) -> Tensor:
    """Flat cell index of each point ``[..., 3]`` in the terrain frame [m]; -1 outside the map or its height range."""
    grid = config.grid
    columns = torch.round((points[..., 0] - grid.origin[0]) / grid.resolution)
    rows = torch.round((points[..., 1] - grid.origin[1]) / grid.resolution)
    inside = (columns >= 0) & (columns < grid.columns) & (rows >= 0) & (rows < grid.rows)
    inside &= (points[..., 2] > config.lowest) & (points[..., 2] < config.highest)
    return torch.where(inside, rows * grid.columns + columns, -1.0).long()


def splat(depth: Tensor, features: Tensor, cells: Tensor, heights: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Sum depth-weighted features into map cells.

    The products of depth probability and feature are never stored: points are sorted by cell, and features are gathered
    and summed per cell with the probabilities as weights.

    Args:
        depth: probabilities ``[N, bins, rows, columns]``.
        features: ``[N, C, rows, columns]``.
        cells: cell indices over all maps ``[N, bins, rows, columns]`` int64; -1 is ignored.
        heights: heights of the points [m], shaped like ``cells``.
        size: number of cells of all maps.

    Returns:
        the summed features ``[size, C]``, and the sums of probability, probability × height and probability × height²
        ``[size, 3]``.
    """
    count, channels, rows, columns = features.shape
    flat = cells.flatten()
    kept = torch.nonzero(flat >= 0)[:, 0]
    order = kept[torch.sort(flat[kept], stable=True).indices]
    target = flat[order]
    # Feature of each point: points are numbered (image, bin, row, column).
    patch = rows * columns
    pixel = order // (patch * depth.shape[1]) * patch + order % patch
    table = features.permute(0, 2, 3, 1).reshape(count * patch, channels)
    weight, height = depth.flatten()[order], heights.flatten()[order]
    starts = torch.searchsorted(target, torch.arange(size, device=target.device))
    summed = functional.embedding_bag(pixel, table, starts, mode="sum", per_sample_weights=weight.to(table.dtype))
    moments = torch.stack([weight, weight * height, weight * height**2], dim=1)
    totals = torch.zeros(size, 3, dtype=moments.dtype, device=moments.device).index_add(0, target, moments)
    return summed, totals
