"""Steering that is not centred."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class SteeringOffset(Effect):
    """Steering that is not centred."""

    name = "steering_offset"
    stage = "command"
    summary = "All steered wheels are turned by an offset: the robot drives to one side."
    formula = "δ ← δ + offset"
    source = "toe, a bent rod or a servo that was mounted off its centre"
    cause = "wheels that do not point straight"
    remedy = "centre the steering: rod, toe and the servo's zero"
    parameters = (
        Parameter("offset", "rad", 0.0, -0.5, 0.5, 0.03, "angle at a straight command, positive to the left"),
    )
    order = 48
    needs = "steering"
    identified = ("offset",)
    manoeuvre = "straight stretches forward and in reverse"
    separated_by: ClassVar = {
        "constant_force": "straight stretches at different speeds, forward and in reverse",
        "gravity_tilt": "the same stretch in opposite directions",
        "sensor_yaw_offset": "straight stretches long enough to bend",
    }

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        return angles + per_trajectory(values["offset"], 3)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"At a straight command the wheels point {abs(math.degrees(values['offset'])):.1f}° to the "
            f"{'left' if values['offset'] > 0 else 'right'}."
        )
