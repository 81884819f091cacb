"""Servo: how the angle of a joint follows its command, with a lag and a limited rate."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def servo_response(
    targets: Tensor, start: Tensor, time_constants: Tensor, rates: Tensor, time_step: float
) -> tuple[Tensor, Tensor]:
    """Angles and rates of joints that follow their commands.

    Each step approaches the command by ``1 - exp(-Δt/τ)`` of the distance, at most by the largest rate.

    Args:
        targets: commanded angles ``[B, T, J]`` [rad].
        start: angles at the beginning ``[B, J]`` [rad].
        time_constants: lag of each joint ``[J]`` [s]; 0 reaches the command within a step.
        rates: largest rate of each joint ``[J]`` [rad/s], may be infinite.
        time_step: [s].

    Returns:
        angles at the beginning of each step and rates during it, each ``[B, T, J]``.
    """
    share = 1.0 - torch.exp(-time_step / time_constants.clamp_min(1e-9)).to(targets)
    reach = (rates * time_step).to(targets)
    if torch.is_grad_enabled() and (targets.requires_grad or start.requires_grad):
        angle, listed = start, [start]
        for target in targets.unbind(1):
            angle = angle + torch.minimum(torch.maximum(share * (target - angle), -reach), reach)
            listed.append(angle)
        angles = torch.stack(listed, 1)
    else:
        angles = torch.from_numpy(
            _response(targets.cpu().numpy(), start.cpu().numpy(), share.cpu().numpy(), reach.cpu().numpy())
        ).to(targets)
    return angles[:, :-1], (angles[:, 1:] - angles[:, :-1]) / time_step


def _response(targets: np.ndarray, start: np.ndarray, share: np.ndarray, reach: np.ndarray) -> np.ndarray:
    # Time first: each step then reads contiguous memory. torch takes several times longer for so little work per step.
    wanted = np.ascontiguousarray(np.moveaxis(targets, 1, 0))
    result = np.empty((len(wanted) + 1, *start.shape), wanted.dtype)
    result[0] = angle = start
    for index, target in enumerate(wanted, start=1):
        angle = angle + np.clip(share * (target - angle), -reach, reach)
        result[index] = angle
    return np.moveaxis(result, 0, 1)
