"""Different friction along and across the rolling direction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.sentences import percent_change
from monoforce_ros.effects.setup import Setup


class FrictionAnisotropy(Effect):
    """Different friction along and across the rolling direction."""

    name = "friction_anisotropy"
    stage = "contact"
    summary = "Only lateral friction is scaled."
    formula = "μ_lat ← factor μ_lat"
    source = "friction ellipse of tyres and grousers (Pacejka 2012)"
    cause = "tyres that slip sideways"
    remedy = "look at the tread of the tyres, and for ruts that guide them"
    parameters = (Parameter("factor", "-", 1.0, 0.05, 3.0, 0.3, "lateral over longitudinal friction"),)
    identified = ("factor",)
    commissioning_start: ClassVar = {"factor": 1.0}
    like_a_slope = False
    manoeuvre = "turns on the spot, wide arcs and hard starts straight ahead"
    separated_by: ClassVar = {
        "friction_scale": "hard starts straight ahead, which need longitudinal friction only",
        "turning_scrub": "turns on the spot at low and high yaw rate",
        "payload": "hard starts, and driving up and across a slope",
    }

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        robot = setup.robot
        return replace(setup, robot=replace(robot, friction_lateral=robot.friction_lateral * values["factor"]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"Sideways, tyres grip {percent_change(values['factor'], 'less', 'more')} than lengthways."
