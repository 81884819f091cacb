"""Joint servos: the base controller's steering and flippers, which follow commands with a lag and a limited rate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from monoforce_ros.synthetic.vehicle_parts import Servo


class JointServos:
    """Angles that position servos hold at each step, from commanded ones.

    Args:
        servos: one for each joint.
        start: angles at the beginning ``[n]`` [rad].
        time_step: [s].
    """

    def __init__(self, servos: Sequence[Servo], start: np.ndarray, time_step: float):
        self._low, self._high = (np.array([getattr(servo, name) for servo in servos]) for name in ("low", "high"))
        self._reach = np.array([servo.maximum_rate for servo in servos]) * time_step
        lags = [servo.time_constant for servo in servos]
        self._share = np.array([1.0 - math.exp(-time_step / lag) if lag > 0.0 else 1.0 for lag in lags])
        self.angles = np.array(start, float)

    def step(self, commanded: np.ndarray) -> np.ndarray:
        """Angles ``[n]`` after another time step."""
        target = np.clip(commanded, self._low, self._high)
        self.angles = self.angles + np.clip(self._share * (target - self.angles), -self._reach, self._reach)
        return self.angles
