"""Gravity that is not along the terrain frame's z axis."""

from __future__ import annotations

from dataclasses import replace

import torch

from monoforce_ros.physics.effects.effect import Effect, Parameter, Values
from monoforce_ros.physics.setup import Setup


class GravityTilt(Effect):
    """Gravity that is not along the terrain frame's z axis."""

    name = "gravity_tilt"
    stage = "body"
    summary = "An attitude reference that is off by small angles tilts gravity."
    formula = "g ← R_x(a) R_y(b) g"
    source = "misaligned attitude reference"
    parameters = (
        Parameter("about_x", "rad", 0.0, -0.5, 0.5, 0.05, "tilt about the x axis"),
        Parameter("about_y", "rad", 0.0, -0.5, 0.5, 0.05, "tilt about the y axis"),
    )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect in it."""
        loads = setup.loads
        tilt = torch.stack(torch.broadcast_tensors(values["about_x"], values["about_y"]), dim=-1)
        return replace(setup, loads=replace(loads, gravity_tilt=loads.gravity_tilt + tilt.to(loads.gravity_tilt)))
