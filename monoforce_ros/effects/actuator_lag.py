"""First-order lag of the drives."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse
from monoforce_ros.effects.ramp import at_stamps


def _lagging(speeds: np.ndarray, value: float, step: float) -> np.ndarray:
    if value <= 1e-4:
        return speeds
    decay = np.exp(-step / value)
    return at_stamps(lfilter([1.0 - decay], [1.0, -decay], speeds, axis=-1, zi=decay * speeds[..., :1])[0])


class ActuatorLag(Effect):
    """First-order lag of the drives."""

    name = "actuator_lag"
    stage = "command"
    summary = "The drives approach the commanded speed exponentially."
    formula = "du/dt = (u_cmd - u) / τ"
    source = "first-order servo response"
    parameters = (Parameter("time_constant", "s", 0.0, 0.0, 3.0, 0.2, "time to reach 63 % of a step"),)
    order = 40
    identified = ("time_constant",)
    manoeuvre = "steps of the speed from standing"
    commissioning_start: ClassVar = {"time_constant": 0.03}
    wheel_response = WheelResponse(
        parameter="time_constant",
        speeds=_lagging,
        starts=lambda fastest: (0.1, 0.4),
        bounds=lambda fastest: (0.0, 3.0),
        counts=lambda value, fastest: value >= 0.08,
        wording="with a time constant of {:.2f} s",
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        constant = values["time_constant"]
        # exp(-Δt/τ); at τ = 0 the quotient stays finite and the gradient is zero.
        slow = constant > 1e-6
        safe = torch.where(slow, constant, torch.ones_like(constant))
        retained = torch.where(slow, torch.exp(-time_step / safe), torch.zeros_like(constant))
        return _lagged(speeds, retained.reshape(-1))


def _lagged(speeds: Tensor, retained: Tensor) -> Tensor:
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
