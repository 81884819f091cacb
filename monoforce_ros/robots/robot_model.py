"""RobotModel: the physical model of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.robots.joint import Coordinate, Joint
from monoforce_ros.robots.kinematics import ACKERMANN, SteeredDrive
from monoforce_ros.robots.mass import add_point_mass

_ABOVE, _LEAST_HEADROOM = 0.2, 0.9
"""Room that a robot needs above itself [m], and what it needs in any case: a mast that its file does not describe."""
_SELF = 0.05
"""How far beyond a robot's outermost points returns are taken for the robot [m]: half a cell of the maps. A lidar's
noise is less, and what is nearer to a bumper than that has been hit."""


@dataclass(frozen=True)
class Flipper:
    """An arm with a driven belt that rotates about a lateral axis; its pose is kinematic (paper III-D)."""

    name: str
    joint: tuple[float, float, float]
    """Centre of the axle in the base frame [m]."""
    end: str
    """``front``: at angle 0 it points forward; ``rear``: backward. Positive angles raise the tip."""
    mass: float
    """Mass [kg], included in the robot's mass."""
    centre: float
    """Distance of its centre of mass from the axle [m]."""

    def turned(self, angle: Tensor) -> Tensor:
        """Rotation ``[3, 3]`` of the arm, which points forward at the identity."""
        about_y = -angle if self.end == "front" else angle + torch.pi
        cos, sin = torch.cos(about_y), torch.sin(about_y)
        zero, one = torch.zeros_like(cos), torch.ones_like(cos)
        return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos]).reshape(3, 3)


@dataclass(frozen=True)
class RobotModel:
    """A rigid body sampled by surface points; drives move some of them (paper III-B, III-D).

    All lengths are in the robot's base frame (x forward, y left, z up; REP 103) and in metres. Physical quantities
    may have a leading batch dimension ``[B]``, to vary them between the trajectories of a rollout.
    """

    name: str
    base_frame: str
    mass: Tensor
    """Mass [kg], shape ``[]`` or ``[B]``."""
    centre_of_mass: Tensor
    """Position of the centre of mass [m], ``[3]`` or ``[B, 3]``."""
    inertia: Tensor
    """Inertia about the centre of mass, in base-frame axes [kg m²], ``[3, 3]`` or ``[B, 3, 3]``."""
    points: Tensor
    """Surface points [m], ``[N, 3]``."""
    point_areas: Tensor
    """Surface area of each point [m²], ``[N]``; forces scale with it, so that they do not depend on the sampling."""
    point_tangents: Tensor
    """Velocity of the surface relative to the body for a drive speed of 1 m/s [-], ``[N, 3]``; zero on the hull."""
    point_drives: Tensor
    """Index of the drive of each point, ``[N]`` int64; -1 on the hull."""
    drive_names: tuple[str, ...]
    drive_offsets: Tensor
    """Lateral offset y of each drive for the conversion of twists into drive speeds [m], ``[D]``."""
    friction_longitudinal: Tensor
    """Factor on the terrain's friction along the rolling direction [-], ``[]`` or ``[B]``."""
    friction_lateral: Tensor
    """Factor on the terrain's friction across the rolling direction [-], ``[]`` or ``[B]``."""
    maximum_speed: float = float("inf")
    """Largest commanded forward speed [m/s]."""
    maximum_yaw_rate: float = float("inf")
    """Largest commanded yaw rate [rad/s]."""
    wheel_radius: float | None = None
    """Mean radius of the driven wheels [m]; None without wheels."""
    sensors: Mapping[str, Tensor] = field(default_factory=dict)
    """Pose of each sensor frame in the base frame: ``[4, 4]`` homogeneous matrix, base ← sensor."""

    flippers: tuple[Flipper, ...] = ()
    flipper_angles: Tensor | None = None
    """Angles of the flippers [rad], ``[F]``."""
    point_flippers: Tensor | None = None
    """Index of the flipper of each point, ``[N]`` int64; -1 elsewhere."""
    point_outward: Tensor | None = None
    """Unit normal of the hull at each point, outwards, ``[N, 3]``; zero on belts. None stands for zeros."""
    point_widths: Tensor | None = None
    """Width of the belt or shorter edge of the hull's face at each point, ``[N]`` [m]; soft soil needs it."""
    point_curvatures: Tensor | None = None
    """Curvature of the belt along its way, ``[N]`` [1/m]; 0 where it is straight and on the hull."""
    effects: tuple[tuple[str, Mapping[str, float | Tensor]], ...] = ()
    """Effects of the robot: names and parameter values, see :mod:`monoforce_ros.effects`."""
    effect_intervals: tuple[tuple[str, Mapping[str, tuple[float, float]]], ...] = ()
    """95 % confidence intervals of effect parameters, where known."""
    joints: tuple[Joint, ...] = ()
    """What moves in the body: springs and rockers first, which may carry others; flippers last."""
    joint_angles: Tensor | None = None
    """Angles of the joints at which the points are given [rad], ``[J]``."""
    point_joints: Tensor | None = None
    """Index of the joint that carries each point, ``[N]`` int64; -1 on the body."""
    point_grip: Tensor | None = None
    """0 for points of wheels that roll freely, 1 elsewhere, ``[N]``; None: 1."""
    motors: tuple[Coordinate | None, ...] = ()
    """Limits of each drive, at the rim of its wheels (m for rad, N for N m); empty: none has any."""
    steered: SteeredDrive | None = None
    """Inverse kinematics of a robot that steers wheels; None: it turns by different speeds of its sides."""
    maximum_lateral_speed: float = float("inf")
    """Largest commanded lateral speed [m/s]."""

    @property
    def number_of_drives(self) -> int:
        """Number of drives."""
        return len(self.drive_names)

    @property
    def maximum_curvature(self) -> float:
        """Largest curvature of a turn [1/m]; infinite for a robot that turns in place."""
        if self.steered is None or self.steered.kind != ACKERMANN:
            return float("inf")
        return self.steered.maximum_curvature

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest coordinates of the body's points [m], each ``[3]``."""
        return self.points.amin(dim=0), self.points.amax(dim=0)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Which points ``[n, 3]`` [m] (base frame) belong to the robot, its load, or anything above it, ``[n]`` bool.

        Points on the ground below the body do not.
        """
        low, high = (bound.cpu().numpy() for bound in self.bounds)
        across = ((points[:, :2] > low[:2] - _SELF) & (points[:, :2] < high[:2] + _SELF)).all(axis=1)
        return across & (points[:, 2] > low[2] + 0.05)

    def with_points(self, keep: Tensor) -> RobotModel:
        """The robot with only the points ``keep`` ``[N]`` bool; mass and inertia stay."""
        flippers = None if self.point_flippers is None else self.point_flippers[keep]

        def kept(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[keep]

        return replace(
            self,
            points=self.points[keep],
            point_areas=self.point_areas[keep],
            point_tangents=self.point_tangents[keep],
            point_drives=self.point_drives[keep],
            point_flippers=flippers,
            point_outward=kept(self.point_outward),
            point_widths=kept(self.point_widths),
            point_curvatures=kept(self.point_curvatures),
            point_joints=None if self.point_joints is None else self.point_joints[keep],
            point_grip=None if self.point_grip is None else self.point_grip[keep],
        )

    @property
    def moves_joints(self) -> bool:
        """Whether a joint or drive responds to forces, so that its motion is part of every rollout."""
        return any(joint.dynamics is not None for joint in self.joints) or any(self.motors)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def ground_clearance(self) -> float:
        """Height of the base frame above the lowest driven point [m]."""
        return -float(self.points[self.point_drives >= 0][:, 2].min())

    @property
    def headroom(self) -> float:
        """Vertical gap that the robot passes under [m]: the height of its body and sensors above the ground and
        :data:`_ABOVE`, but at least :data:`_LEAST_HEADROOM`."""
        tops = [self.bounds[1][2], *(pose[2, 3] for pose in self.sensors.values())]
        return max(_LEAST_HEADROOM, max(float(top) for top in tops) + self.ground_clearance + _ABOVE)

    @property
    def underside(self) -> Tensor:
        """Points at the bottom of wheels, tracks and flippers, which level ground carries ``[n, 3]`` [m]."""
        backwards = self.point_tangents[:, 0]
        # Small wheels have twelve samples, of which the lowest is up to 15° from the bottom.
        limit = -0.97 if bool((backwards < -0.97).any()) else float(backwards.min()) + 0.02
        return self.points[backwards < limit]

    def posed(self, angles: Tensor) -> RobotModel:
        """The robot with its flippers at ``angles`` [rad] ``[F]``, including the change of its mass properties.

        Raises ``ValueError`` if the robot has another number of flippers.
        """
        current = self.flipper_angles if self.flipper_angles is not None else self.points.new_zeros(0)
        if angles.shape != (len(self.flippers),):
            raise ValueError(f"flipper angles: got shape {tuple(angles.shape)}, expected [{len(self.flippers)}]")
        angles = angles.to(self.points)
        points, tangents = self.points.clone(), self.point_tangents.clone()
        mass, centre, inertia = self.mass, self.centre_of_mass, self.inertia
        turns = (angles.detach() - current.detach()).tolist()
        for index, flipper in enumerate(self.flippers):
            before, after = flipper.turned(current[index]), flipper.turned(angles[index])
            turn = after @ before.T
            joint = points.new_tensor(flipper.joint)
            on_flipper = self.point_flippers == index
            points[on_flipper] = joint + (self.points[on_flipper] - joint) @ turn.T
            tangents[on_flipper] = self.point_tangents[on_flipper] @ turn.T
            flipper_mass = points.new_tensor(flipper.mass)
            for sign, pose in ((-1.0, before), (1.0, after)):
                place = joint + flipper.centre * pose[:, 0]
                mass, centre, inertia = add_point_mass(mass, centre, inertia, sign * flipper_mass, place)
        joint_angles, joints = self.joint_angles, self.joints
        if joint_angles is not None and self.flippers:
            joint_angles = torch.cat([joint_angles[: -len(self.flippers)], angles])
            moved = [joint.turned(angle) for joint, angle in zip(self.joints[-len(angles) :], turns, strict=True)]
            joints = (*self.joints[: -len(angles)], *moved)
        return replace(
            self,
            joints=joints,
            joint_angles=joint_angles,
            points=points,
            point_tangents=tangents,
            mass=mass,
            centre_of_mass=centre,
            inertia=inertia,
            flipper_angles=angles,
        )

    def limited_twist(self, twist: Tensor) -> Tensor:
        """A commanded twist ``[..., 2]`` or ``[..., 3]`` (forward, yaw rate, lateral) within the robot's limits.

        At its largest speed a steered robot keeps the curvature: its wheels stay where the steering turned them.
        """
        forward = twist[..., :1].clamp(-self.maximum_speed, self.maximum_speed)
        if self.steered is not None:
            asked = twist[..., :1].abs()
            too_fast = asked > self.maximum_speed
            share = torch.where(too_fast, self.maximum_speed / torch.where(too_fast, asked, 1.0), 1.0)
            twist = torch.cat([forward, share * twist[..., 1:]], dim=-1)
        yaw_rate = twist[..., 1:2].clamp(-self.maximum_yaw_rate, self.maximum_yaw_rate)
        lateral = twist[..., 2:].clamp(-self.maximum_lateral_speed, self.maximum_lateral_speed)
        return torch.cat([forward, yaw_rate, lateral], dim=-1)

    def drive_speeds(self, twist: Tensor) -> Tensor:
        """Ideal drive speeds of a commanded twist, limited to the robot's maximum speeds.

        Args:
            twist: forward speed [m/s], yaw rate [rad/s] and, optionally, lateral speed [m/s], ``[..., 2]`` or
                ``[..., 3]``.

        Returns:
            surface speed of each drive [m/s], ``[..., D]``, positive forward.
        """
        return self.command(twist)[0]

    def command(self, twist: Tensor) -> tuple[Tensor, Tensor]:
        """Ideal drive speeds ``[..., D]`` [m/s] and steering angles ``[..., S]`` [rad] of a commanded twist.

        Steering angles are in the order of ``steered.joints``; ``S`` is 0 for a robot that does not steer.
        """
        limited = self.limited_twist(twist)
        if self.steered is not None:
            return self.steered.command(limited)
        forward, yaw_rate = limited[..., :1], limited[..., 1:2]
        return forward - yaw_rate * self.drive_offsets.to(twist), limited[..., :0]

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> RobotModel:
        """The same robot with its floating-point tensors in another precision or on another device."""
        changed: dict[str, Any] = {}  # `replace` takes values of every field's type
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, Tensor):
                changed[entry.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        if all(value is getattr(self, name) for name, value in changed.items()):
            return self
        return replace(self, **changed)
