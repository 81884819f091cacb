"""A centre of rotation ahead of or behind the modelled one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class RotationCentre(Effect):
    """A centre of rotation ahead of or behind the modelled one.

    The ground holds the heavier end of a skid-steered robot: the robot turns about a point near it. The centre of mass
    moves without a change of mass, as after a battery was moved; a load that is added is ``payload``.
    """

    name = "rotation_centre"
    stage = "body"
    summary = "The weight rests further ahead or behind, and with it the point about which the robot turns."
    formula = "c_x ← c_x + x"
    source = "lateral friction in proportion to load; instantaneous centre of rotation (Mandow et al. 2007)"
    cause = "turning about another point"
    compared = "distance"
    remedy = "look for a load ahead or behind, and for tyres of unequal grip or pressure"
    parameters = (Parameter("x", "m", 0.0, -0.5, 0.5, 0.1, "centre of mass forward of the modelled one"),)
    identified = ("x",)
    like_a_slope = False
    manoeuvre = "turns on the spot to both sides"
    commissioning_start: ClassVar = {"x": 0.0}
    separated_by: ClassVar = {
        "payload": "driving up and across a slope, and hard starts",
        "sensor_lever_arm": "turns on the spot and fast wide arcs",
        "friction_anisotropy": "turns on the spot and fast wide arcs",
    }

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        robot, shift = setup.robot, values["x"]
        zero = torch.zeros_like(shift)
        moved = robot.centre_of_mass + torch.stack([shift, zero, zero], dim=-1).to(robot.centre_of_mass)
        return replace(setup, robot=replace(robot, centre_of_mass=moved))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The robot turns about a point {abs(values['x']):.2f} m "
            f"{'ahead of' if values['x'] > 0 else 'behind'} the one that its "
            "model turns about."
        )
