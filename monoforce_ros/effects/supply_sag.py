"""Supply voltage that sags with the current of the drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory


def _sagging(speeds: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    return speeds / (1.0 + value * np.abs(speeds).mean(axis=-2, keepdims=True))


class SupplySag(Effect):
    """Supply voltage that sags with the current of the drives.

    Motors without speed control turn in proportion to their voltage d U, with the duty d = u / u_max. They draw a
    current in proportion to it, which loads the battery in proportion to d: I = k U Σ|d|. With the battery's internal
    resistance U = U₀ - R I, so that U = U₀ / (1 + s ū) with the mean speed ū of the drives. An empty battery has a
    lower U₀, which is ``drive_gain``.
    """

    name = "supply_sag"
    stage = "command"
    summary = "All drives slow down in proportion to the supply voltage, the more the faster they are to run together."
    formula = "u ← u / (1 + sag ū), ū the mean of |u| over the drives"
    source = "battery with internal resistance (Thévenin) and motors without speed control"
    cause = "a supply that sags"
    remedy = "look at charge and age of the battery, and at the resistance of its cables"
    parameters = (Parameter("sag", "s/m", 0.0, 0.0, 5.0, 0.2, "lost share of the voltage per speed, for small shares"),)
    order = 35
    identified = ("sag",)
    manoeuvre = "slow and fast stretches straight ahead"
    separated_by: ClassVar = {
        "drive_gain": "slow and fast stretches straight ahead",
        "actuator_saturation": "slow, medium and fast stretches straight ahead",
        "viscous_drag": "slow and fast stretches straight ahead, with measured wheel speeds",
        "quadratic_drag": "slow and fast stretches straight ahead, with measured wheel speeds",
    }
    wheel_response = WheelResponse(
        parameter="sag",
        speeds=_sagging,
        starts=lambda fastest: (0.2 / fastest.speed,),
        bounds=lambda fastest: (0.0, 4.0 / fastest.speed),
        # Less than the wheel radius is known by.
        counts=lambda value, fastest: value * fastest.speed >= 0.05,
        wording="slower by {:.2f} of their speed per m/s",
        excludes=("actuator_saturation", "drive_gain"),
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        return speeds / (1.0 + per_trajectory(values["sag"], 3) * speeds.abs().mean(dim=-1, keepdim=True))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            "The faster the drives run, the more of their speed they lose, "
            f"{100 * values['sag'] / (1.0 + values['sag']):.0f} % at "
            "1 m/s: their supply sags."
        )
