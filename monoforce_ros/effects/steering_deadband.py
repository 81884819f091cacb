"""Loose steering."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class SteeringDeadband(Effect):
    """Loose steering."""

    name = "steering_deadband"
    stage = "command"
    summary = "Loose steering: the wheels turn by less than commanded by the width, and not at all below it."
    formula = "δ ← sign(δ) max(|δ| - width, 0)"
    source = "play in the linkage, taken up by the wheels' self-alignment"
    parameters = (Parameter("width", "rad", 0.0, 0.0, 0.5, 0.03, "half of the play"),)
    order = 44
    needs = "steering"
    identified = ("width",)
    manoeuvre = "slight and sharp turns to both sides"

    def steering_angles(self, angles: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        return torch.sign(angles) * (angles.abs() - per_trajectory(values["width"], 3)).clamp_min(0.0)
