"""How far rolled-out poses are from measured ones, in units of what may be ignored; shared by fits and training."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.core import small_rotation


def trajectory_residual(
    position: Tensor, rotation: Tensor, measured_position: Tensor, measured_rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """Predicted minus measured position [m] and the rotation vector between both [rad], ``[..., 3]`` each.

    Args:
        position: predicted ``[..., 3]`` [m].
        rotation: predicted ``[..., 3, 3]``.
        measured_position: as ``position``.
        measured_rotation: as ``rotation``.
    """
    relative = measured_rotation.transpose(-1, -2) @ rotation
    return position - measured_position, torch.stack(small_rotation(relative), dim=-1)


def robust_loss(scaled: Tensor, delta: float) -> Tensor:
    """Huber's loss of each residual in units of its scale."""
    return functional.huber_loss(scaled, torch.zeros_like(scaled), reduction="none", delta=delta)
