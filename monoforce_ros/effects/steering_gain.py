"""Steering angles that are scaled."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class SteeringGain(Effect):
    """Steering angles that are scaled."""

    name = "steering_gain"
    stage = "command"
    summary = "All steering angles are scaled."
    formula = "δ ← gain δ"
    source = "ratio of linkage or servo"
    parameters = (Parameter("gain", "-", 1.0, 0.2, 2.0, 0.1, "true over commanded angle"),)
    order = 46
    needs = "steering"
    identified = ("gain",)
    manoeuvre = "slight and sharp turns to both sides"
    separated_by: ClassVar = {"steering_deadband": "slight and sharp turns to both sides"}

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        return per_trajectory(values["gain"], 3) * angles
