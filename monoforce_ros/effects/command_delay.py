"""Dead time between a command and the response of the drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse


def _delayed(speeds: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    whole, fraction = np.divmod(np.asarray(value) / step, 1.0)
    # The first command is assumed to have been active before its stamp.
    index = np.arange(speeds.shape[-1]) - whole.astype(int)
    first = speeds.shape[-1] * np.arange(speeds.size // speeds.shape[-1]).reshape(*speeds.shape[:-1], 1)
    later, earlier = (speeds.take(first + np.maximum(index - back, 0)) for back in (0, 1))
    return later + fraction * (earlier - later)


class CommandDelay(Effect):
    """Dead time between a command and the response of the drives."""

    name = "command_delay"
    stage = "command"
    summary = "The drives follow each command after a fixed delay."
    formula = "u(t) ← u(t - delay), linear between steps"
    source = "communication and controller latency"
    cause = "drives that react late"
    remedy = "look for the delay between planner and motor driver: network, bridges, controller rate"
    parameters = (Parameter("delay", "s", 0.0, 0.0, 2.0, 0.2, "dead time"),)
    order = 10
    acts_on_steering = True
    identified = ("delay",)
    shifts = "delay"
    manoeuvre = "steps of the speed from standing"
    commissioning_start: ClassVar = {"delay": 0.03}
    separated_by: ClassVar = {"actuator_lag": "steps of the speed from standing"}
    # Motion and commands alone cannot separate a clock offset of either from a delay of the base.
    separated_by_sensor: ClassVar = {
        "pose_clock_offset": "record an IMU: its gyro shows whether the poses or the base are late",
        "command_clock_offset": "record an IMU: its gyro shows whether the poses or the base are late",
    }
    wheel_response = WheelResponse(
        parameter="delay",
        speeds=_delayed,
        starts=lambda fastest: (0.05, 0.3, 0.7),
        bounds=lambda fastest: (0.0, 1.8),
        # Longer than the 0.05 s between commands at 20 Hz, by which a base that reads them in its own cycle is late.
        counts=lambda value, fastest: value >= 0.06,
        wording="{:.2f} s late",
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        count = speeds.shape[1]
        # The first command is assumed to have been active before its stamp.
        place = torch.arange(count, dtype=speeds.dtype, device=speeds.device) - values["delay"][..., None] / time_step
        place = place.clamp_min(0.0)
        index = place.detach().floor().long().clamp_max(count - 1)
        fraction = place - index
        following = (index + 1).clamp_max(count - 1)
        if place.ndim == 1:
            before, after = speeds[:, index], speeds[:, following]
            return before + fraction[:, None] * (after - before)
        before, after = (speeds.gather(1, i[..., None].expand_as(speeds)) for i in (index, following))
        return before + fraction[..., None] * (after - before)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The drives react {values['delay']:.2f} s late to every command."
