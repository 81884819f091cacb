"""TerrainEncoder: any number of calibrated cameras → terrain map with its material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from monoforce_ros.camera import CameraModel
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.lift import depth_values, frustum_points, map_cells, splat
from monoforce_ros.motion import transform_points
from monoforce_ros.terrain import TerrainMap

# Mean and standard deviation of ImageNet's RGB pixels, which the backbones were trained with.
_MEAN = (0.485, 0.456, 0.406)
_DEVIATION = (0.229, 0.224, 0.225)
_FEATURE_STRIDE = 16


@dataclass(frozen=True)
class CameraView:
    """An image, its camera and where the camera stood."""

    image: np.ndarray
    """RGB pixels ``[height, width, 3]`` uint8, as the camera delivers them."""
    camera: CameraModel
    terrain_from_camera: np.ndarray
    """Pose ``[4, 4]`` of the camera in the terrain frame."""

    def __post_init__(self):
        size = (self.camera.height, self.camera.width)
        if self.image.ndim != 3 or self.image.shape[2] != 3:
            raise ValueError(f"image: got shape {self.image.shape}, expected [height, width, 3]")
        if self.image.shape[:2] != size:
            raise ValueError(
                f"image: got {self.image.shape[1]} × {self.image.shape[0]} px, but its CameraInfo says "
                f"{size[1]} × {size[0]} px"
            )


class TerrainEncoder(nn.Module):
    """Lift-splat-shoot with heads for geometric height, its decrease and the ground's material (paper III-A).

    The supporting height is H_t = H_g - H_d with H_d ≥ 0; stiffness, damping and friction are positive.
    """

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        self.backbone, channels = _backbone(config.backbone)
        self.lift = nn.Conv2d(channels, config.depth_bins + config.image_features, kernel_size=1)
        self.bird = _BirdsEyeNetwork(config.image_features + 1, config.map_features)
        self.heads = nn.Conv2d(config.map_features, 6, kernel_size=1)
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(_DEVIATION).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor, cells: Tensor, cameras: int) -> dict[str, Tensor]:
        """Predict maps.

        Args:
            images: RGB in 0..1, ``[B · cameras, 3, image_height, image_width]``.
            cells: map cell of each feature and depth, ``[B · cameras, bins, rows, columns]`` (:meth:`cells`).
            cameras: how many images belong to each map.

        Returns:
            ``geometric_height``, ``decrease``, ``height`` [m], ``stiffness`` [N/m³], ``damping`` [N s/m³],
            ``friction``, ``seen`` (how much image evidence a cell has, 0..1); each ``[B, rows, columns]``.
        """
        config, grid = self.config, self.config.grid
        lifted = self.lift(self.backbone((images - self.mean) / self.deviation))
        depth = lifted[:, : config.depth_bins].softmax(dim=1)
        size = grid.rows * grid.columns
        flat = splat(depth, lifted[:, config.depth_bins :], cells, size)
        flat = flat.unflatten(0, (-1, cameras)).sum(1)
        maps = flat.unflatten(2, (grid.rows, grid.columns))
        geometric, decrease, stiffness, damping, friction, _ = self.heads(self.bird(maps)).unbind(1)
        decrease = nn.functional.softplus(decrease - 3.0)
        return {
            "geometric_height": geometric,
            "decrease": decrease,
            "height": geometric - decrease,
            "stiffness": config.stiffness * torch.exp(stiffness.clamp(-4.0, 4.0)),
            "damping": config.damping * torch.exp(damping.clamp(-4.0, 4.0)),
            "friction": config.friction * torch.exp(friction.clamp(-3.0, 1.0)),
            "seen": maps[:, -1].clamp(max=1.0),
        }

    def cells(self, view: CameraView) -> Tensor:
        """Map cells ``[bins, rows, columns]`` of a view's feature map at every depth."""
        rows = -(-self.config.image_height // _FEATURE_STRIDE)
        columns = -(-self.config.image_width // _FEATURE_STRIDE)
        points = frustum_points(view.camera, rows, columns, depth_values(self.config))
        return torch.from_numpy(map_cells(transform_points(view.terrain_from_camera, points), self.config))

    def pixels(self, view: CameraView) -> Tensor:
        """A view's image as the network takes it, ``[3, image_height, image_width]`` in 0..1."""
        size = (self.config.image_width, self.config.image_height)
        resized = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
        return torch.from_numpy(resized).permute(2, 0, 1).float() / 255.0

    @torch.no_grad()
    def terrain(self, views: Sequence[CameraView]) -> TerrainMap:
        """Terrain map in the views' terrain frame; a cell counts as observed where the images carry evidence of it."""
        self.eval()
        device = self.mean.device
        images = torch.stack([self.pixels(view) for view in views]).to(device)
        cells = torch.stack([self.cells(view) for view in views]).to(device)
        maps = {name: value[0].cpu() for name, value in self(images, cells, len(views)).items()}
        return TerrainMap(
            height=maps["height"],
            geometric_height=maps["geometric_height"],
            stiffness=maps["stiffness"],
            damping=maps["damping"],
            friction=maps["friction"],
            observed=maps["seen"] > 0.05,
            grid=self.config.grid,
        )


def _backbone(name: str) -> tuple[nn.Module, int]:
    """The first stages of an ImageNet network, down to a sixteenth of the image's size, and their channels."""
    # torchvision takes seconds to import; a node that predicts from lidar need not wait for it.
    import torchvision

    network = getattr(torchvision.models, name)(weights=None).features
    # The stages up to the last one of stride 16.
    stages = {"mobilenet_v3_small": 9, "mobilenet_v3_large": 13}[name]
    trunk = nn.Sequential(*list(network.children())[:stages])
    channels = {"mobilenet_v3_small": 48, "mobilenet_v3_large": 112}[name]
    return trunk, channels


class _BirdsEyeNetwork(nn.Module):
    """A small U-shaped network that spreads evidence over the map and refines it."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.enter = _convolution(inputs, width)
        self.down = nn.ModuleList(_convolution(width * 2**i, width * 2 ** (i + 1), stride=2) for i in range(3))
        self.up = nn.ModuleList(_convolution(width * (2**i + 2 ** (i + 1)), width * 2**i) for i in reversed(range(3)))

    def forward(self, maps: Tensor) -> Tensor:
        levels = [self.enter(maps)]
        for down in self.down:
            levels.append(down(levels[-1]))
        result = levels.pop()
        for up in self.up:
            finer = levels.pop()
            raised = nn.functional.interpolate(result, size=finer.shape[-2:], mode="bilinear", align_corners=False)
            result = up(torch.cat([raised, finer], dim=1))
        return result


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel_size=3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
