"""Joint: a part of the robot that moves in the body, and Coordinate: how a joint or drive responds to forces."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

Vector = tuple[float, float, float]

STEERING, FLIPPER, CASTER, SUSPENSION, ROCKER = "steering", "flipper", "caster", "suspension", "rocker"


@dataclass(frozen=True)
class Coordinate:
    """Dynamics of one degree of freedom, whose rate is a state of the rollout.

    ``inertia du/dt = contact force + torque``, with the torque ``stiffness (q_target - q) + damping (u_target - u) -
    preload``, limited as a DC motor's is. Units are those of a rotation; for a spring along an axis or a drive, read m
    for rad and N for N m.
    """

    inertia: float
    """[kg m²], or [kg] along an axis and at the rim of a wheel."""
    stiffness: float = 0.0
    """[N m/rad]."""
    damping: float = 0.0
    """Of a spring or bearing, or the gain of a speed controller [N m s/rad]."""
    preload: float = 0.0
    """Constant torque against the positive direction [N m]."""
    stall_torque: float = math.inf
    """Torque at standstill; it falls linearly to 0 at ``no_load_rate`` [N m]."""
    no_load_rate: float = math.inf
    """[rad/s]."""
    maximum_torque: float = math.inf
    """Limit of the current [N m]."""
    maximum_power: float = math.inf
    """Mechanical power [W]."""
    low: float = -math.inf
    """Position of the lower stop [rad]."""
    high: float = math.inf
    """Position of the upper stop [rad]."""
    stop_stiffness: float = 0.0
    """Stiffness of the stops [N m/rad]."""

    @property
    def limited(self) -> bool:
        """Whether the torque has a limit."""
        return not math.isinf(min(self.stall_torque, self.maximum_torque, self.maximum_power))


@dataclass(frozen=True)
class Joint:
    """A hinge or slide between the body and some of its points; lengths in metres in the base frame.

    Without ``dynamics`` its angle is prescribed by the controls, otherwise it is a state of the rollout.
    """

    name: str
    kind: str
    """``steering``, ``flipper``, ``caster``, ``suspension`` or ``rocker``."""
    axis: Vector
    """Unit vector along the axis; positive angles turn right-handed about it, a slide moves along it."""
    origin: Vector
    """A point on the axis, with all joints at the angles of the robot's points."""
    slides: bool = False
    """A slide along the axis instead of a hinge about it."""
    parent: int = -1
    """Index of the joint that carries this one; -1 for the body. A parent has no parent itself."""
    mass: float = 0.0
    """Mass that follows the joint [kg], included in the robot's mass; 0 neglects the change of the inertia."""
    place: Vector = (0.0, 0.0, 0.0)
    """Centre of that mass, at the angles of the robot's points."""
    low: float = -math.inf
    """Smallest commanded angle [rad]."""
    high: float = math.inf
    """Largest commanded angle [rad]."""
    maximum_rate: float = math.inf
    """Largest rate at which the angle follows its command [rad/s]."""
    time_constant: float = 0.0
    """First-order lag of the angle [s]."""
    dynamics: Coordinate | None = None

    def turned(self, angle: float) -> Joint:
        """The joint of points that have turned with it by ``angle`` [rad]: only the place of its mass moves."""
        axis, arm = np.array(self.axis), np.array(self.place) - np.array(self.origin)
        cos, sin = math.cos(angle), math.sin(angle)
        moved = cos * arm + sin * np.cross(axis, arm) + (1.0 - cos) * axis * (axis @ arm)
        x, y, z = (np.array(self.origin) + moved).tolist()
        return replace(self, place=(x, y, z))
