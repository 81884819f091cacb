"""Drag proportional to the square of the speed."""

from __future__ import annotations

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
    parameters = (Parameter("coefficient", "N s²/m²", 0.0, 0.0, 1e5, 30.0, "drag coefficient", of_mass=True),)
    identified = ("coefficient",)
    manoeuvre = "slow and fast stretches straight ahead"
    formula_terms = ("force_x:vx", "force_x:vx|vx|")

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(setup, loads=replace(loads, quadratic_drag=loads.quadratic_drag + values["coefficient"]))
