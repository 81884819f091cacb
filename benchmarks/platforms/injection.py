"""Injection: what a hidden effect does to commands, drives, robot, forces and sensors of a simulated drive.

Every hook works in the engine or on the path of commands and measurements; none uses the package's effects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

TICK = 0.01
"""Period of the base controller and of the injected forces [s]."""


@dataclass(frozen=True)
class BaseState:
    """State of the base frame in the world.

    Attributes:
        position: ``[3]`` [m].
        rotation: ``[3, 3]``, world ← base.
        velocity: ``[3]`` of the origin, in the base frame [m/s].
        rates: ``[3]`` in the base frame [rad/s].
        wheel_speeds: ``[wheels]`` [rad/s], left ones first.
    """

    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    rates: np.ndarray
    wheel_speeds: np.ndarray

    @property
    def heading(self) -> float:
        """[rad]."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))


@dataclass(frozen=True, kw_only=True)
class Build:
    """How the simulated robot differs from the platform.

    Attributes:
        friction: factor on the friction of the wheels of the front and of the rear half.
        payload: mass [kg] of a rigid box on the base.
        payload_position: of its centre in the base frame [m].
        eccentricity: distance of a wheel's axle from its centre, of the front left wheel [m].
        contact_time: factor on the contact's time constant: softer ground.
        lifted: the chassis is held and the wheels do not touch the ground.
    """

    friction: tuple[float, float] = (1.0, 1.0)
    payload: float = 0.0
    payload_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    eccentricity: float = 0.0
    contact_time: float = 1.0
    lifted: bool = False


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """How recorded stamps and sensors differ from the truth.

    Attributes:
        pose_offset, command_offset: recorded minus true stamp [s].
        lever_arm: of the pose sensor in the base frame [m].
        sensor_yaw: of the pose sensor on the robot [rad].
        gyro_bias: about z [rad/s].
        compass: amplitude of a heading error that is a sine of the heading [rad].
        scale: factor on recorded distances.
    """

    pose_offset: float = 0.0
    command_offset: float = 0.0
    lever_arm: tuple[float, float] = (0.0, 0.0)
    sensor_yaw: float = 0.0
    gyro_bias: float = 0.0
    compass: float = 0.0
    scale: float = 1.0


@dataclass
class Injection:
    """One hidden effect during one drive; by default it does nothing."""

    onset: float = 0.0
    """Time from which commands, drives and forces are affected [s]."""
    build: Build = field(default_factory=Build)
    measurement: Measurement = field(default_factory=Measurement)

    def twist(self, time: float, twist: np.ndarray) -> np.ndarray:
        """The commanded twist ``[2]`` [m/s, rad/s] as the base receives it; called every ``TICK``."""
        return twist

    def drives(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """The target speeds ``[2]`` of the left and the right drive [m/s]; called every ``TICK``."""
        return speeds

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """Force [N] and torque [N m] about the robot's centre of mass, in the world frame; called every ``TICK``."""
        return np.zeros(3), np.zeros(3)


def sign(value: float | np.ndarray, width: float) -> float | np.ndarray:
    """A sign function that rises linearly within ``±width``, so that Coulomb forces hold a robot at rest."""
    return np.clip(value / width, -1.0, 1.0)
