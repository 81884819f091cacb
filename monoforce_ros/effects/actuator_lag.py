"""First-order lag of the drives."""

from __future__ import annotations

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
        if constant.ndim:
            return _by_doubling(speeds, retained[:, None, None])
        count = speeds.shape[1]
        steps = torch.arange(count, device=speeds.device)
        distance = (steps[:, None] - steps).to(speeds.dtype)
        # The response to all previous commands as one matrix. The first command also holds before the start.
        decay = retained ** distance.clamp_min(0.0)
        weights = torch.where(distance >= 0, (1.0 - retained) * decay, torch.zeros_like(decay))
        return torch.where(slow, weights @ speeds + (decay[:, :1] * retained) * speeds[:, :1], speeds)


def _by_doubling(speeds: Tensor, retained: Tensor) -> Tensor:
    """The lag with one time constant per trajectory, for which one matrix each would be large.

    The linear recurrence is solved by doubling the number of terms in each pass (Hillis and Steele 1986).
    """
    result = torch.cat([speeds[:, :1], (1.0 - retained) * speeds[:, 1:]], dim=1)
    reach, factor = 1, retained
    while reach < speeds.shape[1]:
        result = torch.cat([result[:, :reach], result[:, reach:] + factor * result[:, :-reach]], dim=1)
        reach, factor = 2 * reach, factor * factor
    return result
