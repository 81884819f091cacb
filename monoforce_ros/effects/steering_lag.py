"""First-order lag of the steering."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.first_order import lagged


class SteeringLag(Effect):
    """First-order lag of the steering."""

    name = "steering_lag"
    stage = "command"
    summary = "The steering approaches the commanded angle exponentially, in addition to the lag of the robot file."
    formula = "dδ/dt = (δ_cmd - δ) / τ"
    source = "first-order servo response"
    cause = "sluggish steering"
    remedy = "look at the steering servo, its supply and its gear"
    parameters = (Parameter("time_constant", "s", 0.0, 0.0, 3.0, 0.2, "time to reach 63 % of a step"),)
    order = 42
    needs = "steering"
    identified = ("time_constant",)
    manoeuvre = "steps of the steering at constant speed, to both sides"
    separated_by: ClassVar = {
        "command_delay": "steps of the steering and of the speed, each alone",
        "actuator_lag": "steps of the steering and of the speed, each alone",
    }

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        return lagged(angles, values["time_constant"], time_step)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The steering is sluggish: {values['time_constant']:.2f} s after a change of the command a "
            "third is still missing."
        )
