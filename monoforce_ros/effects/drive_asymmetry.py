"""Left and right drives of unequal speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class DriveAsymmetry(Effect):
    """Left and right drives of unequal speed."""

    name = "drive_asymmetry"
    stage = "command"
    summary = "The right side is faster than the left by this fraction of the speed."
    formula = "u_left ← (1 - d/2) u, u_right ← (1 + d/2) u"
    source = "unequal tyres or motors"
    cause = "sides of unequal speed"
    remedy = "compare tyre pressure, wear, chain and motor of both sides"
    uncertainty = "gain"
    one_sided = True
    parameters = (Parameter("difference", "-", 0.0, -1.0, 1.0, 0.1, "right minus left, over their mean"),)
    order = 60
    identified = ("difference",)
    manoeuvre = "straight stretches forward and in reverse"
    separated_by: ClassVar = {
        "constant_force": "the same stretch forward and in reverse",
        "sensor_yaw_offset": "turns on the spot to both sides",
    }

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        side = torch.sign(offsets).to(speeds)
        return speeds * (1.0 - 0.5 * per_trajectory(values["difference"], 3) * side)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        difference = values["difference"]
        fast, slow = ("right", "left") if difference > 0 else ("left", "right")
        percent = f"{100 * abs(difference):.0f} %"
        return f"The {fast} side runs {percent} faster than the {slow} side: the robot pulls to the {slow}."
