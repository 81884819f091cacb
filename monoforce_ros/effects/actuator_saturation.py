"""Largest speed that the drives reach."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class ActuatorSaturation(Effect):
    """Largest speed that the drives reach."""

    name = "actuator_saturation"
    stage = "command"
    summary = "Faster commands are reached to this speed only."
    formula = "u ← clamp(u, -limit, limit)"
    source = "limited voltage of the motors"
    parameters = (Parameter("limit", "m/s", math.inf, 0.05, 20.0, 1.0, "largest surface speed of a drive"),)

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect in them; see :class:`Effect`."""
        limit = per_trajectory(values["limit"], 3)
        return torch.minimum(torch.maximum(speeds, -limit), limit)
