"""Fault: physics injected into a simulated world that the prediction model does not know."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, Self, overload

import numpy as np

from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle import Vehicle


class Simulation(Protocol):
    """What a fault can read and change in a running world (:class:`monoforce_ros.synthetic.simulation.Simulation`)."""

    model: mujoco.MjModel
    data: mujoco.MjData
    robot: Vehicle
    base: int
    wheel_bodies: list[int]
    tyres: list[int]
    tyre_friction: np.ndarray
    driven: np.ndarray

    @property
    def time(self) -> float:
        """Time since the robot came to rest [s]."""

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


class Parameter:
    """A parameter of a fault, declared as a class attribute: ``delay = Parameter(0.25, 0.05, 1.0)``.

    On a fault it is a float; on the class it is this declaration.

    Args:
        default: default value, in SI units.
        low, high: smallest and largest value.
        neutral: value at which the fault has no effect; random values scale the distance from it.
        one_of_many: the default holds only where no parameter is named: naming one part leaves the others healthy.
    """

    def __init__(self, default: float, low: float, high: float, *, neutral: float = 0.0, one_of_many: bool = False):
        self.default, self.low, self.high, self.neutral = default, low, high, neutral
        self.one_of_many = one_of_many

    def __set_name__(self, owner: type[Fault], name: str) -> None:
        self._name = name

    @overload
    def __get__(self, fault: None, owner: type[Fault]) -> Self: ...
    @overload
    def __get__(self, fault: Fault, owner: type[Fault]) -> float: ...
    def __get__(self, fault: Fault | None, owner: type[Fault]) -> Self | float:
        return self if fault is None else fault.values[self._name]


class Fault:
    """An injected fault. The methods below do nothing; a fault overrides those it needs.

    Args:
        values: parameters that differ from their defaults.

    Raises:
        TypeError: the fault has no such parameter.
    """

    in_catalogue: ClassVar[bool] = True
    """Whether the catalogue of effects has an effect of this name."""
    needs: ClassVar[str] = ""
    """``steering`` or ``flippers`` for a fault of these joints."""
    parameters: ClassVar[dict[str, Parameter]] = {}
    """Declared parameters by name; ``NAME:VALUE`` sets the first one."""

    def __init_subclass__(cls) -> None:
        declared = {name: entry for name, entry in vars(cls).items() if isinstance(entry, Parameter)}
        cls.parameters = cls.parameters | declared

    def __init__(self, **values: float):
        unknown = sorted(set(values) - set(self.parameters))
        if unknown:
            raise TypeError(f"{type(self).__name__}: got {', '.join(unknown)}, expected {', '.join(self.parameters)}")
        self.values = {name: values.get(name, entry.default) for name, entry in self.parameters.items()}
        """Value of each parameter."""

    def complaint(self, robot: Vehicle) -> str:
        """Why a robot cannot have this fault; empty if it can."""
        if not self.needs or getattr(robot, self.needs):
            return ""
        return f"{type(self).__name__}: got the robot {robot.name}, expected one with {self.needs}"

    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        """Change the model before it is compiled."""

    def modify_model(self, simulation: Simulation) -> None:
        """Change the compiled model once the robot has settled."""

    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        """Wheel speeds received by the servos for commanded ones ``[wheels]`` [rad/s]; called at every step."""
        return speeds

    def joint_targets(self, simulation: Simulation, targets: np.ndarray) -> np.ndarray:
        """Angles that the servos of steering and flippers hold, from intended ones ``[n]`` [rad], at every step."""
        return targets

    def apply_forces(self, simulation: Simulation) -> None:
        """Add forces to ``data.xfrc_applied``, which has been cleared for this step."""

    @property
    def command_stamp_offset(self) -> float:
        """Recorded minus true time of commands [s]."""
        return 0.0

    @property
    def pose_stamp_offset(self) -> float:
        """Recorded minus true time of poses [s]."""
        return 0.0

    @property
    def gyro_offset(self) -> float:
        """Added to recorded yaw rates [rad/s]."""
        return 0.0

    def sensor_pose(self) -> tuple[np.ndarray, float]:
        """True position ``[3]`` [m] and yaw [rad], in the base frame, of the frame recorded as the base frame."""
        return np.zeros(3), 0.0
