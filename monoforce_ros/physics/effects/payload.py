"""A load that the robot carries."""

from __future__ import annotations

from dataclasses import replace

import torch

from monoforce_ros.physics.effects.effect import Effect, Parameter, Values
from monoforce_ros.physics.setup import Setup


class Payload(Effect):
    """A load that the robot carries."""

    name = "payload"
    stage = "body"
    summary = "A point mass at a place on the robot changes mass, centre of mass and inertia."
    formula = "M ← M + m, c and J by the parallel-axis theorem"
    source = "rigid-body mechanics"
    parameters = (
        Parameter("mass", "kg", 0.0, -20.0, 200.0, 10.0, "added mass"),
        Parameter("x", "m", 0.0, -1.0, 1.0, 0.2, "its place forward of the base frame"),
        Parameter("y", "m", 0.0, -1.0, 1.0, 0.2, "its place to the left"),
        Parameter("z", "m", 0.0, -0.5, 1.5, 0.2, "its place above"),
    )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect in it."""
        robot = setup.robot
        added = values["mass"]
        place = torch.stack(torch.broadcast_tensors(values["x"], values["y"], values["z"]), dim=-1).to(robot.mass)
        total = robot.mass + added
        arm = place - robot.centre_of_mass
        centre = robot.centre_of_mass + (added / total)[..., None] * arm
        # Two bodies about their common centre: the reduced mass at the distance between them.
        reduced = (robot.mass * added / total)[..., None, None]
        square = (arm * arm).sum(-1)[..., None, None] * torch.eye(3, dtype=arm.dtype, device=arm.device)
        inertia = robot.inertia + reduced * (square - arm[..., :, None] * arm[..., None, :])
        return replace(setup, robot=replace(robot, mass=total, centre_of_mass=centre, inertia=inertia))
