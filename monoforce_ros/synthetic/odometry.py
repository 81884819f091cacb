"""Odometry: ground-truth or noisy estimate of the robot's motion, such as by SLAM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic.fault import Fault
from monoforce_ros.synthetic.simulation import BaseState


@dataclass(frozen=True, kw_only=True)
class OdometrySettings:
    """Errors of the odometry. The defaults give the ground truth without latency.

    Attributes:
        rate: poses per second [Hz].
        position_noise: standard deviation of each coordinate [m].
        rotation_noise: standard deviation about each axis [rad].
        velocity_noise: standard deviation of each component of the linear velocity [m/s].
        angular_velocity_noise: standard deviation of each component of the angular velocity [rad/s].
        position_drift: random walk of the position [m per square root of a driven metre].
        heading_drift: random walk of the heading [rad per square root of a driven metre].
        latency: time from a pose's stamp to its arrival [s].
    """

    rate: float = 50.0
    position_noise: float = 0.0
    rotation_noise: float = 0.0
    velocity_noise: float = 0.0
    angular_velocity_noise: float = 0.0
    position_drift: float = 0.0
    heading_drift: float = 0.0
    latency: float = 0.0

    def __post_init__(self):
        if not 1.0 <= self.rate <= 500.0:
            raise ValueError(f"odometry rate: got {self.rate}, expected 1 to 500 Hz")
        for name in self.__dataclass_fields__:
            if not 0.0 <= getattr(self, name) <= 500.0:
                raise ValueError(f"odometry {name}: got {getattr(self, name)}, expected 0 or more")

    @classmethod
    def slam(cls, position_noise: float = 0.01, rotation_noise: float = math.radians(0.5)) -> OdometrySettings:
        """Like lidar SLAM: 20 Hz, noisy, 0.1 s of latency, a drift of 1 cm and 0.06° in the first metre.

        Noise of the twists is proportional to that of the poses.
        """
        return cls(
            rate=20.0,
            position_noise=position_noise,
            rotation_noise=rotation_noise,
            velocity_noise=3.0 * position_noise,
            angular_velocity_noise=2.0 * rotation_noise,
            position_drift=position_noise,
            heading_drift=0.12 * rotation_noise,
            latency=0.1,
        )


class Odometry:
    """Adds noise, drift and sensor faults to true states."""

    def __init__(self, settings: OdometrySettings, random: np.random.Generator, hidden: Sequence[Fault] = ()):
        self.settings = settings
        self._random, self._hidden = random, hidden
        self._last: np.ndarray | None = None
        self._drift, self._turn = np.zeros(3), 0.0

    def read(self, state: BaseState) -> BaseState:
        """The recorded state of a true one; drift accumulates from call to call."""
        settings, draw = self.settings, self._random.standard_normal
        driven = 0.0 if self._last is None else float(np.linalg.norm(state.position - self._last))
        self._last = state.position
        self._drift = self._drift + settings.position_drift * math.sqrt(driven) * draw(3)
        self._turn += settings.heading_drift * math.sqrt(driven) * float(draw())
        position, rotation = state.position, Rotation.from_quat(state.quaternion)
        linear, angular = state.linear_velocity, state.angular_velocity
        for fault in self._hidden:
            arm, yaw = fault.sensor_pose()
            turn = Rotation.from_euler("z", yaw)
            position, linear = position + rotation.apply(arm), linear + np.cross(angular, arm)
            rotation, linear, angular = rotation * turn, turn.inv().apply(linear), turn.inv().apply(angular)
            angular = angular + np.array([0.0, 0.0, fault.gyro_offset])
        drifted = Rotation.from_euler("z", self._turn)
        noise = Rotation.from_rotvec(settings.rotation_noise * draw(3))
        return BaseState(
            position=drifted.apply(position) + self._drift + settings.position_noise * draw(3),
            quaternion=(drifted * rotation * noise).as_quat(),
            linear_velocity=linear + settings.velocity_noise * draw(3),
            angular_velocity=angular + settings.angular_velocity_noise * draw(3),
        )
