"""Twist limits: the largest speeds and accelerations that a base follows, by the effects of its drives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.wheel_motion import half_track
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class TwistLimits:
    """Limits of the commanded twist; infinite where neither effects nor the robot's file say any."""

    speed: float
    """[m/s]."""
    yaw_rate: float
    """Of a robot that turns by its sides on the spot, of a car at its largest speed [rad/s]."""
    acceleration: float
    """[m/s²]."""
    yaw_acceleration: float
    """[rad/s²]."""

    @classmethod
    def of(
        cls, robot: RobotModel, effects: Mapping[str, EffectEstimate], *, share: float = 1.0, separation: float = 1.0
    ) -> TwistLimits:
        """Limits by the robot's file and the effects.

        The drives' limit is one of their command, before gains act. A controller that divides commands by a gain, or
        multiplies yaw rates to make up for scrub, reaches it at another twist.

        Args:
            robot: the nominal model.
            effects: by name.
            share: speed that a drive reaches over the one that it was commanded by a corrected controller.
            separation: multiplier on yaw rates in a corrected controller.
        """
        limiting = {CATALOGUE[name].limits: effect for name, effect in effects.items() if name in CATALOGUE}
        drives, turning, ramp, turning_ramp = (
            limiting[kind].parameters["limit"].value if kind in limiting else math.inf
            for kind in ("drives", "yaw_rate", "acceleration", "yaw_acceleration")
        )
        speed = min(robot.maximum_speed, share * drives)
        yaw_rate = min(robot.maximum_yaw_rate, turning)
        half = half_track(robot)
        motors = limiting.get("motors")
        if motors is not None:
            # The side that speeds up in a turn is braked by the scrub, and is the slower one of both.
            largest = motors.parameters["acceleration"].value
            scrub = motors.parameters["scrub"].value if "scrub" in motors.parameters else 0.0
            ramp = min(ramp, largest)
            turning_ramp = min(turning_ramp, (1.0 - scrub) * largest / half) if half > 0.0 else turning_ramp
        if robot.steered is not None:
            # Robots that steer all wheels turn on the spot: nothing but their file says how fast.
            curvature = robot.maximum_curvature
            yaw_rate = min(yaw_rate, speed * curvature) if math.isfinite(curvature) else yaw_rate
        elif half > 0.0:
            yaw_rate = min(yaw_rate, share * drives / (half * separation))
        return cls(speed, yaw_rate, ramp, turning_ramp)
