"""First order: the lag of a servo that approaches its command exponentially."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def lagged(signal: Tensor, time_constant: Tensor, time_step: float) -> Tensor:
    """A signal ``[B, T, D]`` after a first-order lag; its first value is assumed to have been reached.

    Args:
        signal: commanded values ``[B, T, D]``.
        time_constant: a scalar or ``[B]`` [s]; 0 returns the signal bit for bit.
        time_step: time between values [s].
    """
    # exp(-Δt/τ); at τ = 0 the quotient stays finite and the gradient is zero.
    slow = time_constant > 1e-6
    safe = torch.where(slow, time_constant, torch.ones_like(time_constant))
    retained = torch.where(slow, torch.exp(-time_step / safe), torch.zeros_like(time_constant))
    return _recurrence(signal, retained.reshape(-1))


def _recurrence(speeds: Tensor, retained: Tensor) -> Tensor:
    """The lag ``[B, T, D]`` of commands, the first of which also held before the start.

    The linear recurrence is solved within blocks of √T steps by a matrix, and in the same way over their ends: its cost
    grows with T^1.5, and a trajectory may have a time constant of its own.

    Args:
        speeds: ``[B, T, D]``.
        retained: share of the previous speed that is left after a step, ``[1]`` or ``[B]``.
    """
    batch, steps, drives = speeds.shape
    length = math.isqrt(max(steps - 1, 0)) + 1
    count = -(-steps // length)
    padded = torch.nn.functional.pad(speeds.transpose(1, 2), (0, count * length - steps))
    within = _response(padded.reshape(batch, drives * count, length), retained, 1.0 - retained)
    across = retained**length
    ends = within.reshape(batch, drives, count, length)[..., -1]
    # What a block starts with: the end of the one before it, or the first command.
    entering = torch.cat([speeds[:, :1].transpose(1, 2), ends[..., :-1]], dim=2)
    carried = _response(entering, across, torch.ones_like(across))
    powers = retained[:, None] ** torch.arange(1, length + 1, device=speeds.device)
    result = within.reshape(batch, drives, count, length) + carried[..., None] * powers[:, None, None]
    return result.reshape(batch, drives, -1)[..., :steps].transpose(1, 2)


def _response(inputs: Tensor, retained: Tensor, gain: Tensor) -> Tensor:
    """Sums of all previous ``inputs`` ``[B, R, N]``, each weaker by ``retained`` after every step."""
    steps = torch.arange(inputs.shape[-1], device=inputs.device)
    distance = steps[:, None] - steps
    weights = (gain[:, None, None] * retained[:, None, None] ** distance.clamp_min(0)).tril()
    return inputs @ (weights[0].T if len(retained) == 1 else weights.mT)
