"""Supply voltage that falls while the robot drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory

_LEAST = 0.1
"""Share of the speed that is always left: a drive that has nearly stopped is no matter of its supply."""


def _drained(speeds: np.ndarray, drain: np.ndarray | float, step: float, times: np.ndarray) -> np.ndarray:
    return speeds * np.maximum(1.0 - drain * times / 60.0, _LEAST)


class SupplyDrain(Effect):
    """Supply voltage that falls while the robot drives.

    Motors without speed control turn in proportion to their voltage, which an emptying battery lowers from minute to
    minute. A recording shows how fast. Its effect depends on the time since the supply was full, which a prediction
    knows only within a recording: elsewhere this time is 0, and the effect changes nothing.
    """

    name = "supply_drain"
    stage = "command"
    summary = "All drives slow down from minute to minute, as with a battery that empties."
    formula = "u ← u (1 - drain t), t the time since the supply was full, at least 0.1 u"
    source = "discharge curve of a battery, linearised, and motors without speed control"
    cause = "a supply that drains"
    remedy = "charge the battery, and look at its age; look at the temperature of motors and motor drivers"
    # Typical: a weak battery that loses a tenth of its voltage in a minute of driving.
    parameters = (
        Parameter("drain", "1/min", 0.0, 0.0, 2.0, 0.1, "share of the speed that is lost every minute"),
        Parameter("time", "s", 0.0, 0.0, 1e6, 60.0, "time since the supply was full; recordings set it"),
    )
    order = 33
    clock = "time"
    identified = ("drain",)
    manoeuvre = "the same stretches at the beginning and at the end of a drive of some minutes"
    separated_by: ClassVar = {
        "drive_gain": "the same stretches at the beginning and at the end of a drive of some minutes",
        "supply_sag": "the same stretches at the beginning and at the end of a drive of some minutes",
    }
    wheel_response = WheelResponse(
        parameter="drain",
        speeds=_drained,
        starts=lambda fastest: (0.05, 0.3),
        bounds=lambda fastest: (0.0, 1.0),
        # Less than the wheel radius is known by, within a minute.
        counts=lambda value, fastest: value >= 0.02,
        wording="slower by {:.2f} of their speed every minute",
        of_time=True,
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        left = 1.0 - per_trajectory(values["drain"], 3) * per_trajectory(values["time"], 3) / 60.0
        return speeds * left.clamp(min=_LEAST)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The drives lose {100 * values['drain']:.0f} % of their speed every minute, as when a battery empties."
