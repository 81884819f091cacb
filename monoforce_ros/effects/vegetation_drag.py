"""Drag of vegetation above the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel


class VegetationDrag(Effect):
    """Drag of vegetation above the ground.

    It acts where the map holds vegetation. Without a map of it the same resistance is everywhere, and its two parts are
    in the catalogue: bending, which does not depend on speed, is ``rolling_resistance``, and the rest ``viscous_drag``.
    """

    name = "vegetation_drag"
    stage = "contact"
    summary = "Resistance at contact points, proportional to the vegetation height (visible minus supporting ground)."
    formula = "f = -c A (H_g - H_t) (v + v_y v/|v|)"
    source = "viscous resistance of grass and brush, and speed-independent bending of stems"
    cause = "plants"
    fitted_in_training = True
    remedy = "look at how high and how dense the plants are; record a lidar so that the map shows them"
    parameters = (
        Parameter("coefficient", "N s/m⁴", 0.0, 0.0, 1e6, 1e4, "drag per area, height and speed"),
        Parameter("yield_speed", "m/s", 0.0, 0.0, 10.0, 0.5, "speed at which bending and viscous force are equal"),
    )
    identified = ("coefficient", "yield_speed")
    manoeuvre = "slow and fast stretches inside and outside the vegetation"
    separated_by: ClassVar = {
        name: "inside and outside the vegetation, or at several heights of it"
        for name in ("viscous_drag", "quadratic_drag", "rolling_resistance", "drive_gain")
    }
    commissioning_start: ClassVar = {"coefficient": 1e4, "yield_speed": 0.5}
    commissioned_over = "vegetation"

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """From grass to brush; stems bend as much as they drag at walking speed."""
        return [{"coefficient": value, "yield_speed": 0.5} for value in (2e3, 1e4, 4e4, 1.6e5)]

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

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"Plants hold the robot back: {values['coefficient']:.0f} N per metre of height, square metre and m/s."
