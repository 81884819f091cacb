"""Largest yaw rate that the base controller accepts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory
from monoforce_ros.robots import RobotModel


def _clamped(twists: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    turning = np.clip(twists[..., 1:2, :], -value, value)
    return np.concatenate([twists[..., :1, :], turning, twists[..., 2:, :]], axis=-2)


class YawRateLimit(Effect):
    """Largest yaw rate that the base controller accepts."""

    name = "yaw_rate_limit"
    stage = "command"
    summary = "The base controller clamps the commanded yaw rate; the forward speed stays."
    formula = "ω ← clamp(ω, -limit, limit)"
    source = "angular.z.max_velocity of ros2_controllers' diff_drive_controller"
    cause = "a limit of the yaw rate"
    remedy = "look at the base controller's limit of the yaw rate, and enter it in the robot's file"
    limits = "yaw_rate"
    parameters = (Parameter("limit", "rad/s", math.inf, 0.05, 20.0, 1.0, "largest yaw rate"),)
    order = 2
    identified = ("limit",)
    manoeuvre = "slow and fast turns"
    separated_by: ClassVar = {
        "turning_scrub": "slow and fast turns on the spot",
        "actuator_saturation": "fast stretches straight ahead and fast turns on the spot",
    }
    wheel_response = WheelResponse(
        parameter="limit",
        speeds=_clamped,
        of_twist=True,
        starts=lambda fastest: (0.9 * fastest.yaw_rate, 0.6 * fastest.yaw_rate),
        bounds=lambda fastest: (0.02 * fastest.yaw_rate, 1.5 * fastest.yaw_rate + 1e-3),
        # A limit just below the fastest command, or above it, has no effect.
        counts=lambda value, fastest: value <= 0.95 * fastest.yaw_rate,
        wording="turning at up to {:.2f} rad/s",
    )

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Limits from slow turns to those of most bases; the neutral value is infinite."""
        return [{"limit": value} for value in (0.15, 0.3, 0.6, 1.0, 1.5, 2.5)]

    def twists(self, twists: Tensor, values: Values, time_step: float) -> Tensor:
        """Twists with this effect applied; see :class:`Effect`."""
        limit = per_trajectory(values["limit"], 2)
        yaw_rate = torch.minimum(torch.maximum(twists[..., 1], -limit), limit)
        return torch.stack([twists[..., 0], yaw_rate], dim=-1)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The base turns no faster than {values['limit']:.2f} rad/s, whatever is commanded."
