"""Image context: what one feature of an image has to know of the rest of it."""

from __future__ import annotations

from typing import override

import torch
from torch import Tensor, nn

_DILATIONS = (1, 2, 4, 8, 1)
"""Of the blocks at stride 16: together they reach 16 features to each side, most of an image of 20 × 15 features."""


class ImageContext(nn.Module):
    """Residual dilated convolutions over the coarse features (Yu and Koltun, "Multi-scale context aggregation", 2016).

    The depth of a wall without texture follows from where its foot stands on the ground, which may be half an image
    away; a backbone trained to name objects does not pass that on.

    Takes ``[N, inputs, rows, columns]`` and returns ``[N, width, rows, columns]``.
    """

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.enter = _unit(inputs, width, kernel=1)
        self.blocks = nn.ModuleList(_unit(width, width, kernel=3, dilation=dilation) for dilation in _DILATIONS)

    @override
    def forward(self, features: Tensor) -> Tensor:
        features = self.enter(features)
        for block in self.blocks:
            features = features + block(features)
        return features


def _unit(inputs: int, outputs: int, kernel: int, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def resized(features: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """Features ``[N, C, rows, columns]`` at another resolution, interpolated."""
    return nn.functional.interpolate(features, size=size, mode="bilinear", align_corners=False)
