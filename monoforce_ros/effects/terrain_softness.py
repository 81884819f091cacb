"""Ground softer or stiffer than mapped."""

from __future__ import annotations

from dataclasses import replace

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory
from monoforce_ros.effects.setup import Setup


class TerrainSoftness(Effect):
    """Ground softer or stiffer than mapped."""

    name = "terrain_softness"
    stage = "contact"
    summary = "Stiffness and damping are divided by the factor."
    formula = "e ← e / factor, d ← d / factor"
    source = "loose soil"
    parameters = (Parameter("factor", "-", 1.0, 0.1, 100.0, 3.0, "mapped over true stiffness"),)

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        terrain, factor = setup.terrain, per_trajectory(values["factor"], 3)
        if factor.ndim and terrain.batch_size is None:
            # A value for each trajectory asks for a map of its own.
            terrain = terrain.repeated(len(factor))
        return replace(
            setup, terrain=replace(terrain, stiffness=terrain.stiffness / factor, damping=terrain.damping / factor)
        )
