"""Largest yaw acceleration that the base controller allows."""

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
    turning = ramped_array(twists[..., 1:2, :], value, step)
    return np.concatenate([twists[..., :1, :], turning, twists[..., 2:, :]], axis=-2)


class YawAccelerationLimit(Effect):
    """Largest yaw acceleration that the base controller allows."""

    name = "yaw_acceleration_limit"
    stage = "command"
    summary = "The base controller ramps the yaw rate up and down instead of stepping it."
    formula = "|dω/dt| ≤ limit"
    source = "angular.z.max_acceleration of ros2_controllers' diff_drive_controller"
    cause = "a limit of the yaw acceleration"
    remedy = "look at the base controller's limit of the yaw acceleration; plan with it"
    limits = "yaw_acceleration"
    parameters = (Parameter("limit", "rad/s²", math.inf, 0.05, 100.0, 1.0, "largest yaw acceleration"),)
    order = 6
    identified = ("limit",)
    # Default of Nav2's velocity smoother.
    often_commissioned: ClassVar = {"limit": 3.2}
    manoeuvre = "steps of the yaw rate, small and large, to both sides"
    separated_by: ClassVar = {
        "actuator_lag": "small and large steps of the yaw rate",
        "friction_scale": "hard starts straight ahead and turns on the spot",
        "turning_scrub": "long turns on the spot and short ones",
    }
    wheel_response = WheelResponse(
        parameter="limit",
        speeds=_ramped,
        of_twist=True,
        starts=lambda fastest: (2.0 * fastest.yaw_rate, 0.5 * fastest.yaw_rate),
        bounds=lambda fastest: (0.02 * fastest.yaw_rate, 50.0 * fastest.yaw_rate + 1e-3),
        # A ramp over 0.16 s turns the robot as late as a lag of 0.08 s.
        counts=lambda value, fastest: value <= fastest.yaw_rate / 0.16,
        wording="turning faster by up to {:.2f} rad/s²",
    )

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Ramps from very soft to those of most bases; the neutral value is infinite."""
        return [{"limit": value} for value in (0.3, 0.6, 1.2, 2.4, 4.8)]

    def twists(self, twists: Tensor, values: Values, time_step: float) -> Tensor:
        """Twists with this effect applied; see :class:`Effect`."""
        yaw_rate = ramped(twists[..., 1], values["limit"], time_step)
        return torch.stack([twists[..., 0], yaw_rate], dim=-1)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The base changes its yaw rate by no more than {values['limit']:.2f} rad/s in a second."
