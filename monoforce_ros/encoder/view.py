"""CameraView and EncoderInput: images and their geometry as network input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from monoforce_ros.core import CameraModel
from monoforce_ros.encoder.config import HEIGHT_CHANNELS, SWEEP_CHANNELS, EncoderConfig
from monoforce_ros.encoder.lift import feature_rays
from monoforce_ros.encoder.sweep import cell_extremes, sweep_features
from monoforce_ros.terrain import Grid

_EMPTY = 127
"""Grey level of the part of the network's view that no image covers: zero after normalisation."""
_SUPPORT_REACH, _SUPPORT_END = 1.0, 2.5
"""Distances from the robot's centre up to which the plane under its wheels describes the ground, and from which on
level ground is the better guess [m]; both are larger for wheels further away than the first."""
_STEEPEST = 1.5
"""Limit of the plane's height relative to the robot's ground, as an input [m]."""


SUPPORT_CHANNELS = 4
"""Channels of :attr:`EncoderInput.support`."""


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
    """Input for a batch of ``B`` maps, each with any number of cameras; heights are relative to ``ground``."""

    images: Tensor
    """RGB uint8 ``[N, 3, image_height, image_width]``, images of all maps."""
    rays: Tensor
    """In terrain axes, scaled to 1 m along the optical axis, ``[N, feature rows, feature columns, 3]``; 0 where
    ``seen`` is False."""
    seen: Tensor
    """Whether a feature lies in the image and in the lens' field of view (bool) ``[N, feature rows, feature columns]``;
    the rest of the network's view is empty."""
    origins: Tensor
    """Camera positions in the terrain frame, z relative to ``ground``, ``[N, 3]`` [m]."""
    map_of: Tensor
    """Index of each image's map ``[N]`` int64."""
    support: Tensor
    """Plane under the wheels relative to ``ground`` [m], fading to level ground, and its weight 0..1; ground that the
    robot drove over relative to ``ground`` [m], and its mask; ``[B, 4, rows, columns]``. The plane fades because on
    hills shorter than the map its slope says nothing of ground further away; given the whole plane, an encoder
    extrapolates it."""
    ground: Tensor
    """Height of the ground under the robot in its terrain frame ``[B]`` [m]."""
    sweep: Tensor
    """Features of the lidar sweep, see :func:`~monoforce_ros.encoder.sweep.sweep_features`, all 0 without one;
    ``[B, 8, rows, columns]``."""

    @property
    def maps(self) -> int:
        """Number of maps."""
        return len(self.ground)

    @property
    def anchor(self) -> Tensor:
        """Ground that carries the robot, which predicted heights correct, relative to ``ground`` [m]
        ``[B, rows, columns]``: the plane under the wheels, and level ground further away."""
        return self.support[:, 0]

    def to(self, device: torch.device | str) -> EncoderInput:
        """The same on another device."""
        return EncoderInput(**{f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)})

    def with_images(self, count: int) -> EncoderInput:
        """The same with unseen copies of its images, ``count`` images in all; none are added to none.

        Maps do not change. On a GPU each new number of images takes a second or so, in which kernels are chosen.
        """
        present = len(self.images)
        if not present or count <= present:
            return self
        index = torch.arange(count, device=self.images.device) % present
        copied = {name: getattr(self, name)[index] for name in ("images", "rays", "seen", "origins", "map_of")}
        copied["seen"][present:] = False
        return replace(self, **copied)

    @classmethod
    def stack(cls, inputs: Sequence[EncoderInput]) -> EncoderInput:
        """A batch of inputs."""
        joined = {f.name: torch.cat([getattr(entry, f.name) for entry in inputs]) for f in fields(cls)}
        starts = np.cumsum([0, *(entry.maps for entry in inputs[:-1])])
        joined["map_of"] = torch.cat([i.map_of + int(start) for i, start in zip(inputs, starts, strict=True)])
        return cls(**joined)


def encoder_input(
    views: Sequence[CameraView],
    support: np.ndarray | None,
    config: EncoderConfig,
    *,
    sweep: np.ndarray | None = None,
    trace: np.ndarray | None = None,
) -> EncoderInput:
    """Input for one map.

    Args:
        views: one view per camera, in one terrain frame; may be empty.
        support: contact points of the wheels ``[m, 3]`` in that frame [m]; without them the ground is assumed to be at
            the height of the frame's origin.
        config: configuration of the encoder.
        sweep: lidar points ``[n, 3]`` in that frame [m], without points on the robot.
        trace: ground that the robot has driven over ``[k, 3]`` in that frame [m].
    """
    shape = (config.feature_rows, config.feature_columns)
    images = [network_image(view.image, config) for view in views]
    rays = [feature_rays(view.camera, *shape) @ view.terrain_from_camera[:3, :3].T for view in views]
    origins = [view.terrain_from_camera[:3, 3] for view in views]
    return assemble(images, rays, origins, support, config, sweep=sweep, trace=trace)


def assemble(
    images: Sequence[np.ndarray],
    rays: Sequence[np.ndarray],
    origins: Sequence[np.ndarray],
    support: np.ndarray | None,
    config: EncoderConfig,
    *,
    sweep: np.ndarray | None = None,
    trace: np.ndarray | None = None,
) -> EncoderInput:
    """Input for one map from images at the network's size ``[height, width, 3]``, their rays ``[rows, columns, 3]``
    (NaN where there is no image) and origins ``[3]``; see :func:`encoder_input`."""
    ground, plane, near = support_plane(support, config.grid)
    hits, traced = np.zeros((SWEEP_CHANNELS, *plane.shape)), np.zeros((HEIGHT_CHANNELS, *plane.shape))
    if sweep is not None and config.takes_sweeps:
        hits = sweep_features(sweep, ground, config, support)
    if trace is not None and len(trace):
        traced = cell_extremes(trace, ground, config)
    count = len(images)
    size = (count, config.image_height, config.image_width, 3)
    pixels = np.stack(images) if count else np.zeros(size, np.uint8)
    placed = np.stack(rays) if count else np.zeros((0, config.feature_rows, config.feature_columns, 3))
    seen = np.isfinite(placed).all(axis=-1)
    at = np.stack(origins) if count else np.zeros((0, 3))
    return EncoderInput(
        images=torch.from_numpy(pixels).permute(0, 3, 1, 2).contiguous(),
        rays=torch.as_tensor(np.where(seen[..., None], placed, 0.0), dtype=torch.float32),
        seen=torch.from_numpy(seen),
        origins=torch.as_tensor(at - np.array([0.0, 0.0, ground]), dtype=torch.float32),
        map_of=torch.zeros(count, dtype=torch.int64),
        # The mean of a cell's lowest and highest trace point is its height.
        support=torch.as_tensor(
            np.stack([plane * near, near, (traced[0] + traced[1]) / 2, traced[2]])[None], dtype=torch.float32
        ),
        ground=torch.tensor([ground], dtype=torch.float32),
        sweep=torch.as_tensor(hits[None], dtype=torch.float32),
    )


def network_image(image: np.ndarray, config: EncoderConfig) -> np.ndarray:
    """The image resized for the network; it keeps its aspect ratio, the rest of the view is grey."""
    size = (config.image_width, config.image_height)
    height, width = image.shape[:2]
    if (width, height) == size:
        return np.ascontiguousarray(image)
    scale = min(size[0] / width, size[1] / height)
    resized = cv2.resize(
        image, (max(1, round(width * scale)), max(1, round(height * scale))), interpolation=cv2.INTER_AREA
    )
    if resized.shape[1::-1] == size:
        return resized
    view = np.full((size[1], size[0], 3), _EMPTY, np.uint8)
    top, left = (size[1] - resized.shape[0]) // 2, (size[0] - resized.shape[1]) // 2
    view[top : top + resized.shape[0], left : left + resized.shape[1]] = resized
    return view


def support_plane(support: np.ndarray | None, grid: Grid) -> tuple[float, np.ndarray, np.ndarray]:
    """Height of the ground under the robot [m]; the plane under its wheels relative to it [m]; where it holds, 0..1."""
    shape = (grid.rows, grid.columns)
    if support is None or len(support) < 3:
        return 0.0, np.zeros(shape), np.zeros(shape)
    distance = np.hypot(grid.x[None, :], grid.y[:, None])
    # Of a long robot at least as far as its own wheels.
    beyond = max(0.0, float(np.hypot(*support[:, :2].T).max()) - _SUPPORT_REACH)
    near = np.clip((_SUPPORT_END + beyond - distance) / (_SUPPORT_END - _SUPPORT_REACH), 0.0, 1.0)
    middle = support.mean(axis=0)
    slope = np.linalg.lstsq(support[:, :2] - middle[:2], support[:, 2] - middle[2], rcond=None)[0]
    plane = slope[0] * (grid.x[None, :] - middle[0]) + slope[1] * (grid.y[:, None] - middle[1])
    return float(middle[2]), plane.clip(-_STEEPEST, _STEEPEST), near
