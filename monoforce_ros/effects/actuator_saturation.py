"""Largest speed of the drives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory
from monoforce_ros.robots import RobotModel


class ActuatorSaturation(Effect):
    """Largest speed of the drives."""

    name = "actuator_saturation"
    stage = "command"
    summary = "The drives do not exceed this speed."
    formula = "u ← clamp(u, -limit, limit)"
    source = "limited voltage of the motors"
    cause = "a speed limit of the drives"
    remedy = "look at the controller's speed limit, at battery and load; plan below this speed"
    limits = "drives"
    parameters = (Parameter("limit", "m/s", math.inf, 0.05, 20.0, 1.0, "largest surface speed of a drive"),)
    order = 30
    identified = ("limit",)
    manoeuvre = "slow and fast stretches straight ahead"
    separated_by: ClassVar = {"drive_gain": "slow and fast stretches straight ahead"}
    wheel_response = WheelResponse(
        parameter="limit",
        speeds=lambda speeds, value, step: np.clip(speeds, -value, value),
        starts=lambda fastest: (0.9 * fastest.speed, 0.6 * fastest.speed),
        bounds=lambda fastest: (0.02 * fastest.speed, 1.5 * fastest.speed),
        # A limit just below the fastest command, or above it, has no effect.
        counts=lambda value, fastest: value <= 0.95 * fastest.speed,
        wording="up to {:.2f} m/s",
        excludes=("actuator_deadband", "drive_gain"),
    )

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Limits from slow walking speed to the top speed of fast robots; the neutral value is infinite."""
        return [{"limit": value} for value in (0.15, 0.3, 0.5, 0.7, 0.9, 1.5, 2.5, 4.0)]

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        limit = per_trajectory(values["limit"], 3)
        return torch.minimum(torch.maximum(speeds, -limit), limit)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The drives run no faster than {values['limit']:.2f} m/s, whatever is commanded."
