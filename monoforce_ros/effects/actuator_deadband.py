"""Commands too small to move the drives."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class ActuatorDeadband(Effect):
    """Commands too small to move the drives."""

    name = "actuator_deadband"
    stage = "command"
    summary = "The drives do not answer to speeds below the band, and to faster ones less it."
    formula = "u ← sign(u) max(|u| - width, 0)"
    source = "static friction in motor and gear"
    parameters = (Parameter("width", "m/s", 0.0, 0.0, 1.0, 0.05, "half width of the band"),)

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect in them; see :class:`Effect`."""
        width = per_trajectory(values["width"], 3)
        return torch.sign(speeds) * (speeds.abs() - width).clamp_min(0.0)
