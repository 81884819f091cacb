"""Motors of a largest torque, which accelerate rotors and robot, and drag the tyres in a turn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.recurrence import follow_loaded
from monoforce_ros.robots import RobotModel

_TURNING = 0.02
"""Difference of a drive's speed from the mean at which the scrub is whole [m/s]: that at which dry friction is, by the
slip regularisation of the physics."""


class DriveTorqueLimit(Effect):
    """Motors of a largest torque, which accelerate rotors and robot, and drag the tyres in a turn.

    A speed controller asks for more than a motor can give at every step of its command. What the motor then gives
    accelerates its rotor, whose inertia the gear multiplies, and its part of the robot: speeds ramp, each drive's by
    itself. In a turn a skid-steered robot drags its tyres sideways. This dry friction takes a part of the torque of the
    outer drives, which speed up less and slow down more: turns begin slowly and end fast. The ramps of a base
    controller (``acceleration_limit``, ``yaw_acceleration_limit``) know no such difference.
    """

    name = "drive_torque_limit"
    stage = "command"
    summary = "Motors reach their largest torque: each drive ramps, and turns begin slower than they end."
    formula = "-a - b ≤ du/dt ≤ a - b, b = a s sign(u - mean u), of each drive's speed u"
    source = "torque limit of a motor that accelerates its rotor, gear and load under dry friction"
    cause = "motors that reach their largest torque"
    remedy = "look at the current limit of the motor drivers, at battery and load; plan with this ramp"
    limits = "motors"
    parameters = (
        Parameter("acceleration", "m/s²", math.inf, 0.05, 100.0, 1.0, "largest acceleration of a drive straight ahead"),
        Parameter("scrub", "", 0.0, 0.0, 0.95, 0.3, "share of the torque that the scrub of a turn takes"),
    )
    order = 45
    identified = ("acceleration", "scrub")
    # Default of Nav2's velocity smoother; the scrub of a robot whose motors can drag its tyres three times over.
    often_commissioned: ClassVar = {"acceleration": 2.5, "scrub": 0.3}
    manoeuvre = "steps of the speed from standing, small and large, and turns on the spot that begin and end hard"
    separated_by: ClassVar = {
        "acceleration_limit": "turns on the spot that begin and end hard",
        "yaw_acceleration_limit": "hard starts straight ahead, and turns that end hard",
        "actuator_lag": "small and large steps of the speed from standing",
        "command_delay": "small and large steps of the speed from standing",
        "friction_scale": "hard starts straight ahead on ground that grips well",
    }

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Accelerations from very weak motors to those of most robots; the neutral value is infinite."""
        return [{"acceleration": value, "scrub": 0.3} for value in (0.2, 0.4, 0.8, 1.6, 3.2)]

    def applies_to(self, robot: RobotModel | None) -> bool:
        """Whether a robot is steered by its sides: of others the outer wheels are not braked by the turn."""
        return robot is None or robot.steered is None

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect applied; see :class:`Effect`."""
        return follow_loaded(speeds, values["acceleration"] * time_step, values["scrub"], _TURNING)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            "The motors reach their largest torque: they change their speed by no more than "
            f"{values['acceleration']:.2f} m/s "
            f"in a second, and the scrub of a turn takes {100 * values['scrub']:.0f} % of that."
        )
