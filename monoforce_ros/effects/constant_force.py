"""A constant force on the body."""

from __future__ import annotations

from dataclasses import replace

import torch

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class ConstantForce(Effect):
    """A constant force on the body."""

    name = "constant_force"
    stage = "body"
    summary = "A tether, a slope that the map does not show, wind."
    formula = "f = f_0 in body axes"
    source = "rigid-body mechanics"
    parameters = (
        Parameter("x", "N", 0.0, -1000.0, 1000.0, 50.0, "force forward"),
        Parameter("y", "N", 0.0, -1000.0, 1000.0, 50.0, "force to the left"),
    )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect in it."""
        loads = setup.loads
        force = torch.stack(torch.broadcast_tensors(values["x"], values["y"]), dim=-1).to(loads.wrench)
        constant = torch.nn.functional.pad(force, (0, 4))[..., None]
        added = torch.nn.functional.pad(constant, (0, loads.wrench.shape[-1] - 1))
        return replace(setup, loads=replace(loads, wrench=loads.wrench + added))
