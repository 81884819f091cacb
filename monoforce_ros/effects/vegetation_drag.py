"""Drag of vegetation above the ground."""

from __future__ import annotations

from dataclasses import replace

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class VegetationDrag(Effect):
    """Drag of vegetation above the ground."""

    name = "vegetation_drag"
    stage = "contact"
    summary = "Resistance at contact points, proportional to the vegetation height (visible minus supporting ground)."
    formula = "f = -c A (H_g - H_t) (v + v_y v/|v|)"
    source = "viscous resistance of grass and brush, and speed-independent bending of stems"
    parameters = (
        Parameter("coefficient", "N s/m⁴", 0.0, 0.0, 1e6, 1e4, "drag per area, height and speed"),
        Parameter("yield_speed", "m/s", 0.0, 0.0, 10.0, 0.5, "speed at which bending and viscous force are equal"),
    )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(
            setup,
            loads=replace(
                loads,
                vegetation_drag=loads.vegetation_drag + values["coefficient"],
                vegetation_yield=loads.vegetation_yield + values["yield_speed"],
            ),
        )
