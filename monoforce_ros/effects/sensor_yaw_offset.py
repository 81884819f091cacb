"""A pose sensor with a yaw offset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionTrack
from monoforce_ros.effects.effect import Effect, Parameter


class SensorYawOffset(Effect):
    """A pose sensor with a yaw offset."""

    name = "sensor_yaw_offset"
    stage = "measurement"
    summary = "Recorded headings are offset by the angle, and body-frame velocities are rotated."
    formula = "R ← R R_z(angle)"
    source = "mounting error"
    cause = "a localisation sensor mounted at an angle"
    remedy = "measure how the localisation's sensor is mounted, and correct its transform"
    parameters = (Parameter("angle", "rad", 0.0, -3.2, 3.2, 0.1, "yaw of the sensor on the robot"),)
    identified = ("angle",)
    manoeuvre = "straight stretches and turns on the spot"

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as recorded under this effect."""
        turn = Rotation.from_euler("z", values["angle"])
        return replace(
            motion,
            quaternions=(Rotation.from_quat(motion.quaternions) * turn).as_quat(),
            linear_velocities=turn.inv().apply(motion.linear_velocities),
            angular_velocities=turn.inv().apply(motion.angular_velocities),
        )

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The localisation's forward is turned {abs(math.degrees(values['angle'])):.1f}° to the "
            f"{'left' if values['angle'] > 0 else 'right'} of the robot's."
        )
