"""Residuals between rolled-out and measured poses, shared by terrain fits and training."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.core import small_rotation


def trajectory_residual(
    position: Tensor, rotation: Tensor, measured_position: Tensor, measured_rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """Predicted minus measured position [m], and rotation vector measured → predicted [rad]; ``[..., 3]`` each.

    Args:
        position: predicted ``[..., 3]`` [m].
        rotation: predicted ``[..., 3, 3]``.
        measured_position: like ``position``.
        measured_rotation: like ``rotation``.
    """
    relative = measured_rotation.transpose(-1, -2) @ rotation
    return position - measured_position, torch.stack(small_rotation(relative), dim=-1)


def robust_loss(scaled: Tensor, delta: float) -> Tensor:
    """Huber loss of residuals in units of their scale, quadratic up to ``delta``."""
    return functional.huber_loss(scaled, torch.zeros_like(scaled), reduction="none", delta=delta)
