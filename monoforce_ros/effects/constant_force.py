"""A constant force on the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.sentences import in_directions
from monoforce_ros.effects.setup import Setup


class ConstantForce(Effect):
    """A constant force on the body."""

    name = "constant_force"
    stage = "body"
    summary = "A constant force from a tether, wind, or a slope that the map does not contain."
    formula = "f = f_0 in body axes"
    source = "rigid-body mechanics"
    cause = "a steady pull"
    remedy = "look for a tether, wind, or a slope that the map does not have"
    parameters = (
        Parameter("x", "N", 0.0, -1e5, 1e5, 50.0, "force forward", of_mass=True),
        Parameter("y", "N", 0.0, -1e5, 1e5, 50.0, "force to the left", of_mass=True),
    )
    identified = ("x", "y")
    manoeuvre = "the same stretch forward and in reverse"
    separated_by: ClassVar = {"gravity_tilt": "the same stretch in opposite directions"}
    formula_terms = ("force_x:1", "force_y:1")

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads.with_wrench(0, "1", values["x"]).with_wrench(1, "1", values["y"])
        return replace(setup, loads=loads)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"Something pulls the robot with {in_directions(values['x'], values['y'], 'N')} all the time."
