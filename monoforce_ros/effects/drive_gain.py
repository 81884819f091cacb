"""Drives that all run faster or slower than commanded by the same factor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory
from monoforce_ros.effects.sentences import percent_change


class DriveGain(Effect):
    """Drives that all run faster or slower than commanded by the same factor."""

    name = "drive_gain"
    stage = "command"
    summary = "All drive speeds are scaled, by a wheel-radius error or uniform slip."
    formula = "u ← gain u"
    source = "calibration of the wheel radius"
    cause = "drives that run too slow or too fast"
    remedy = "measure the wheels and compare with the radius that the base controller has"
    like_ratio = True
    uncertainty = "gain"
    parameters = (Parameter("gain", "-", 1.0, 0.2, 2.0, 0.1, "true over commanded speed"),)
    order = 50
    identified = ("gain",)
    manoeuvre = "slow and fast stretches straight ahead"
    commissioning_start: ClassVar = {"gain": 1.0}
    separated_by: ClassVar = {
        "viscous_drag": "slow and fast stretches straight ahead",
        "rolling_resistance": "slow and fast stretches straight ahead",
        "turning_scrub": "straight stretches and turns on the spot",
        "pose_clock_offset": "stops and starts",
    }

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        return speeds * per_trajectory(values["gain"], 3)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The drives run {percent_change(values['gain'], 'slower', 'faster')} than commanded."
