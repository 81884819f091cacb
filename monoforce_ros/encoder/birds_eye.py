"""Bird's-eye-view network: propagates features over the map, fills unobserved cells and refines the result."""

from __future__ import annotations

from itertools import pairwise
from typing import override

import torch
from torch import Tensor, nn
from torch.nn import functional


class BirdsEyeNetwork(nn.Module):
    """U-Net with few channels at its finest level, where most of the cells are.

    Takes ``[B, inputs, rows, columns]`` and returns ``[B, width, rows, columns]``.
    """

    def __init__(self, inputs: int, width: int):
        super().__init__()
        widths = (width, 2 * width, 3 * width, 4 * width)
        self.enter = _block(inputs, width)
        self.down = nn.ModuleList(
            nn.Sequential(_block(fine, coarse, stride=2), _block(coarse, coarse)) for fine, coarse in pairwise(widths)
        )
        self.up = nn.ModuleList(_block(fine + coarse, fine) for coarse, fine in pairwise(reversed(widths)))

    @override
    def forward(self, maps: Tensor) -> Tensor:
        levels = [self.enter(maps)]
        for down in self.down:
            levels.append(down(levels[-1]))
        result = levels.pop()
        for up in self.up:
            finer = levels.pop()
            raised = functional.interpolate(result, size=finer.shape[-2:], mode="bilinear", align_corners=False)
            result = up(torch.cat([raised, finer], dim=1))
        return result


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel_size=3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
