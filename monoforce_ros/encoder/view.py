"""CameraView and EncoderInput: images and their geometry as network input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
import torch
from torch import Tensor

from monoforce_ros.core import CameraModel
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.lift import feature_rays
from monoforce_ros.terrain import Grid

_SUPPORT_REACH = 1.0
"""Distance from the robot's centre up to which the plane under its wheels describes the ground [m]."""


@dataclass(frozen=True)
class CameraView:
    """An image, its camera model and the camera's pose."""

    image: np.ndarray
    """Raw RGB pixels ``[height, width, 3]`` uint8."""
    camera: CameraModel
    terrain_from_camera: np.ndarray
    """Pose ``[4, 4]`` of the camera in the terrain frame."""

    def __post_init__(self):
        size = (self.camera.height, self.camera.width)
        if self.image.ndim != 3 or self.image.shape[2] != 3:
            raise ValueError(f"image: got shape {self.image.shape}, expected [height, width, 3]")
        if self.image.shape[:2] != size:
            raise ValueError(
                f"image: got {self.image.shape[1]} × {self.image.shape[0]} px, expected "
                f"{size[1]} × {size[0]} px as in its CameraInfo"
            )


@dataclass(frozen=True)
class EncoderInput:
    """Input for a batch of ``B`` maps with the same number of cameras each; heights are relative to ``ground``."""

    images: Tensor
    """RGB uint8 ``[B · cameras, 3, image_height, image_width]``."""
    rays: Tensor
    """In terrain axes, scaled to 1 m along the optical axis, ``[B · cameras, feature rows, feature columns, 3]``."""
    origins: Tensor
    """Camera positions in the terrain frame, z relative to ``ground``, ``[B · cameras, 3]`` [m]."""
    support: Tensor
    """Plane under the wheels relative to ``ground`` [m], and its mask; ``[B, 2, rows, columns]``."""
    ground: Tensor
    """Height of the ground under the robot in its terrain frame ``[B]`` [m]."""
    sweep: Tensor
    """Lowest and highest lidar hit of each cell relative to ``ground`` [m], and the hit mask;
    ``[B, 3, rows, columns]``, or ``[B, 0, rows, columns]`` without a lidar."""

    @property
    def maps(self) -> int:
        """Number of maps."""
        return len(self.ground)

    def to(self, device: torch.device | str) -> EncoderInput:
        """The same on another device."""
        return EncoderInput(**{f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)})

    @classmethod
    def stack(cls, inputs: Sequence[EncoderInput]) -> EncoderInput:
        """A batch of inputs with the same number of cameras."""
        return cls(**{f.name: torch.cat([getattr(entry, f.name) for entry in inputs]) for f in fields(cls)})


def encoder_input(views: Sequence[CameraView], support: np.ndarray | None, config: EncoderConfig) -> EncoderInput:
    """Input for one map.

    Args:
        views: one view per camera, in one terrain frame.
        support: contact points of the wheels ``[m, 3]`` in that frame [m]; without them the ground is assumed to be at
            the height of the frame's origin.
        config: configuration of the encoder.
    """
    images = np.stack([network_image(view.image, config) for view in views])
    rays = [
        feature_rays(view.camera, config.feature_rows, config.feature_columns) @ view.terrain_from_camera[:3, :3].T
        for view in views
    ]
    origins = np.stack([view.terrain_from_camera[:3, 3] for view in views])
    return assemble(images, np.stack(rays), origins, support, config)


def sweep_input(points: np.ndarray, support: np.ndarray | None, config: EncoderConfig) -> EncoderInput:
    """Input for one map from a lidar sweep ``[n, 3]`` in the terrain frame [m], without points on the robot."""
    none = np.zeros((0, config.image_height, config.image_width, 3), np.uint8)
    rays = np.zeros((0, config.feature_rows, config.feature_columns, 3))
    return assemble(none, rays, np.zeros((0, 3)), support, config, points)


def assemble(
    images: np.ndarray,
    rays: np.ndarray,
    origins: np.ndarray,
    support: np.ndarray | None,
    config: EncoderConfig,
    sweep: np.ndarray | None = None,
) -> EncoderInput:
    """Input for one map from resized images ``[cameras, height, width, 3]``, their rays and origins, and a sweep."""
    ground, plane, known = support_plane(support, config.grid)
    hits = np.zeros((0, *plane.shape)) if sweep is None else sweep_heights(sweep, ground, config)
    return EncoderInput(
        images=torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(),
        rays=torch.as_tensor(rays, dtype=torch.float32),
        origins=torch.as_tensor(origins - np.array([0.0, 0.0, ground]), dtype=torch.float32),
        support=torch.as_tensor(np.stack([plane, known])[None], dtype=torch.float32),
        ground=torch.tensor([ground], dtype=torch.float32),
        sweep=torch.as_tensor(hits[None], dtype=torch.float32),
    )


def sweep_heights(points: np.ndarray, ground: float, config: EncoderConfig) -> np.ndarray:
    """Lowest and highest hit of each cell relative to ``ground`` [m], 0 without a hit, and the hit mask; ``[3, …]``."""
    grid = config.grid
    heights = points[:, 2] - ground
    rows, columns, inside = grid.cells(points[:, :2])
    inside &= (heights > config.lowest) & (heights < config.highest)
    flat, heights = (rows * grid.columns + columns)[inside], heights[inside]
    low, high = np.full(grid.rows * grid.columns, np.inf), np.full(grid.rows * grid.columns, -np.inf)
    np.minimum.at(low, flat, heights)
    np.maximum.at(high, flat, heights)
    hit = np.isfinite(low)
    stacked = np.stack([np.where(hit, low, 0.0), np.where(hit, high, 0.0), hit])
    return stacked.reshape(3, grid.rows, grid.columns)


def network_image(image: np.ndarray, config: EncoderConfig) -> np.ndarray:
    """The image resized for the network."""
    size = (config.image_width, config.image_height)
    if (image.shape[1], image.shape[0]) == size:
        return np.ascontiguousarray(image)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def support_plane(support: np.ndarray | None, grid: Grid) -> tuple[float, np.ndarray, np.ndarray]:
    """Height of the ground under the robot [m], the plane under its wheels relative to it [m], and the plane's mask."""
    shape = (grid.rows, grid.columns)
    if support is None or len(support) < 3:
        return 0.0, np.zeros(shape), np.zeros(shape)
    near = np.hypot(grid.x[None, :], grid.y[:, None]) < _SUPPORT_REACH
    middle = support.mean(axis=0)
    slope = np.linalg.lstsq(support[:, :2] - middle[:2], support[:, 2] - middle[2], rcond=None)[0]
    plane = slope[0] * (grid.x[None, :] - middle[0]) + slope[1] * (grid.y[:, None] - middle[1])
    return float(middle[2]), np.where(near, plane, 0.0), near.astype(float)
