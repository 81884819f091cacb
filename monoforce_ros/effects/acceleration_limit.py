"""Largest forward acceleration that the base controller allows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse
from monoforce_ros.effects.ramp import ramped, ramped_array
from monoforce_ros.robots import RobotModel


def _ramped(twists: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    return np.concatenate([ramped_array(twists[..., :1, :], value, step), twists[..., 1:, :]], axis=-2)


class AccelerationLimit(Effect):
    """Largest forward acceleration that the base controller allows."""

    name = "acceleration_limit"
    stage = "command"
    summary = "The base controller ramps the forward speed up and down instead of stepping it."
    formula = "|dv/dt| ≤ limit"
    source = "linear.x.max_acceleration of ros2_controllers' diff_drive_controller"
    cause = "a limit of the acceleration"
    remedy = "look at the base controller's limit of the acceleration; plan with it"
    limits = "acceleration"
    parameters = (Parameter("limit", "m/s²", math.inf, 0.05, 100.0, 1.0, "largest forward acceleration"),)
    order = 4
    identified = ("limit",)
    # Default of Nav2's velocity smoother.
    often_commissioned: ClassVar = {"limit": 2.5}
    manoeuvre = "steps of the speed from standing, small and large"
    separated_by: ClassVar = {
        "actuator_lag": "small and large steps of the speed from standing",
        "command_delay": "small and large steps of the speed from standing",
        "friction_scale": "hard starts, and turns on the spot at low speed",
    }
    wheel_response = WheelResponse(
        parameter="limit",
        speeds=_ramped,
        of_twist=True,
        starts=lambda fastest: (2.0 * fastest.speed, 0.5 * fastest.speed),
        bounds=lambda fastest: (0.02 * fastest.speed, 50.0 * fastest.speed),
        # A ramp over 0.16 s moves the robot as late as a lag of 0.08 s.
        counts=lambda value, fastest: value <= fastest.speed / 0.16,
        wording="accelerating at up to {:.2f} m/s²",
    )

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Ramps from very soft to those of most bases; the neutral value is infinite."""
        return [{"limit": value} for value in (0.2, 0.4, 0.8, 1.6, 3.2)]

    def twists(self, twists: Tensor, values: Values, time_step: float) -> Tensor:
        """Twists with this effect applied; see :class:`Effect`."""
        forward = ramped(twists[..., 0], values["limit"], time_step)
        return torch.stack([forward, twists[..., 1]], dim=-1)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The base changes its speed by no more than {values['limit']:.2f} m/s in a second."
