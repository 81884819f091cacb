"""Drag proportional to the square of the speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class QuadraticDrag(Effect):
    """Drag proportional to the square of the speed."""

    name = "quadratic_drag"
    stage = "body"
    summary = "A force against the motion grows with the square of the speed."
    formula = "f = -c |v| v"
    source = "fluid drag"
    cause = "drag that grows with the square of the speed"
    remedy = "look for wind, tall grass or water"
    parameters = (Parameter("coefficient", "N s²/m²", 0.0, 0.0, 1e5, 30.0, "drag coefficient", of_mass=True),)
    identified = ("coefficient",)
    manoeuvre = "slow and fast stretches straight ahead"
    formula_terms = ("force_x:vx", "force_x:vx|vx|")

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(setup, loads=replace(loads, quadratic_drag=loads.quadratic_drag + values["coefficient"]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The robot is held back by {values['coefficient']:.0f} N at 1 m/s, and four times as much at "
            "twice the speed."
        )
