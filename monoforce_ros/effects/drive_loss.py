"""A drive of one side that is dead or slips."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory


def _weakened(speeds: np.ndarray, value: np.ndarray | float, step: float) -> np.ndarray:
    left = np.atleast_2d(value)
    return speeds * (1.0 - np.maximum(np.concatenate([left, -left], axis=-2), 0.0))


class DriveLoss(Effect):
    """A drive of one side that is dead or slips.

    ``drive_asymmetry`` is a difference about the mean, of tyres or gains that are slightly unequal. A fault only takes
    speed away, and from one side: straight ahead the robot turns towards that side, and it becomes slower.
    """

    name = "drive_loss"
    stage = "command"
    summary = "One side loses a share of its speed: 1 is a drive that stands still. The other side is healthy."
    formula = "u_left ← (1 - max(loss, 0)) u, u_right ← (1 - max(-loss, 0)) u"
    source = "dead motor, slipping belt or clutch; a drive that rolls freely is not covered"
    cause = "a side that runs slow or not at all"
    remedy = "look at motor, gear, chain, fuse and motor driver of this side"
    one_sided = True
    parameters = (
        Parameter(
            "loss",
            "-",
            0.0,
            -1.0,
            1.0,
            0.3,
            "share of the speed; positive: the left side, negative: the right",
            attainable=True,
        ),
    )
    order = 65
    identified = ("loss",)
    manoeuvre = "straight stretches forward and in reverse"
    separated_by: ClassVar = {
        "drive_asymmetry": "straight stretches at several speeds, and turns on the spot to both sides",
        "constant_force": "the same stretch forward and in reverse",
        "sensor_yaw_offset": "turns on the spot to both sides",
    }
    wheel_response = WheelResponse(
        parameter="loss",
        speeds=_weakened,
        starts=lambda fastest: (0.3, -0.3),
        bounds=lambda fastest: (-1.0, 1.0),
        # Tyres of one robot differ by a few per cent.
        counts=lambda value, fastest: abs(value) >= 0.05,
        wording="with {:.2f} of the speed lost on one side (positive: left)",
    )

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        loss = per_trajectory(values["loss"], 3)
        left, right = (offsets > 0).to(speeds), (offsets < 0).to(speeds)
        return speeds * (1.0 - loss.clamp_min(0.0) * left - (-loss).clamp_min(0.0) * right)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        loss = values["loss"]
        side, share = "left" if loss > 0 else "right", abs(loss)
        if share > 0.95:
            return f"The drives of the {side} side do not run."
        return f"The drives of the {side} side run {100 * share:.0f} % slower than commanded."
