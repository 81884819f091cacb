"""Vehicle parts: wheels and what carries them (springs, steering, casters, rockers, flippers), as bodies in MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic.graphics import mujoco

GROUP = 5
"""Geometry group of the robot, which lidar rays ignore."""
GRAVITY = 9.81

# Tyres and servos of a robot of this mass with four wheels, tuned to turn like the real one without hopping. They scale
# with the robot's mass and are divided among its wheels.
_REFERENCE_MASS = 50.0
_TYRE_STIFFNESS = 60_000.0
_TYRE_DAMPING = 2_800.0
_SERVO_GAIN = 1_200.0
# Inertia of motors and gears reflected to the wheels [kg m²]; without it a robot at rest vibrates.
_GEAR_INERTIA = 0.4
_REFERENCE_RADIUS = 0.165
# Stiffness [N m/rad] and damping [N m s/rad] of the servos of joints, per kilogram of the robot: stiff enough to hold a
# tyre that is pushed sideways, and an arm that carries the robot.
_STEERING_STIFFNESS, _STEERING_DAMPING = 10.0, 0.3
_ARM_STIFFNESS, _ARM_DAMPING = 50.0, 2.5
_HUB_INERTIA = 1e-4
_ARM_INERTIA = 0.01


@dataclass(frozen=True)
class Servo:
    """How a joint follows its commands; angles in radians."""

    low: float = -math.inf
    high: float = math.inf
    maximum_rate: float = math.inf
    """[rad/s]."""
    time_constant: float = 0.0
    """First-order lag [s]."""
    maximum_torque: float = math.inf
    """[N m]."""


@dataclass(frozen=True)
class Pivot:
    """A vertical axis about which a wheel turns: steered by a servo, or as a caster."""

    name: str
    place: np.ndarray
    """A point on the axis in the base frame [m], ``[3]``."""
    servo: Servo | None
    """None: the contact forces turn it."""
    damping: float = 0.0
    """Of a caster's bearing [N m s/rad]."""


@dataclass(frozen=True)
class Spring:
    """A wheel's suspension along the base frame's z axis."""

    stiffness: float
    """[N/m]."""
    damping: float
    """[N s/m]."""
    preload: float
    """Force at rest [N]."""
    low: float = -math.inf
    """Lowest position of the wheel, relative to that at rest [m]."""
    high: float = math.inf


@dataclass(frozen=True)
class Arm:
    """A part that turns about an axis of the chassis and carries wheels: a flipper with a servo, or a free rocker."""

    name: str
    place: np.ndarray
    """A point on the axis in the base frame [m], ``[3]``."""
    axis: np.ndarray
    """Direction of the axis, ``[3]``."""
    mass: float
    """With its wheels [kg]; 0 for one whose mass belongs to the chassis."""
    centre: np.ndarray
    """Centre of that mass at the file's angle [m], ``[3]``."""
    angle: float
    """Angle in the robot file, which is the model's zero [rad]."""
    servo: Servo | None
    """None: it turns freely."""
    damping: float = 0.0
    """Of a rocker's bearing [N m s/rad]."""
    limit: float = math.inf
    """Stop of a rocker to either side [rad]."""

    def add_to(self, base: mujoco.MjsBody, robot_mass: float, wheels: list[Wheel], wheel_mass: float) -> mujoco.MjsBody:
        """Add the arm to the chassis; its wheels follow."""
        body = base.add_body(name=f"{self.name}_arm", pos=self.place)
        own = self.mass - wheel_mass * len(wheels) if self.mass else 0.0
        centre = np.zeros(3)
        if own > 0.0:
            carried = sum((wheel.centre - self.place) * wheel_mass for wheel in wheels)
            centre = (self.mass * (self.centre - self.place) - carried) / own
        set_inertia(body, max(own, 1e-3 * robot_mass), np.full(3, _ARM_INERTIA * robot_mass / 60.0), centre)
        hinge = body.add_joint(name=self.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=self.axis)
        hinge.armature = 8e-4 * robot_mass
        hinge.damping = [max(self.damping, 0.01 * robot_mass if self.servo else 0.0), 0.0, 0.0]
        if math.isfinite(self.limit):
            hinge.range, hinge.limited = [-self.limit, self.limit], mujoco.mjtLimited.mjLIMITED_TRUE
        return body


@dataclass(frozen=True)
class Wheel:
    """A wheel; lengths in metres, in the base frame."""

    name: str
    side: float
    """Lateral offset that maps a twist to this wheel's speed, where its drive belongs to a side [m]."""
    centre: np.ndarray
    """``[3]``, with all joints as in the robot file."""
    radius: float
    width: float
    driven: bool = True
    """Whether a servo turns it; otherwise it rolls freely."""
    pivot: Pivot | None = None
    spring: Spring | None = None
    arm: str = ""
    """Name of the arm that carries it; empty: the chassis."""
    is_scaled: bool = False
    """Whether servo and gear are scaled to the wheel's radius, as on robots that steer."""
    maximum_torque: float = math.inf
    """Of its motor at standstill [N m]."""
    differential: str = ""
    """Name of the differential through which it is driven; empty: by a servo of its own."""

    @property
    def joint(self) -> str:
        """Name of its joint in the model and in joint states."""
        return f"{self.name}_wheel"

    @property
    def surface(self) -> str:
        """Name of its contact geometry."""
        return f"{self.name}_surface"

    def add_to(
        self,
        spec: mujoco.MjSpec,
        carrier: mujoco.MjsBody,
        origin: np.ndarray,
        robot_mass: float,
        wheels: int,
        mass: float,
    ) -> None:
        """Add the wheel to the body that carries it.

        Args:
            spec: the model.
            carrier: chassis or arm.
            origin: of the carrier's frame in the base frame [m].
            robot_mass: [kg].
            wheels: number of wheels among which tyres and servos are divided.
            mass: of the wheel [kg].
        """
        body = carrier.add_body(name=self.joint, pos=self.centre - origin)
        set_inertia(body, mass, wheel_moments(self, mass))
        share = robot_mass / _REFERENCE_MASS / wheels
        if not self.arm or self.spring is not None:
            self._add_tyre(body, share, robot_mass, wheels)
        if self.pivot is not None:
            hinge = body.add_joint(
                name=self.pivot.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1],
                pos=self.pivot.place - self.centre,
            )  # fmt: skip
            hinge.armature = _HUB_INERTIA * robot_mass
            hinge.damping = [self.pivot.damping if self.pivot.servo is None else 0.002 * robot_mass, 0.0, 0.0]
        scale = (self.radius / _REFERENCE_RADIUS) ** 2 if self.is_scaled else 1.0
        axle = body.add_joint(name=self.joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        axle.armature = share * _GEAR_INERTIA * scale if self.driven else 0.0
        lying = quaternion_wxyz(Rotation.from_euler("x", 90, degrees=True))
        size = [self.radius, self.width / 2, 0.0]
        # The tyre's friction takes priority over the ground's, so that it can vary with position.
        body.add_geom(
            name=self.surface, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, quat=lying,
            rgba=[0.08, 0.08, 0.09, 1], priority=1, **collides(),
        )  # fmt: skip
        hub = [0.5 * self.radius, self.width / 2 + 0.005, 0.0]
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=hub, quat=lying, rgba=[0.45, 0.45, 0.47, 1], group=GROUP,
            contype=0, conaffinity=0,
        )  # fmt: skip
        if self.driven:
            # A differential is a tendon: as long as the mean of its wheels' angles, it pulls at all of them alike.
            target = self.differential or self.joint
            through = mujoco.mjtTrn.mjTRN_TENDON if self.differential else mujoco.mjtTrn.mjTRN_JOINT
            servo = spec.add_actuator(name=self.joint, target=target, trntype=through)
            servo.set_to_velocity(kv=share * _SERVO_GAIN * scale)
            _limit_torque(servo, self.maximum_torque)

    def _add_tyre(self, body: mujoco.MjsBody, share: float, robot_mass: float, wheels: int) -> None:
        tyre = body.add_joint(name=f"{self.name}_tyre", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        if self.spring is None:
            stiffness = share * _TYRE_STIFFNESS
            tyre.stiffness = [stiffness, 0.0, 0.0]
            tyre.damping = [share * _TYRE_DAMPING, 0.0, 0.0]
            # Preload: at rest on level ground the base frame keeps its height.
            tyre.springref = -robot_mass * GRAVITY / wheels / stiffness
            return
        spring = self.spring
        tyre.stiffness, tyre.damping = [spring.stiffness, 0.0, 0.0], [spring.damping, 0.0, 0.0]
        tyre.springref = -spring.preload / spring.stiffness
        if math.isfinite(spring.low) and math.isfinite(spring.high):
            tyre.range, tyre.limited = [spring.low, spring.high], mujoco.mjtLimited.mjLIMITED_TRUE


def add_joint_servo(spec: mujoco.MjSpec, part: Pivot | Arm, robot_mass: float) -> None:
    """Add the position servo of a steered wheel or of a flipper."""
    assert part.servo is not None
    stiffness, damping = (
        (_ARM_STIFFNESS, _ARM_DAMPING) if isinstance(part, Arm) else (_STEERING_STIFFNESS, _STEERING_DAMPING)
    )
    servo = spec.add_actuator(name=part.name, target=part.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness * robot_mass, kv=damping * robot_mass)
    _limit_torque(servo, part.servo.maximum_torque)


def collides() -> dict[str, object]:
    """Collisions with the world but not with the robot itself: wheels overlap the chassis."""
    return {"contype": 2, "conaffinity": 1, "group": GROUP, "friction": [1.0, 0.005, 0.0001], "solref": [0.02, 1.0]}


def wheel_moments(wheel: Wheel, mass: float) -> np.ndarray:
    """Principal moments of inertia ``[3]`` of a wheel as a disc [kg m²]."""
    across = mass * (3 * wheel.radius**2 + wheel.width**2) / 12
    return np.array([across, mass * wheel.radius**2 / 2, across])


def set_inertia(body: mujoco.MjsBody, mass: float, inertia: np.ndarray, centre: np.ndarray | None = None) -> None:
    """Give a body its mass [kg], its inertia about the centre of mass [kg m²], and that centre.

    Args:
        body: of a model that is not compiled yet.
        mass: of the body alone.
        inertia: in the body's axes, ``[3, 3]``, or its moments ``[3]`` about them.
        centre: of mass in the body's frame [m], by default its origin. MuJoCo's own default is as far from the origin
            as that is from the parent's.
    """
    body.explicitinertial = True
    body.mass, body.ipos = mass, np.zeros(3) if centre is None else centre
    if inertia.ndim == 1:
        body.inertia = inertia
    else:
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def point_inertia(mass: float, offset: np.ndarray) -> np.ndarray:
    """Inertia ``[3, 3]`` of a point mass at an offset ``[3]`` [kg m²]."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def quaternion_wxyz(rotation: Rotation) -> np.ndarray:
    """Quaternion ``[4]`` with the scalar first, as MuJoCo takes it."""
    # SciPy puts the scalar last; its option scalar_first is newer than Ubuntu 24.04's SciPy 1.11.
    return np.roll(rotation.as_quat(), 1)


def _limit_torque(servo: mujoco.MjsActuator, torque: float) -> None:
    if math.isfinite(torque):
        servo.forcerange, servo.forcelimited = [-torque, torque], mujoco.mjtLimited.mjLIMITED_TRUE
