"""Inference: faster encoders by folding norms and borders into convolutions, packed weights and bfloat16."""

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

from monoforce_ros.encoder.backbone import NormedConvolution
from monoforce_ros.encoder.checkpoint import Encoder
from monoforce_ros.encoder.terrain_encoder import TerrainEncoder

PRECISIONS = ("auto", "float32", "bfloat16")


def fused(encoder: Encoder, precision: str = "float32") -> Encoder:
    """A faster copy with the same predictions, which can no longer be trained or saved.

    Args:
        encoder: loaded encoder.
        precision: of the convolutions: ``float32``; ``bfloat16``, 1.5 times as fast on processors with bfloat16
            instructions, heights within a few millimetres; ``auto``, bfloat16 where the processor supports it. Heads,
            depths and the splat stay float32.

    Raises:
        ValueError: the precision is unknown.
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
        if isinstance(parent, NormedConvolution) and parent.asymmetric:
            parent.conv = _with_symmetric_padding(parent.conv)
            parent.asymmetric = False
    encoder.requires_grad_(False)
    if precision == "bfloat16" or (precision == "auto" and multiplies_bfloat16()):
        for name, part in encoder.named_children():
            if name != "heads":
                for convolution in part.modules():
                    if isinstance(convolution, nn.Conv2d):
                        convolution.weight.data = _rounded(convolution.weight.data)
                part.to(torch.bfloat16)
    if isinstance(encoder, TerrainEncoder):
        encoder.bird.keep_last(encoder.other_inputs)
    return encoder.to(memory_format=torch.channels_last)


def packed(encoder: Encoder) -> Encoder:
    """A fused encoder whose weights are pre-packed in oneDNN's memory layout, with activations fused; changed in place.

    The encoder must stay on the CPU. Convolutions stay as they are in a type that oneDNN does not pack here: all if
    PyTorch was built without oneDNN, those in bfloat16 on processors without AVX-512.
    """
    for parent in list(encoder.modules()):
        if isinstance(parent, NormedConvolution):
            activation = _ACTIVATIONS[nn.ReLU6 if parent.bounded else None]
            convolutions = {name: part for name, part in parent.named_children() if isinstance(part, nn.Conv2d)}
            if not all(map(_packs, convolutions.values())):
                continue
            for name, part in convolutions.items():
                setattr(parent, name, _PackedConvolution(part, activation))
            parent.bounded = False
        elif isinstance(parent, nn.Sequential):
            _pack_sequence(parent)
    if _packs(encoder.heads):
        encoder.register_module("heads", _PackedConvolution(encoder.heads, _ACTIVATIONS[None]))
    return encoder


def _pack_sequence(parent: nn.Sequential) -> None:
    parts = [(name, part) for name, part in parent.named_children() if not isinstance(part, nn.Identity)]
    for (name, part), (next_name, following) in pairwise([*parts, ("", None)]):
        if isinstance(part, nn.Conv2d) and _packs(part):
            activation = type(following) if type(following) in _ACTIVATIONS else None
            setattr(parent, name, _PackedConvolution(part, _ACTIVATIONS[activation]))
            if activation is not None:
                setattr(parent, next_name, nn.Identity())


_ACTIVATIONS: dict[type | None, tuple[str, list[float]]] = {
    None: ("none", []),
    nn.ReLU: ("relu", []),
    nn.ReLU6: ("hardtanh", [0.0, 6.0]),
}
"""oneDNN's name and parameters of each activation."""


class _PackedConvolution(nn.Module):
    """Convolution with a fused activation, by oneDNN."""

    def __init__(self, convolution: nn.Conv2d, activation: tuple[str, list[float]]):
        super().__init__()
        self.weight, self.bias = convolution.weight, convolution.bias
        self.kernel_size = convolution.kernel_size
        geometry = (convolution.padding, convolution.stride, convolution.dilation)
        self.geometry = (*(list(values) for values in geometry), convolution.groups)
        self.activation, self.parameters_of_activation = activation
        self.packed_weight: Tensor | None = None

    @override
    def forward(self, features: Tensor) -> Tensor:
        if self.packed_weight is None:
            # The best layout depends on the size of the first images; other sizes still work.
            weight = self.weight.contiguous()
            size = list(features.shape)
            self.packed_weight = torch.ops.mkldnn._reorder_convolution_weight(weight, *self.geometry, size)
        return torch.ops.mkldnn._convolution_pointwise(
            features, self.packed_weight, self.bias, *self.geometry, self.activation, self.parameters_of_activation, ""
        )


def _packs(convolution: nn.Conv2d) -> bool:
    return _can_pack(convolution.weight.dtype)


@cache
def _can_pack(dtype: torch.dtype) -> bool:
    """Whether PyTorch has the operations of :class:`_PackedConvolution` for this processor, and they are right."""
    # No random numbers: the caller's random state must not change.
    plain = skip_init(nn.Conv2d, 4, 4, 3, padding=1).requires_grad_(False)
    plain.weight.copy_(torch.linspace(-0.1, 0.1, 144).view(4, 4, 3, 3))
    plain.bias.copy_(torch.linspace(-1.0, 1.0, 4))
    plain = plain.to(dtype)
    features = torch.linspace(-8.0, 8.0, 4 * 64).view(1, 4, 8, 8).to(dtype)
    try:
        found = _PackedConvolution(plain, _ACTIVATIONS[nn.ReLU6])(features)
    except (AttributeError, RuntimeError):
        return False
    # Values up to 6: bfloat16 has 8 significant bits.
    return torch.allclose(found, functional.relu6(plain(features)), atol=1e-4 if dtype == torch.float32 else 0.1)


def _rounded(weight: Tensor) -> Tensor:
    """Weights ``[outputs, ...]`` rounded to bfloat16 with error diffusion, so that each filter keeps its sum.

    Features after a ReLU are positive, so rounding errors that do not cancel shift a whole channel. They cause half of
    the height error of bfloat16.
    """
    flat = weight.flatten(1).double()
    carried = torch.zeros_like(flat[:, 0])
    rounded = torch.empty_like(flat)
    for i, column in enumerate(flat.unbind(1)):
        exact = column + carried
        rounded[:, i] = exact.to(torch.bfloat16)
        carried = exact - rounded[:, i]
    return rounded.view_as(weight).to(weight.dtype)


def _with_symmetric_padding(convolution: nn.Conv2d) -> nn.Conv2d:
    """An equivalent of an asymmetrically padded convolution of stride 2 that pads all sides alike.

    A leading row and column of zeros in the kernel shift it by one pixel, which saves a padded copy of the features.
    """
    kernel = convolution.kernel_size[0]
    shifted = nn.Conv2d(
        convolution.in_channels, convolution.out_channels, kernel + 1, stride=2, padding=kernel // 2,
        groups=convolution.groups,
    )  # fmt: skip
    weight: Tensor = functional.pad(convolution.weight.detach(), (1, 0, 1, 0))
    shifted.weight, shifted.bias = nn.Parameter(weight), convolution.bias
    return shifted


@cache
def multiplies_bfloat16() -> bool:
    """Whether the processor has bfloat16 multiplication (AVX-512 BF16, AMX, Arm BF16)."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    flags = next((line for line in text.splitlines() if line.lower().startswith(("flags", "features"))), "")
    return bool({"avx512_bf16", "amx_bf16", "bf16"} & set(flags.split()))
