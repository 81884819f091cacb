"""Kinematics: wheel speeds and steering angles of a commanded motion, for each kind of drive."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SKID, DIFFERENTIAL, ACKERMANN, FOUR_WHEEL_STEERING, INDEPENDENT = (
    "skid", "differential", "ackermann", "four_wheel_steering", "independent",
)  # fmt: skip
DRIVE_KINDS = (SKID, DIFFERENTIAL, ACKERMANN, FOUR_WHEEL_STEERING, INDEPENDENT)
STEERED_KINDS = (ACKERMANN, FOUR_WHEEL_STEERING, INDEPENDENT)

STANDSTILL = 1e-3
"""Speed below which a robot stands, and its steering is straight [m/s]; commands are not that fine."""
_WIDEST = 0.95
"""Largest curvature times the distance of a pivot to the side, so that no steered wheel stands in the turn's centre."""
_LARGEST_SINE = 0.999
"""Of the angle that a pivot's trail adds: within the trail's reach no angle lets the wheel roll."""


@dataclass(frozen=True)
class SteeredDrive:
    """Inverse kinematics of steered wheels, as in ros2_controllers' steering controllers; lengths in the base frame.

    ``ackermann`` turns all wheels about one centre on the axle at ``reference_x``. The other kinds turn every wheel
    along its own velocity, which includes a lateral motion.
    """

    kind: str
    drive_places: Tensor
    """Centre of each drive's wheel, ``[D, 2]`` (x, y) [m]."""
    drive_joints: tuple[int, ...]
    """Index in ``joints`` of the joint that steers each drive's wheel; -1 if none does."""
    joints: tuple[int, ...]
    """Indices of the steering joints in the robot's joints, ``S`` of them."""
    joint_places: Tensor
    """Pivot of each steering joint, ``[S, 2]`` (x, y) [m]."""
    joint_offsets: Tensor
    """Centre of each steered wheel relative to its pivot at angle 0, ``[S, 2]`` (trail ahead, scrub) [m]."""
    joint_limits: Tensor
    """Largest angle of each to either side, ``[S]`` [rad]."""
    reference_x: float
    """Position of the axle about which the robot turns (``ackermann``), or of the point that a command means [m]."""
    differentials: tuple[tuple[int, ...], ...] = ()
    """Drives that share a motor through a differential, for each differential (``ackermann``)."""

    @property
    def crabs(self) -> bool:
        """Whether the robot can move sideways."""
        return self.kind != ACKERMANN

    @property
    def wheelbase(self) -> float:
        """Largest distance of a steered wheel from the axle about which the robot turns [m]: that of the bicycle."""
        return float((self.joint_places[:, 0] - self.reference_x).abs().max())

    @property
    def maximum_curvature(self) -> float:
        """Largest curvature that the steering reaches with all wheels about one centre [1/m] (``ackermann``)."""
        ahead = (self.joint_places[:, 0] - self.reference_x).double()
        aside = self.joint_places[:, 1].abs().double()
        trail = self.joint_offsets[:, 0].double() * torch.sign(ahead)
        sine, cosine = (part(self.joint_limits.double().clamp(max=1.57)) for part in (torch.sin, torch.cos))
        steers = ahead.abs() > 1e-6
        if not bool(steers.any()):
            return 0.0
        # The wheel inside the turn, at its limit, rolls along this curvature.
        reached = float((sine / (ahead.abs() * cosine + trail + aside * sine).clamp_min(1e-3))[steers].min())
        widest = float(aside.max())
        return min(reached, _WIDEST / widest) if widest > 0 else reached

    def command(self, twist: Tensor) -> tuple[Tensor, Tensor]:
        """Drive speeds ``[..., D]`` [m/s] and steering angles ``[..., S]`` [rad] of a commanded motion.

        Args:
            twist: forward speed [m/s], yaw rate [rad/s] and, optionally, lateral speed [m/s], ``[..., 2]`` or
                ``[..., 3]``; ``ackermann`` ignores the lateral speed.
        """
        return self._about_one_centre(twist) if self.kind == ACKERMANN else self._along_its_velocity(twist)

    def steering_of_drives(self, angles: Tensor) -> Tensor:
        """Steering angle of each drive's wheel ``[..., D]`` from those of the joints ``[..., S]``; 0 if not steered."""
        padded = torch.cat([angles, torch.zeros_like(angles[..., :1])], dim=-1)
        return padded[..., list(self.drive_joints)]

    def divided(self, speeds: Tensor, angles: Tensor) -> Tensor:
        """Drive speeds ``[..., D]`` [m/s] behind the differentials.

        A motor turns its differential at the mean of the speeds commanded for its wheels. The wheels share it as the
        lengths of their paths, which follow from where the wheels point, not from what was commanded: a differential
        resists no turn.

        Args:
            speeds: commanded, ``[..., D]`` [m/s].
            angles: of the steering joints, ``[..., S]`` [rad].
        """
        if not self.differentials:
            return speeds
        curvature = self.curvature(angles)[..., None]
        paths = self._rolling(torch.ones_like(curvature), curvature, torch.zeros_like(curvature), angles)
        behind = list(speeds.unbind(-1))
        for wheels_of_motor in self.differentials:
            chosen = list(wheels_of_motor)
            mean, path = speeds[..., chosen].mean(-1), paths[..., chosen]
            for index, share in zip(chosen, (path / path.mean(-1, keepdim=True)).unbind(-1), strict=True):
                behind[index] = mean * share
        return torch.stack(behind, dim=-1)

    def curvature(self, angles: Tensor) -> Tensor:
        """Curvature of the turn about the axle at ``reference_x`` in which steered wheels slip sideways least.

        Args:
            angles: of the steering joints, ``[..., S]`` [rad]; those of a real linkage fit no turn exactly.

        Returns:
            ``[...]`` [1/m], limited to what the steering reaches.
        """
        places = self.joint_places.to(angles)
        trails = self.joint_offsets[:, 0].to(angles)
        slopes = (places[:, 0] - self.reference_x) * torch.cos(angles) + places[:, 1] * torch.sin(angles) + trails
        fitted = (slopes * torch.sin(angles)).sum(-1) / (slopes * slopes).sum(-1).clamp_min(1e-9)
        limit = self.maximum_curvature
        return fitted.clamp(-limit, limit)

    def _about_one_centre(self, twist: Tensor) -> tuple[Tensor, Tensor]:
        forward, yaw_rate = twist[..., :1], twist[..., 1:2]
        drives = forward.abs() > STANDSTILL
        limit = self.maximum_curvature
        curvature = torch.where(drives, yaw_rate / torch.where(drives, forward, 1.0), 0.0).clamp(-limit, limit)
        along, across = self._velocities(self.joint_places.to(twist), torch.ones_like(forward), curvature, 0.0)
        trails = curvature * self.joint_offsets[:, 0].to(twist)
        angles = torch.atan2(across, along) + _trailing(trails, torch.hypot(along, across))
        return forward * self._rolling(torch.ones_like(forward), curvature, 0.0, angles), angles

    def _along_its_velocity(self, twist: Tensor) -> tuple[Tensor, Tensor]:
        forward, yaw_rate = twist[..., :1], twist[..., 1:2]
        lateral = twist[..., 2:3] if twist.shape[-1] > 2 else torch.zeros_like(forward)
        along, across = self._velocities(self.joint_places.to(twist), forward, yaw_rate, lateral)
        moves = torch.hypot(along.detach(), across.detach()) > STANDSTILL
        # The wheel's line has no direction: it never turns by more than a right angle, and rolls backwards instead.
        direction = torch.where(along < 0, -1.0, 1.0).to(along)
        along, across = torch.where(moves, along.abs(), 1.0), torch.where(moves, direction * across, 0.0)
        trails = direction * yaw_rate * self.joint_offsets[:, 0].to(twist)
        angles = torch.atan2(across, along) + _trailing(trails, torch.hypot(along, across))
        limits = self.joint_limits.to(twist)
        angles = torch.where(moves, torch.minimum(torch.maximum(angles, -limits), limits), 0.0)
        return self._rolling(forward, yaw_rate, lateral, angles), angles

    def _velocities(
        self, places: Tensor, forward: Tensor, yaw_rate: Tensor, lateral: Tensor | float
    ) -> tuple[Tensor, Tensor]:
        """Velocities of places ``[N, 2]`` forward and to the left, each ``[..., N]``, in a motion ``[..., 1]`` of the
        reference point."""
        return forward - yaw_rate * places[:, 1], lateral + yaw_rate * (places[:, 0] - self.reference_x)

    def _rolling(self, forward: Tensor, yaw_rate: Tensor, lateral: Tensor | float, angles: Tensor) -> Tensor:
        """Speed of each drive's wheel along its rolling direction ``[..., D]``, with the joints at angles ``[..., S]``.

        A wheel beside its pivot is slower in a turn, as the pivot's circle is the larger one.
        """
        joints = list(self.drive_joints)
        steered = torch.tensor([joint >= 0 for joint in joints], device=angles.device)
        # Of wheels that are not steered, the last row counts for nothing.
        pivots, offsets = (
            torch.cat([table, table.new_zeros(1, 2)])[joints].to(angles)
            for table in (self.joint_places, self.joint_offsets)
        )
        places = torch.where(steered[:, None], pivots, self.drive_places.to(angles))
        along, across = self._velocities(places, forward, yaw_rate, lateral)
        turned = self.steering_of_drives(angles)
        return along * torch.cos(turned) + across * torch.sin(turned) - yaw_rate * offsets[:, 1]


def _trailing(trails: Tensor, speeds: Tensor) -> Tensor:
    """Angle by which a wheel ahead of its pivot turns further, so that its centre moves along it [rad].

    Args:
        trails: speed to the side of the wheel's centre relative to the pivot, ``[..., S]`` [m/s].
        speeds: of the pivot, ``[..., S]`` [m/s].
    """
    return torch.asin((trails / speeds).clamp(-_LARGEST_SINE, _LARGEST_SINE))
