"""Fault: something hidden in a simulated world, and what it may touch there."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np

from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle import Vehicle


class Subject(Protocol):
    """What a fault sees of a simulation; see ``Simulation``."""

    model: mujoco.MjModel
    data: mujoco.MjData
    robot: Vehicle
    base: int
    wheel_bodies: list[int]
    tyres: list[int]
    tyre_friction: np.ndarray

    @property
    def time(self) -> float:
        """Since the robot came to rest [s]."""

    def state(self) -> Any:
        """The present pose and twist of the base frame."""

    def heading(self) -> float:
        """Direction of the chassis' x axis in the horizontal plane [rad]."""

    def wheel_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Angle [rad] and speed [rad/s] of each wheel."""

    def wheel_velocities(self) -> np.ndarray:
        """Velocity of each wheel's centre in world axes ``[wheels, 3]`` [m/s]."""

    def grass_forces(self) -> np.ndarray | None:
        """Force of the grass on each wheel ``[wheels, 3]`` [N], or None."""


class Fault:
    """Something hidden. The methods below do nothing; a fault overrides those through which it works."""

    in_catalogue: ClassVar[bool] = True
    """Whether the catalogue of effects has an effect of this name."""
    parameters: ClassVar[dict[str, tuple[float, float, float]]]
    """Default value, smallest and largest value of each parameter in SI units; the first is the one that
    ``NAME:VALUE`` sets."""

    def __init__(self, **values: float):
        for name, value in values.items():
            setattr(self, name, value)

    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        """Change the model before it is compiled."""

    def prepare(self, simulation: Subject) -> None:
        """Change the compiled model."""

    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """What becomes of commanded wheel speeds ``[wheels]`` [rad/s]; called at every step."""
        return speeds

    def push(self, simulation: Subject) -> None:
        """Add forces to ``data.xfrc_applied``, which has been cleared for this step."""

    command_stamp_offset: float = 0.0
    """Recorded minus true time of commands [s]."""
    pose_stamp_offset: float = 0.0
    """Recorded minus true time of poses [s]."""
    gyro_offset: float = 0.0
    """Added to recorded yaw rates [rad/s]."""

    def sensor_pose(self) -> tuple[np.ndarray, float]:
        """Place ``[3]`` [m] and yaw [rad], in the base frame, of what is recorded as the base frame."""
        return np.zeros(3), 0.0
