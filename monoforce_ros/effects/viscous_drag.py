"""Drag proportional to speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class ViscousDrag(Effect):
    """Drag proportional to speed."""

    name = "viscous_drag"
    stage = "body"
    summary = "A force against the motion grows linearly with speed."
    formula = "f = -c v"
    source = "fluid drag"
    cause = "drag that grows with speed"
    remedy = "look for a dragging brake or gear, tall grass, mud or water"
    parameters = (Parameter("coefficient", "N s/m", 0.0, 0.0, 1e5, 30.0, "drag coefficient", of_mass=True),)
    identified = ("coefficient",)
    manoeuvre = "slow and fast stretches straight ahead"
    separated_by: ClassVar = {"quadratic_drag": "slow and fast stretches straight ahead"}
    # At nearly constant speed the two drags are indistinguishable.
    formula_terms = ("force_x:vx", "force_x:vx|vx|")

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(setup, loads=replace(loads, linear_drag=loads.linear_drag + values["coefficient"]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The faster the robot drives, the more it is held back: by {values['coefficient']:.0f} N at 1 m/s."
