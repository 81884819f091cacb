"""Bias of the recorded yaw rate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from monoforce_ros.core import MotionTrack
from monoforce_ros.effects.effect import Effect, Parameter


class GyroBias(Effect):
    """Bias of the recorded yaw rate."""

    name = "gyro_bias"
    stage = "measurement"
    summary = "The gyro measures a constant rate at rest."
    formula = "ω_z ← ω_z + bias"
    source = "sensor bias"
    remedy = "calibrate the gyro while the robot stands"
    parameters = (Parameter("bias", "rad/s", 0.0, -0.5, 0.5, 0.02, "measured rate at rest"),)
    gyro_measures = "bias"

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as recorded under this effect."""
        return replace(motion, angular_velocities=motion.angular_velocities + np.array([0.0, 0.0, values["bias"]]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The gyro reads {math.degrees(values['bias']):+.2f}°/s at rest."
