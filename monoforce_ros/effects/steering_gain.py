"""Steering angles that are scaled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory
from monoforce_ros.effects.sentences import percent_change


class SteeringGain(Effect):
    """Steering angles that are scaled."""

    name = "steering_gain"
    stage = "command"
    summary = "All steering angles are scaled."
    formula = "δ ← gain δ"
    source = "ratio of linkage or servo"
    cause = "wheels that turn more or less than commanded"
    remedy = "compare the wheels' angles with the commanded ones, and correct the linkage or its ratio"
    parameters = (Parameter("gain", "-", 1.0, 0.2, 2.0, 0.1, "true over commanded angle"),)
    order = 46
    needs = "steering"
    identified = ("gain",)
    manoeuvre = "slight and sharp turns to both sides"
    separated_by: ClassVar = {"steering_deadband": "slight and sharp turns to both sides"}

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        return per_trajectory(values["gain"], 3) * angles

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The wheels turn {percent_change(values['gain'], 'less', 'further')} than commanded."
