"""A pose sensor with an unmodelled offset from the base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionTrack
from monoforce_ros.effects.effect import Effect, Parameter
from monoforce_ros.effects.sentences import in_directions


class SensorLeverArm(Effect):
    """A pose sensor with an unmodelled offset from the base frame."""

    name = "sensor_lever_arm"
    stage = "measurement"
    summary = "Recorded positions are those of a different point on the robot."
    formula = "p ← p + R r, v ← v + ω × r"
    source = "mounting error"
    cause = "a localisation sensor mounted elsewhere"
    remedy = "measure where the localisation's sensor is mounted, and correct its transform"
    parameters = (
        Parameter("x", "m", 0.0, -2.0, 2.0, 0.2, "sensor forward of the base frame"),
        Parameter("y", "m", 0.0, -2.0, 2.0, 0.2, "sensor to the left"),
    )
    identified = ("x", "y")
    manoeuvre = "turns on the spot to both sides"

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as recorded under this effect."""
        arm = np.array([values["x"], values["y"], 0.0])
        return replace(
            motion,
            positions=motion.positions + Rotation.from_quat(motion.quaternions).apply(arm),
            linear_velocities=motion.linear_velocities + np.cross(motion.angular_velocities, arm),
        )

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The poses are those of a point {in_directions(values['x'], values['y'], 'm')} of the robot's base frame."
        )
