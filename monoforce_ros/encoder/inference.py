"""Inference: an encoder with its batch norms folded into the convolutions, laid out for the processor."""

from __future__ import annotations

import copy
from itertools import pairwise

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from monoforce_ros.encoder.checkpoint import Encoder


def fused(encoder: Encoder) -> Encoder:
    """A copy that predicts the same, faster; it cannot be trained nor saved any more."""
    encoder = copy.deepcopy(encoder).eval()
    for parent in list(encoder.modules()):
        names = [name for name, _ in parent.named_children()]
        for first, second in pairwise(names):
            convolution, norm = getattr(parent, first), getattr(parent, second)
            if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(parent, first, fuse_conv_bn_eval(convolution, norm))
                setattr(parent, second, nn.Identity())
    encoder.requires_grad_(False)
    return encoder.to(memory_format=torch.channels_last)
