"""Ground softer or stiffer than mapped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap


class TerrainSoftness(Effect):
    """Ground softer or stiffer than mapped."""

    name = "terrain_softness"
    stage = "contact"
    summary = "Stiffness and damping are divided by the factor."
    formula = "e ← e / factor, d ← d / factor"
    source = "loose soil"
    cause = "soft ground or tyres"
    compared = "factor"
    remedy = "look at the tyres' pressure, and for mud, sand or snow"
    parameters = (Parameter("factor", "-", 1.0, 0.1, 100.0, 3.0, "mapped over true stiffness"),)
    identified = ("factor",)
    manoeuvre = "over bumps and edges, slow and fast"
    commissioning_start: ClassVar = {"factor": 1.0}
    separated_by: ClassVar = {
        "rolling_resistance": "over bumps and on level ground",
        "payload": "over bumps, and hard starts",
    }

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """From hard ground to mud, by equal ratios: stiffness varies by orders of magnitude."""
        return [{"factor": value} for value in (0.2, 0.5, 2.0, 5.0, 15.0, 50.0)]

    def ground(self, terrain: TerrainMap, values: Values, usual: Values, part: Tensor) -> TerrainMap:
        """The map with a part of the ground softer or stiffer."""
        ratio = values["factor"] / usual["factor"]
        return replace(
            terrain,
            stiffness=torch.where(part, terrain.stiffness / ratio, terrain.stiffness),
            damping=torch.where(part, terrain.damping / ratio, terrain.damping),
        )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        return replace(setup, softness=setup.softness * values["factor"])

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The ground or the tyres are {values['factor']:.1f} times as soft as assumed."
            if values["factor"] >= 1.0
            else f"The ground or the tyres are {1.0 / values['factor']:.1f} times as hard as assumed."
        )
