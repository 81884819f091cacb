"""Commands too small to move the drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory


class ActuatorDeadband(Effect):
    """Commands too small to move the drives."""

    name = "actuator_deadband"
    stage = "command"
    summary = "The drives ignore commanded speeds below the width; faster ones are reduced by it."
    formula = "u ← sign(u) max(|u| - width, 0)"
    source = "static friction in motor and gear"
    cause = "small commands that the drives ignore"
    remedy = "look at the smallest output of the motor controller, and for friction in motor and gear"
    parameters = (Parameter("width", "m/s", 0.0, 0.0, 1.0, 0.05, "half width of the dead band"),)
    order = 20
    identified = ("width",)
    manoeuvre = "slow and fast stretches straight ahead"
    separated_by: ClassVar = {"drive_gain": "slow and fast stretches straight ahead"}
    wheel_response = WheelResponse(
        parameter="width",
        speeds=lambda speeds, value, step: np.sign(speeds) * np.maximum(np.abs(speeds) - value, 0.0),
        starts=lambda fastest: (0.05 * fastest.speed,),
        bounds=lambda fastest: (0.0, 0.6 * fastest.speed),
        # 4 cm in a window of 2 s; a choice, not calibrated.
        counts=lambda value, fastest: value >= 0.02,
        wording="slower by {:.2f} m/s",
        excludes=("actuator_saturation", "drive_gain"),
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        width = per_trajectory(values["width"], 3)
        return torch.sign(speeds) * (speeds.abs() - width).clamp_min(0.0)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The drives ignore commands below {values['width']:.2f} m/s, and run slower by as much above."
