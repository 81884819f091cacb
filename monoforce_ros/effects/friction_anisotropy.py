"""Different friction along and across the rolling direction."""

from __future__ import annotations

from dataclasses import replace

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class FrictionAnisotropy(Effect):
    """Different friction along and across the rolling direction."""

    name = "friction_anisotropy"
    stage = "contact"
    summary = "Only lateral friction is scaled."
    formula = "μ_lat ← factor μ_lat"
    source = "friction ellipse of tyres and grousers (Pacejka 2012)"
    parameters = (Parameter("factor", "-", 1.0, 0.05, 3.0, 0.3, "lateral over longitudinal friction"),)

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        robot = setup.robot
        return replace(setup, robot=replace(robot, friction_lateral=robot.friction_lateral * values["factor"]))
