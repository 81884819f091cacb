"""Gravity not aligned with the odometry frame's z axis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class GravityTilt(Effect):
    """Gravity not aligned with the odometry frame's z axis."""

    name = "gravity_tilt"
    stage = "body"
    summary = "Gravity is tilted in the odometry frame: unmapped slope or tilted localisation."
    formula = "g ← R_x(a) R_y(b) g"
    source = "slope missing from the map; localisation initialised with a tilt"
    cause = "a slope or a tilted localisation"
    remedy = "level the localisation's map frame, or give a map of the ground (--terrain)"
    parameters = (
        Parameter("about_x", "rad", 0.0, -0.5, 0.5, 0.05, "tilt about the odometry frame's x axis"),
        Parameter("about_y", "rad", 0.0, -0.5, 0.5, 0.05, "tilt about its y axis"),
    )
    identified = ("about_y", "about_x")
    manoeuvre = "the same stretch in opposite directions"

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        tilt = torch.stack(torch.broadcast_tensors(values["about_x"], values["about_y"]), dim=-1)
        return replace(setup, loads=replace(loads, gravity_tilt=loads.gravity_tilt + tilt.to(loads.gravity_tilt)))

    def turned(self, values: Mapping[str, float | Tensor], heading: Tensor) -> Mapping[str, float | Tensor]:
        """The tilt about the axes of frames yawed by ``heading`` ``[B]`` [rad]."""
        about_x, about_y = (torch.as_tensor(values.get(key, 0.0)).to(heading) for key in ("about_x", "about_y"))
        cos, sin = torch.cos(heading), torch.sin(heading)
        return {"about_x": cos * about_x + sin * about_y, "about_y": cos * about_y - sin * about_x}

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        angle = math.degrees(math.hypot(values.get("about_x", 0.0), values.get("about_y", 0.0)))
        return f"Down is {angle:.1f}° off: the ground slopes, or the localisation is tilted."
