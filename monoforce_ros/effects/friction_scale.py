"""Ground with a different friction than mapped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.sentences import percent_change
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap


class FrictionScale(Effect):
    """Ground with a different friction than mapped."""

    name = "friction_scale"
    stage = "contact"
    summary = "The friction coefficient is scaled everywhere."
    formula = "μ ← factor μ"
    source = "wet, loose or icy ground"
    cause = "slippery or grippy ground"
    compared = "factor"
    remedy = "look at tyres and ground; drive slower in turns and when braking"
    uncertainty = "friction"
    parameters = (Parameter("factor", "-", 1.0, 0.02, 3.0, 0.3, "true over mapped friction"),)
    identified = ("factor",)
    manoeuvre = "turns on the spot and hard starts"
    separated_by: ClassVar = {"turning_scrub": "turns on the spot and hard starts"}
    commissioning_start: ClassVar = {"factor": 1.0}

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Initial values for a fit. Friction acts only where more of it is asked for: what is far lower looks like no
        change at all from values near 1."""
        return [{"factor": factor} for factor in (0.1, 0.2, 0.4, 0.7, 1.4)]

    def ground(self, terrain: TerrainMap, values: Values, usual: Values, part: Tensor) -> TerrainMap:
        """The map with another friction on a part of the ground."""
        ratio = values["factor"] / usual["factor"]
        return replace(terrain, friction=torch.where(part, terrain.friction * ratio, terrain.friction))

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        robot, factor = setup.robot, values["factor"]
        return replace(
            setup,
            robot=replace(
                robot,
                friction_longitudinal=robot.friction_longitudinal * factor,
                friction_lateral=robot.friction_lateral * factor,
            ),
        )

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        factor = values["factor"]
        return f"The ground grips {percent_change(factor, 'less than assumed: it is slippery', 'more than assumed')}."
