"""Resistance to rolling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class RollingResistance(Effect):
    """Resistance to rolling."""

    name = "rolling_resistance"
    stage = "contact"
    summary = "Each loaded point is resisted by a fraction of its load."
    formula = "f = -c N v / sqrt(v² + ε²) along the rolling direction"
    source = "Wong, Theory of Ground Vehicles"
    cause = "rolling heavily"
    remedy = "look for soft ground, low tyre pressure, a dragging brake or a tight bearing"
    parameters = (Parameter("coefficient", "-", 0.0, 0.0, 1.0, 0.05, "resistance over load"),)
    identified = ("coefficient",)
    manoeuvre = "slow and fast stretches straight ahead"
    separated_by: ClassVar = {
        "viscous_drag": "slow and fast stretches straight ahead",
        "quadratic_drag": "slow and fast stretches straight ahead",
        "constant_force": "straight ahead and back the same way",
        "actuator_deadband": "slow commands on level ground and up a slope, with measured wheel speeds",
    }

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(setup, loads=replace(loads, rolling_resistance=loads.rolling_resistance + values["coefficient"]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The robot rolls heavily: it is held back by {100 * values['coefficient']:.0f} % of its weight "
            "at any speed."
        )
