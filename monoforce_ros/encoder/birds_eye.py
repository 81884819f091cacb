"""Bird's-eye-view network: propagates features over the map, fills unobserved cells and refines the result."""

from __future__ import annotations

from itertools import pairwise
from typing import override

import torch
from torch import Tensor, nn
from torch.nn import functional


class BirdsEyeNetwork(nn.Module):
    """U-Net with few channels at its finest level, where most of the cells are.

    Takes ``[B, inputs, rows, columns]`` and returns ``[B, width, rows, columns]``. The first inputs may be left out;
    they count as zeros.
    """

    def __init__(self, inputs: int, width: int):
        super().__init__()
        widths = (width, 2 * width, 3 * width, 4 * width)
        self._inputs = inputs
        self.enter_last: nn.Sequential | None = None
        self.enter = _block(inputs, width)
        self.down = nn.ModuleList(
            nn.Sequential(_block(fine, coarse, stride=2), _block(coarse, coarse)) for fine, coarse in pairwise(widths)
        )
        self.up = nn.ModuleList(_block(fine + coarse, fine) for coarse, fine in pairwise(reversed(widths)))

    @override
    def forward(self, maps: Tensor) -> Tensor:
        left_out = self._inputs - maps.shape[1]
        if left_out and self.enter_last is not None:
            levels = [self.enter_last(maps)]
        else:
            levels = [self.enter(functional.pad(maps, (0, 0, 0, 0, left_out, 0)) if left_out else maps)]
        for down in self.down:
            levels.append(down(levels[-1]))
        result = levels.pop()
        for up in self.up:
            finer = levels.pop()
            raised = functional.interpolate(result, size=finer.shape[-2:], mode="bilinear", align_corners=False)
            result = up(torch.cat([raised, finer], dim=1))
        return result

    @property
    def dtype(self) -> torch.dtype:
        """Of its weights."""
        return next(self.parameters()).dtype

    def keep_last(self, count: int) -> None:
        """Keep a copy of the first layer for maps of the last ``count`` inputs alone; the weights must not change any
        more. Three quarters of this layer's products are with zeros where there are no images."""
        whole, *others = self.enter
        assert isinstance(whole, nn.Conv2d)
        last = nn.Conv2d(count, whole.out_channels, kernel_size=3, padding=1, bias=whole.bias is not None)
        last.weight = nn.Parameter(whole.weight.detach()[:, -count:].clone(), requires_grad=False)
        last.bias = whole.bias
        self.enter_last = nn.Sequential(last, *others).train(self.training)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel_size=3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
