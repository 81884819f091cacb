"""Drives whose speed droops under the scrub of a turn until integral action restores it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, WheelResponse, per_trajectory
from monoforce_ros.effects.recurrence import droop
from monoforce_ros.robots import RobotModel


def _drooped(speeds: np.ndarray, loss: np.ndarray | float, recovery: np.ndarray | float, step: float) -> np.ndarray:
    turning = 0.5 * (speeds[..., 1:, :] - speeds[..., :1, :])
    share = 1.0 - np.exp(-step / np.asarray(recovery))
    factors = (np.broadcast_to(factor, (*turning.shape[:-1], 1)).ravel() for factor in (loss, share))
    rows = torch.from_numpy(turning.reshape(-1, turning.shape[-1]))
    lost = droop(rows, *(torch.tensor(factor, dtype=rows.dtype) for factor in factors))
    change = lost.numpy().reshape(turning.shape)
    return speeds + np.concatenate([change, -change], axis=-2)


class DriveDroop(Effect):
    """Drives whose speed droops under the scrub of a turn until integral action restores it.

    Tyres that are dragged sideways load the drives of a skid-steered robot with dry friction: about the same at any
    speed of the turn, and against it. Under it a proportional speed controller droops by a constant loss, which its
    integral part takes back within some seconds. The robot therefore begins to turn late and slowly, though it drives
    ahead as commanded; turns that go on in the same direction keep their load and follow at once.

    Dry friction of size ``c`` acts on half the difference ``d`` of the sides' speeds, and the integral part holds ``m``
    against it. What the drives exceed the friction by is how fast they turn; below it the sides run alike.
    """

    name = "drive_droop"
    stage = "command"
    summary = "In turns the drives droop under the scrub of the tyres, until integral action restores their speed."
    formula = "d ← y - clip(y, -c, c), y = d + m, dm/dt = (clip(y, -c, c) - m) / T, d half the sides' difference"
    source = "proportional-integral speed control under dry friction"
    cause = "drives that droop when a turn begins"
    remedy = "raise the gains of the motors' speed controllers, first of the integral part"
    # Typical: a drive that loses 0.2 m/s to the scrub of a turn, and has it back after some seconds.
    parameters = (
        Parameter("loss", "m/s", 0.0, 0.0, 2.0, 0.2, "speed that each side loses at first when a turn begins"),
        Parameter("recovery", "s", 3.0, 0.2, 30.0, 2.0, "time constant in which integral action restores it"),
    )
    order = 49
    identified = ("loss", "recovery")
    manoeuvre = "turns on the spot and curves that begin from straight driving, each held for five seconds"
    separated_by: ClassVar = {
        "yaw_acceleration_limit": "turns to both sides, held for five seconds, and changes of the yaw rate within them",
        "actuator_lag": "steps straight ahead, and turns held for five seconds",
        "drive_compliance": "turns held for five seconds",
        "turning_scrub": "turns held for five seconds",
    }
    wheel_response = WheelResponse(
        parameter="loss",
        further=("recovery",),
        speeds=_drooped,
        starts=lambda fastest: (0.05 * fastest.speed, 0.2 * fastest.speed),
        bounds=lambda fastest: (0.0, 2.0),
        # A side that runs this much slower for the recovery of two seconds turns a robot of average width by 5° less.
        counts=lambda value, fastest: value >= 0.02,
        wording="losing {:.2f} m/s of each side at the beginning of a turn, restored with a time constant of {:.1f} s",
    )

    def applies_to(self, robot: RobotModel | None) -> bool:
        """Whether a robot is steered by its sides: others have no scrub."""
        return robot is None or robot.steered is None

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        place = offsets.to(speeds) - offsets.to(speeds).mean()
        width = place.abs().max()
        if not bool(width > 0):
            return speeds
        # Half the difference of the sides, by least squares where there are more than two drives.
        shape = -place / width
        wanted = speeds @ shape / (shape @ shape)
        loss, recovery = (per_trajectory(values[key], 1) for key in self.identified)
        share = 1.0 - torch.exp(-time_step / recovery)
        return speeds - droop(wanted, loss, share)[..., None] * shape

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The drives droop when a turn begins: each side loses {values['loss']:.2f} m/s, and needs "
            f"{values['recovery']:.1f} s "
            "to win back most of it."
        )
