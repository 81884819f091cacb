"""Inference: an encoder made fast for prediction: norms and borders folded into convolutions, half precision."""

from __future__ import annotations

import copy
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import override

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import fuse_conv_bn_eval, skip_init

from monoforce_ros.encoder.checkpoint import Encoder

PRECISIONS = ("auto", "float32", "bfloat16")


def fused(encoder: Encoder, precision: str = "float32") -> Encoder:
    """A copy that predicts the same, faster; it cannot be trained nor saved any more.

    Args:
        encoder: as loaded.
        precision: of the convolutions: ``float32``; ``bfloat16``, half as fast again on processors that multiply it,
            with heights within a few millimetres; ``auto`` takes it where the processor does. Heads, depths and the
            splat stay float32.

    Raises:
        ValueError: there is no such precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"encoder precision: got {precision!r}, expected one of {PRECISIONS}")
    encoder = copy.deepcopy(encoder).eval()
    for parent in list(encoder.modules()):
        names = [name for name, _ in parent.named_children()]
        for first, second in pairwise(names):
            convolution, norm = getattr(parent, first), getattr(parent, second)
            if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(parent, first, fuse_conv_bn_eval(convolution, norm))
                setattr(parent, second, nn.Identity())
        if getattr(parent, "beyond", 0):
            parent.conv = _with_border(parent.conv)
            parent.beyond = 0
    encoder.requires_grad_(False)
    if precision == "bfloat16" or (precision == "auto" and multiplies_bfloat16()):
        for name, part in encoder.named_children():
            if name != "heads":
                for convolution in part.modules():
                    if isinstance(convolution, nn.Conv2d):
                        convolution.weight.data = _rounded(convolution.weight.data)
                part.to(torch.bfloat16)
    return encoder.to(memory_format=torch.channels_last)


def packed(encoder: Encoder) -> Encoder:
    """A fused encoder with its convolutions' weights laid out once as the processor multiplies them; changed in place.

    A convolution bounds its own output then, in place of an operation that reads and writes all of it again. That is
    oneDNN's doing: the encoder must stay on the CPU, and is returned as it is where PyTorch comes without oneDNN.
    """
    if not _packs():
        return encoder
    for parent in list(encoder.modules()):
        if getattr(parent, "bounded", None) is not None:
            parent.conv = _PackedConvolution(parent.conv, _BOUNDS[nn.ReLU6 if parent.bounded else None])
            parent.bounded = False
        elif isinstance(parent, nn.Sequential):
            _pack_sequence(parent)
    return encoder


def _pack_sequence(parent: nn.Sequential) -> None:
    parts = [(name, part) for name, part in parent.named_children() if not isinstance(part, nn.Identity)]
    for (name, part), (next_name, following) in pairwise([*parts, ("", None)]):
        if isinstance(part, nn.Conv2d):
            bound = type(following) if type(following) in _BOUNDS else None
            setattr(parent, name, _PackedConvolution(part, _BOUNDS[bound]))
            if bound is not None:
                setattr(parent, next_name, nn.Identity())


_BOUNDS: dict[type | None, tuple[str, list[float]]] = {
    None: ("none", []),
    nn.ReLU: ("relu", []),
    nn.ReLU6: ("hardtanh", [0.0, 6.0]),
}
"""What oneDNN calls a bound, and its values."""


class _PackedConvolution(nn.Module):
    """A convolution and the bound of its output, by oneDNN."""

    def __init__(self, convolution: nn.Conv2d, bound: tuple[str, list[float]]):
        super().__init__()
        self.weight, self.bias = convolution.weight, convolution.bias
        self.kernel_size = convolution.kernel_size
        placing = (convolution.padding, convolution.stride, convolution.dilation)
        self.placing = (*(list(values) for values in placing), convolution.groups)
        self.bound, self.values = bound
        self.laid_out: Tensor | None = None

    @override
    def forward(self, features: Tensor) -> Tensor:
        if self.laid_out is None:
            # The best layout depends on the size of the images, which comes with the first one; any other works too.
            weight = self.weight.contiguous()
            size = list(features.shape)
            self.laid_out = torch.ops.mkldnn._reorder_convolution_weight(weight, *self.placing, size)
        return torch.ops.mkldnn._convolution_pointwise(
            features, self.laid_out, self.bias, *self.placing, self.bound, self.values, ""
        )


@cache
def _packs() -> bool:
    """Whether this PyTorch offers what :class:`_PackedConvolution` calls, tried and found right."""
    # Not drawn at random: whoever has set a seed gets the numbers that follow from it.
    plain = skip_init(nn.Conv2d, 4, 4, 3, padding=1).requires_grad_(False)
    plain.weight.copy_(torch.linspace(-0.1, 0.1, 144).view(4, 4, 3, 3))
    plain.bias.copy_(torch.linspace(-1.0, 1.0, 4))
    features = torch.linspace(-8.0, 8.0, 4 * 64).view(1, 4, 8, 8)
    try:
        found = _PackedConvolution(plain, _BOUNDS[nn.ReLU6])(features)
    except (AttributeError, RuntimeError):
        return False
    return torch.allclose(found, functional.relu6(plain(features)), atol=1e-4)


def _rounded(weight: Tensor) -> Tensor:
    """Weights ``[outputs, ...]`` that bfloat16 holds, rounded so that each filter keeps its sum.

    What is lost at one weight is added to the next. Features behind a rectifier are positive, so errors that do not
    cancel would shift all of a channel: half of what bfloat16 costs in heights.
    """
    flat = weight.flatten(1).double()
    carried = torch.zeros_like(flat[:, 0])
    rounded = torch.empty_like(flat)
    for i, column in enumerate(flat.unbind(1)):
        wanted = column + carried
        rounded[:, i] = wanted.to(torch.bfloat16)
        carried = wanted - rounded[:, i]
    return rounded.view_as(weight).to(weight.dtype)


def _with_border(convolution: nn.Conv2d) -> nn.Conv2d:
    """A convolution of stride 2 that pads all sides alike, in place of one that expects a border on two of them.

    A row and a column of zeros before the weights shift it by one pixel; a padded copy of the image is not needed.
    """
    kernel = convolution.kernel_size[0]
    shifted = nn.Conv2d(
        convolution.in_channels, convolution.out_channels, kernel + 1, convolution.stride, padding=kernel // 2,
        groups=convolution.groups,
    )  # fmt: skip
    weight: Tensor = functional.pad(convolution.weight.detach(), (1, 0, 1, 0))
    shifted.weight, shifted.bias = nn.Parameter(weight), convolution.bias
    return shifted


@cache
def multiplies_bfloat16() -> bool:
    """Whether the processor has instructions for products of bfloat16 (AVX-512 BF16, AMX, Arm BF16)."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    flags = next((line for line in text.splitlines() if line.lower().startswith(("flags", "features"))), "")
    return bool({"avx512_bf16", "amx_bf16", "bf16"} & set(flags.split()))
