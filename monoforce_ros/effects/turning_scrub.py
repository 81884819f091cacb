"""Effective track width of a skid-steered turn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory
from monoforce_ros.effects.sentences import percent_change


class TurningScrub(Effect):
    """Effective track width of a skid-steered turn."""

    name = "turning_scrub"
    stage = "contact"
    summary = "The robot turns more slowly, like one with a wider track."
    formula = "u - ū ← (u - ū) / factor, ū the mean of the drives"
    source = "Mandow et al. 2007, experimental kinematics of skid-steer vehicles"
    cause = "turning faster or slower than the model"
    compared = "factor"
    remedy = "set the wheel separation multiplier of the base controller (diagnose --export)"
    like_track_width = True
    parameters = (Parameter("track_width_factor", "-", 1.0, 0.3, 4.0, 0.3, "effective over modelled track width"),)
    order = 70
    identified = ("track_width_factor",)
    like_a_slope = False
    manoeuvre = "turns on the spot and wide arcs"
    commissioning_start: ClassVar = {"track_width_factor": 1.05}

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        mean = speeds.mean(dim=-1, keepdim=True)
        factor = per_trajectory(values["track_width_factor"], 3)
        return torch.where(factor == 1.0, speeds, mean + (speeds - mean) / factor)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        factor = values["track_width_factor"]
        return (
            f"The robot turns {percent_change(1 / factor, 'less', 'more')} than its model does with these wheel speeds."
        )
