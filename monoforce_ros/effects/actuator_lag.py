"""First-order lag of the drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Product, Values, WheelResponse
from monoforce_ros.effects.first_order import lagged
from monoforce_ros.effects.ramp import at_stamps


def _lagging(speeds: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    values = np.broadcast_to(value, (*speeds.shape[:-2], 1, 1))[..., 0, 0]
    lagging = speeds.copy()
    # Of a batch only a few differ.
    for constant in np.unique(values[values > 1e-4]):
        part, decay = speeds[values == constant], np.exp(-step / constant)
        filtered, _ = lfilter([1.0 - decay], [1.0, -decay], part, axis=-1, zi=decay * part[..., :1])
        lagging[values == constant] = at_stamps(filtered)
    return lagging


class ActuatorLag(Effect):
    """First-order lag of the drives, or two in series: a lag that is added to that of the healthy drives."""

    name = "actuator_lag"
    stage = "command"
    summary = "The drives approach the commanded speed exponentially."
    formula = "du/dt = (u_1 - u) / τ, du_1/dt = (u_cmd - u_1) / τ_2"
    source = "first-order servo response; two in series where a filter or a slow controller precedes the servo"
    cause = "sluggish drives"
    remedy = "look at the gains and ramps of the motor controller, and at the battery"
    parameters = (
        Parameter("time_constant", "s", 0.0, 0.0, 3.0, 0.2, "time to reach 63 % of a step"),
        Parameter("second_time_constant", "s", 0.0, 0.0, 3.0, 0.2, "that of a second lag in series with the first"),
    )
    order = 40
    identified = ("time_constant",)
    refined = ("second_time_constant",)
    # Two lags of about the same length look alike however their sum is divided.
    products = (
        Product("total_time", ("time_constant", "second_time_constant"), "s", "sum of both time constants", adds=True),
    )
    manoeuvre = "steps of the speed from standing"
    commissioning_start: ClassVar = {"time_constant": 0.03}
    wheel_response = WheelResponse(
        parameter="time_constant",
        speeds=_lagging,
        starts=lambda fastest: (0.1, 0.4),
        bounds=lambda fastest: (0.0, 3.0),
        # One interval at about 13 Hz, at which blocks of wheel speeds are subsampled.
        counts=lambda value, fastest: value >= 0.08,
        wording="with a time constant of {:.2f} s",
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        return lagged(lagged(speeds, values["time_constant"], time_step), values["second_time_constant"], time_step)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            "The drives are sluggish: "
            f"{values['time_constant'] + values.get('second_time_constant', 0.0):.2f} s after a change of"
            " the command a third is still missing."
        )
