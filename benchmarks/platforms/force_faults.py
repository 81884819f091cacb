"""Faults that pull, brake or turn the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from injection import TICK, BaseState, Injection, sign

_NOTHING = np.zeros(3)


@dataclass
class BodyForce(Injection):
    """A constant force in the base frame."""

    x: float = 0.0
    y: float = 0.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The force, along the heading."""
        cos, sin = math.cos(state.heading), math.sin(state.heading)
        return np.array([cos * self.x - sin * self.y, sin * self.x + cos * self.y, 0.0]), _NOTHING


@dataclass
class WorldForce(Injection):
    """A constant force in the world frame, such as gravity's part along a slope that no map shows."""

    force: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The force."""
        return self.force, _NOTHING


@dataclass
class Drag(Injection):
    """Resistance against the motion: Coulomb, linear and quadratic in the forward speed.

    Attributes:
        coulomb: [N].
        linear: [N s/m].
        quadratic: [N s²/m²].
    """

    coulomb: float = 0.0
    linear: float = 0.0
    quadratic: float = 0.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The force against the velocity in the plane."""
        velocity = state.rotation @ state.velocity
        velocity[2] = 0.0
        speed = float(np.linalg.norm(velocity))
        size = self.coulomb * float(sign(speed, 0.05)) + self.linear * speed + self.quadratic * speed**2
        return -velocity / max(speed, 1e-6) * size, _NOTHING


@dataclass
class RollingResistance(Injection):
    """Resistance of the ground to every wheel that rolls over it: in turns on the spot, too, unlike a drag of the body.

    Attributes:
        force: on each wheel at more than a creep [N], against its velocity along the robot.
        wheels: where they touch the ground, in the base frame ``[wheels, 3]`` [m].
        centre: of mass, in the base frame ``[3]`` [m].
    """

    force: float = 0.0
    wheels: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The forces on all wheels together."""
        along = state.velocity[0] - state.rates[2] * self.wheels[:, 1]
        forces = np.zeros_like(self.wheels)
        forces[:, 0] = -self.force * sign(along, 0.05)
        torque = np.cross(self.wheels - self.centre, forces).sum(axis=0)
        return state.rotation @ forces.sum(axis=0), state.rotation @ torque


@dataclass
class TurnResistance(Injection):
    """A torque against turning, as of tyres that scrub.

    Attributes:
        coulomb: [N m].
        viscous: [N m s/rad].
    """

    coulomb: float = 0.0
    viscous: float = 0.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The torque against the yaw rate."""
        rate = float(state.rates[2])
        return _NOTHING, np.array([0.0, 0.0, -self.coulomb * float(sign(rate, 0.1)) - self.viscous * rate])


@dataclass
class TractionAssist(Injection):
    """Longitudinal grip beyond that of the wheels in the engine, whose friction is lower in every direction.

    Together they make ground on which a tyre grips more along than across, such as furrows or grass on a slope.

    Attributes:
        grip: largest force of a side [N].
        radius: of the wheels [m].
        track: lateral distance of the wheels [m].
    """

    grip: float = 0.0
    radius: float = 0.1
    track: float = 0.5

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """Coulomb forces against the longitudinal slip of both sides."""
        half = len(state.wheel_speeds) // 2
        surface = self.radius * np.array([state.wheel_speeds[:half].mean(), state.wheel_speeds[half:].mean()])
        sides = np.array([0.5, -0.5]) * self.track
        forces = self.grip * np.asarray(sign(surface - (state.velocity[0] - state.rates[2] * sides), 0.05))
        forward = state.rotation[:, 0] * (1.0, 1.0, 0.0)
        return forward * forces.sum(), np.array([0.0, 0.0, -float(forces @ sides)])


@dataclass
class GustingWind(Injection):
    """Gusts of random direction and strength that last a few seconds."""

    force: float = 0.0
    seed: int = 0

    def __post_init__(self):
        random = np.random.default_rng(self.seed)
        steps = random.standard_normal((400, 2)) * self.force
        self._series = np.repeat(steps, 2, axis=0)

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The gust of this second pair."""
        x, y = self._series[int(time)]
        return np.array([x, y, 0.0]), _NOTHING


@dataclass
class Tether(Injection):
    """An elastic cable to the place where the drive started.

    Attributes:
        stiffness: [N/m].
        slack: its free length [m].
        largest: tension at which the drum slips [N].
    """

    stiffness: float = 0.0
    slack: float = 1.0
    largest: float = math.inf
    _anchor: np.ndarray | None = None

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The tension towards the anchor."""
        if self._anchor is None:
            self._anchor = state.position.copy()
        towards = (self._anchor - state.position) * (1.0, 1.0, 0.0)
        distance = float(np.linalg.norm(towards))
        tension = min(self.stiffness * max(distance - self.slack, 0.0), self.largest)
        return towards / max(distance, 1e-6) * tension, _NOTHING


@dataclass
class SloshingLoad(Injection):
    """Liquid in an open tank: a mass on a spring that swings with the accelerations.

    Attributes:
        mass: [kg].
        frequency: of the liquid [Hz].
    """

    mass: float = 0.0
    frequency: float = 0.6
    _position: np.ndarray | None = None
    _velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The force of the spring and the damper on the robot."""
        here, moving = state.position[:2], (state.rotation @ state.velocity)[:2]
        if self._position is None:
            self._position, self._velocity = here.copy(), moving.copy()
        rate = 2 * math.pi * self.frequency
        pull = self.mass * (rate**2 * (here - self._position) + 0.1 * rate * (moving - self._velocity))
        self._velocity = self._velocity + TICK * pull / self.mass
        self._position = self._position + TICK * self._velocity
        return np.array([-pull[0], -pull[1], 0.0]), _NOTHING


@dataclass
class Furrows(Injection):
    """Resistance that depends on the heading in the world: easy along the furrows, hard across them."""

    force: float = 0.0
    direction: float = 0.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """Coulomb drag that grows with the sine of the angle to the furrows."""
        velocity = (state.rotation @ state.velocity) * (1.0, 1.0, 0.0)
        speed = float(np.linalg.norm(velocity))
        size = self.force * abs(math.sin(state.heading - self.direction)) * float(sign(speed, 0.05))
        return -velocity / max(speed, 1e-6) * size, _NOTHING


@dataclass
class SpeedPull(Injection):
    """A torque that grows with the square of the forward speed, such as of a bent fin.

    Attributes:
        torque: at 1 m/s [N m].
    """

    torque: float = 0.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The torque about z."""
        speed = float(state.velocity[0])
        return _NOTHING, np.array([0.0, 0.0, self.torque * speed * abs(speed)])


@dataclass
class SteeringHunt(Injection):
    """A torque that swings to and fro, as of an unbalanced rotating tool.

    Attributes:
        torque: amplitude [N m].
        period: [s].
    """

    torque: float = 0.0
    period: float = 3.0

    def wrench(self, time: float, state: BaseState) -> tuple[np.ndarray, np.ndarray]:
        """The torque about z."""
        return _NOTHING, np.array([0.0, 0.0, self.torque * math.sin(2 * math.pi * time / self.period)])
