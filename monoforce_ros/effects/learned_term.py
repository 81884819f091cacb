"""Dynamics missing from the catalogue, as a body wrench that is a sparse sum of named features."""

from __future__ import annotations

from dataclasses import replace

import torch

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import FEATURES, Setup

_ROWS = {"force_x": 0, "force_y": 1, "torque_z": 5}


class LearnedTerm(Effect):
    """Dynamics missing from the catalogue, as a body wrench that is a sparse sum of named features."""

    name = "learned_term"
    stage = "body"
    summary = "Forward force, lateral force and yaw torque, each a weighted sum of features."
    formula = "f = Σ w_k φ_k(v, ω, pitch, roll) in body axes"
    nameless = True
    source = "sparse regression of the residual (Brunton et al. 2016)"
    remedy = "repeat the manoeuvre with the largest error at half the speed, and look at the robot meanwhile"
    parameters = tuple(
        Parameter(
            f"{row}:{feature}",
            "N" if row.startswith("force") else "N m",
            0.0,
            -1e5,
            1e5,
            20.0,
            f"weight of {feature} in the {row.replace('_', ' along ' if row.startswith('force') else ' about ')}",
            of_mass=True,
        )
        for row in _ROWS
        for feature in FEATURES
    )

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        zero = torch.zeros((), dtype=loads.wrench.dtype, device=loads.wrench.device)
        names = {index: row for row, index in _ROWS.items()}
        entries = [
            values.get(f"{names[row]}:{feature}", zero) if row in names else zero
            for row in range(6)
            for feature in FEATURES
        ]
        weights = torch.stack(torch.broadcast_tensors(*entries), dim=-1).unflatten(-1, (6, len(FEATURES)))
        return replace(setup, loads=replace(loads, wrench=loads.wrench + weights.to(loads.wrench)))
