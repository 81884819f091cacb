"""Articulation: joints, free wheels and motors of a rollout, and the poses of the links that they move.

A link is what one joint moves; link 0 is the body, link j + 1 belongs to joint j. Joints and drives with dynamics are
the coordinates of a system that is solved together with the body's six velocities.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.rotation import exponential_map
from monoforce_ros.robots import Controls, Coordinate, RobotModel

PARAMETERS = (
    "inertia", "stiffness", "damping", "preload", "stall_torque", "no_load_rate", "maximum_torque", "maximum_power",
    "low", "high", "stop_stiffness",
)  # fmt: skip
"""Columns of :attr:`Articulation.parameters`, fields of :class:`Coordinate`."""
UNLIMITED = 1e30
"""Stands for infinity: a product with zero stays zero."""
ROUNDS = 3
"""How often the servos that reach their limits are searched for in a step: one that does may load another."""
SLOWEST = 1e-3
"""Smallest rate at which a power limits a torque [rad/s or m/s]; below it the torque limits do."""


@dataclass(frozen=True)
class Linkage:
    """What moves in the body, of the robot alone; ``J`` joints, ``D`` drives, ``K`` of them with dynamics."""

    axes: Tensor
    """``[J, 3]``."""
    origins: Tensor
    """``[J, 3]`` [m]."""
    places: Tensor
    """Centre of each joint's mass at the rest angles, ``[J, 3]`` [m]."""
    masses: Tensor
    """``[J]`` [kg]."""
    rest: Tensor
    """Angles at which the robot's points are given, ``[J]`` [rad]."""
    slides: tuple[bool, ...]
    parents: tuple[int, ...]
    point_links: Tensor
    """Link of each point, ``[N]`` int64."""
    grip: Tensor
    """0 for points of wheels that roll freely, else 1, ``[N]``."""
    coordinates: tuple[int, ...]
    """Index of each joint, then of each drive, among the coordinates; -1 without dynamics. ``J + D`` entries."""
    parameters: Tensor
    """Dynamics of each joint and drive, ``[J + D, 11]``, see :data:`PARAMETERS`."""
    free: Tensor
    """Whether a joint has dynamics, ``[J]`` bool."""
    powered: Tensor
    """Whether a drive has dynamics, ``[D]`` bool."""

    @classmethod
    def of_robot(cls, robot: RobotModel, drives: int) -> Linkage:
        """That of a robot, in the precision of the rollout."""
        joints, like, links = robot.joints, robot.points, robot.point_joints
        motors = robot.motors or (None,) * drives
        dynamics = [*(joint.dynamics for joint in joints), *motors]
        coordinates, found = [], 0
        for entry in dynamics:
            coordinates.append(found if entry is not None else -1)
            found += entry is not None
        return cls(
            axes=_table(like, [joint.axis for joint in joints]),
            origins=_table(like, [joint.origin for joint in joints]),
            places=_table(like, [joint.place for joint in joints]),
            masses=like.new_tensor([joint.mass for joint in joints]),
            rest=like.new_zeros(0) if robot.joint_angles is None else robot.joint_angles.to(like),
            slides=tuple(joint.slides for joint in joints),
            parents=tuple(joint.parent for joint in joints),
            point_links=torch.zeros_like(robot.point_drives) if links is None else links + 1,
            grip=torch.ones_like(robot.point_areas) if robot.point_grip is None else robot.point_grip.to(like),
            coordinates=tuple(coordinates),
            parameters=_parameters(like, dynamics),
            free=torch.tensor([joint.dynamics is not None for joint in joints], device=like.device, dtype=torch.bool),
            powered=torch.tensor([motor is not None for motor in motors], device=like.device),
        )


@dataclass(frozen=True)
class Articulation(Linkage):
    """A robot's linkage under controls."""

    target_angles: Tensor
    """``[B, T, J]`` [rad]."""
    target_rates: Tensor
    """``[B, T, J]`` [rad/s]."""
    angles: Tensor
    """Angles at all steps ``[B, T + 1, J]`` [rad]; of joints with dynamics, the start matters only."""
    rates: Tensor
    """``[B, T + 1, J]`` [rad/s], likewise."""
    belts: Tensor
    """Surface speeds of the drives ``[B, T + 1, D]`` [m/s], likewise."""

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return max(self.coordinates, default=-1) + 1

    @property
    def has_limits(self) -> bool:
        """Whether a servo or motor can give less torque than it is asked for."""
        limits = [PARAMETERS.index(name) for name in ("stall_torque", "maximum_torque", "maximum_power")]
        return bool((self.parameters[:, limits] < UNLIMITED).any())

    @property
    def dynamic_joints(self) -> list[int]:
        """Joints with dynamics."""
        return [joint for joint in range(len(self.slides)) if self.coordinates[joint] >= 0]

    @property
    def dynamic_drives(self) -> list[int]:
        """Drives with dynamics."""
        joints = len(self.slides)
        return [drive for drive, index in enumerate(self.coordinates[joints:]) if index >= 0]

    @classmethod
    def of(
        cls, robot: RobotModel, controls: Controls, speeds: Tensor, velocity: Tensor, rates: Tensor, time_step: float
    ) -> Articulation | None:
        """What moves in a robot under controls; None if nothing does.

        Args:
            robot: robot, in the precision of the rollout.
            controls: angles and rates of its joints.
            speeds: drive speeds, finite, ``[B, T, D]`` [m/s].
            velocity: velocity of the base frame's origin at the start in base axes, ``[B, 3]`` [m/s].
            rates: angular velocity at the start in base axes, ``[B, 3]`` [rad/s].
            time_step: [s].
        """
        commanded = controls.joint_angles is not None and bool(robot.joints)
        if not commanded and not robot.moves_joints and robot.point_grip is None:
            return None
        batch, steps, drives = speeds.shape
        number = len(robot.joints)
        given = (robot.joints, robot.motors, robot.joint_angles, robot.point_joints, robot.point_grip, robot.points)
        linkage = _linkages.get(
            (*given, robot.point_drives, robot.point_areas), lambda: Linkage.of_robot(robot, drives)
        )
        rest = linkage.rest
        targets = rest.expand(batch, steps, number) if controls.joint_angles is None else controls.joint_angles
        target_rates = torch.zeros_like(targets) if controls.joint_rates is None else controls.joint_rates
        targets, target_rates = targets.to(speeds), target_rates.to(speeds)
        first = targets[:, 0] if steps else rest.expand(batch, number)
        start = first if controls.start_angles is None else controls.start_angles.to(speeds)
        start_rates = torch.zeros_like(start) if controls.start_rates is None else controls.start_rates.to(speeds)
        built = cls(
            **{entry.name: getattr(linkage, entry.name) for entry in fields(linkage)},
            target_angles=targets,
            target_rates=target_rates,
            angles=_history(targets, start, linkage.free, target_rates, time_step),
            rates=_history(target_rates, start_rates, linkage.free),
            belts=speeds.new_zeros(batch, steps + 1, drives),
        )
        # Other drives turn as commanded from the start.
        rolling = built._rolling_speeds(robot, velocity, rates) if any(robot.motors) else built.belts[:, 0]
        return replace(built, belts=_history(speeds, rolling, linkage.powered))

    def _rolling_speeds(self, robot: RobotModel, velocity: Tensor, rates: Tensor) -> Tensor:
        """Surface speeds at which the drives roll at the start, ``[B, D]`` [m/s], from the motion in base axes."""
        turns = self.poses(self.angles[:, 0], self.rates[:, 0], None).turns
        listed = []
        for drive in range(len(self.coordinates) - len(self.slides)):
            chosen = robot.point_drives == drive
            middle = robot.points[chosen].mean(dim=0)
            ahead = turns[:, self.point_links[chosen][0], :, 0]
            moving = velocity + torch.linalg.cross(rates, middle.expand_as(rates))
            listed.append((moving * ahead).sum(-1))
        return torch.stack(listed, dim=-1)

    def poses(self, angles: Tensor, rates: Tensor, body: BodyMass | None) -> LinkPoses:
        """Poses of all links in base axes relative to the centre of mass.

        Args:
            angles: ``[B, J]`` [rad].
            rates: ``[B, J]`` [rad/s].
            body: mass properties at the rest angles; None neglects that they change, about the base frame.
        """
        links = self._links(angles, rates)
        zero = links.shifts[0]
        if body is None:
            centre, centre_rate, inertia = zero, zero, links.turns[0]
        else:
            centre, centre_rate = self._centre(links, body)
            inertia = body.inertia
            for joint, place in enumerate(links.places):
                before, after = self.places[joint] - body.centre, place - body.centre
                inertia = inertia + self.masses[joint] * (_square(after) - _square(before))
            # The sum is about the centre of mass at the rest angles.
            inertia = inertia - body.mass[:, None, None] * _square(centre - body.centre)
        return LinkPoses(
            turns=torch.stack(links.turns, 1),
            shifts=torch.stack([shift - centre for shift in links.shifts], 1),
            spins=torch.stack(links.spins, 1),
            drifts=torch.stack(
                [
                    torch.linalg.cross(spin, centre) + drift - centre_rate
                    for spin, drift in zip(links.spins, links.drifts, strict=True)
                ],
                1,
            ),
            axes=_stacked(links.axes, zero),
            origins=_stacked([origin - centre for origin in links.origins], zero),
            places=_stacked([place - centre for place in links.places], zero),
            centre=centre,
            centre_rate=centre_rate,
            inertia=inertia,
        )

    def _links(self, angles: Tensor, rates: Tensor) -> _Links:
        """Poses of all links in the base frame."""
        batch, like = angles.shape[0], angles
        zero, identity = like.new_zeros(batch, 3), torch.eye(3, dtype=like.dtype, device=like.device)
        links = _Links([identity.expand(batch, 3, 3)], [zero], [zero], [zero], [], [], [])
        # Turns of all joints in one call: most of a single trajectory's time goes into the number of calls.
        own = exponential_map(self.axes * (angles - self.rest)[..., None]) if len(self.slides) else None
        for joint, (slides, parent) in enumerate(zip(self.slides, self.parents, strict=True)):
            carrier = parent + 1
            turned, shift = links.turns[carrier], links.shifts[carrier]
            spin, drift = links.spins[carrier], links.drifts[carrier]
            axis = turned @ self.axes[joint]
            origin = turned @ self.origins[joint] + shift
            motion = axis * rates[:, joint, None]
            if slides:
                links.turns.append(turned)
                links.shifts.append(shift + axis * (angles[:, joint] - self.rest[joint])[:, None])
                links.spins.append(spin)
                links.drifts.append(drift + motion)
            else:
                assert own is not None
                turn = turned @ own[:, joint]
                links.turns.append(turn)
                links.shifts.append(origin - turn @ self.origins[joint])
                links.spins.append(spin + motion)
                links.drifts.append(drift - torch.linalg.cross(motion, origin))
            links.axes.append(axis)
            links.origins.append(origin)
            links.places.append(links.turns[-1] @ self.places[joint] + links.shifts[-1])
        return links

    def _centre(self, links: _Links, body: BodyMass) -> tuple[Tensor, Tensor]:
        """Centre of mass in the base frame ``[B, 3]`` [m] and its velocity there [m/s]."""
        centre, centre_rate = body.centre, torch.zeros_like(body.centre)
        for joint, place in enumerate(links.places):
            share = (self.masses[joint] / body.mass)[:, None]
            centre = centre + share * (place - self.places[joint])
            moving = torch.linalg.cross(links.spins[joint + 1], place) + links.drifts[joint + 1]
            centre_rate = centre_rate + share * moving
        return centre, centre_rate

    def centres(self, angles: Tensor, rates: Tensor, body: BodyMass) -> tuple[Tensor, Tensor]:
        """Centre of mass in the base frame and its velocity at all steps, each ``[B, S, 3]``.

        Args:
            angles, rates: of the joints, ``[B, S, J]``.
            body: mass properties at the rest angles.
        """
        batch, steps, _ = angles.shape
        if not bool((self.masses > 0).any()):
            centre = body.centre[:, None].expand(batch, steps, 3)
            return centre, torch.zeros_like(centre)
        links = self._links(angles.flatten(0, 1), rates.flatten(0, 1))
        centre, centre_rate = self._centre(links, body.repeated(steps))
        return centre.unflatten(0, (batch, steps)), centre_rate.unflatten(0, (batch, steps))

    def world_poses(self, angles: Tensor, rates: Tensor, rotation: Tensor, body: BodyMass) -> LinkPoses:
        """Poses in terrain axes at many steps, as a batch ``[B S]``.

        Args:
            angles, rates: ``[B, S, J]``.
            rotation: terrain ← base, ``[B, S, 3, 3]``.
            body: mass properties at the rest angles.
        """
        poses = self.poses(angles.flatten(0, 1), rates.flatten(0, 1), body.repeated(angles.shape[1]))
        return poses.turned(rotation.flatten(0, 1))

    def torques(
        self, angles: Tensor, rates: Tensor, rotation: Tensor, body: BodyMass, points: Tensor, loads: JointLoads
    ) -> Tensor:
        """Torque with which each joint's motor, spring or bearing balances contact and weight, ``[B, S, J]`` [N m].

        Accelerations of the joint's own mass are neglected.

        Args:
            angles, rates: ``[B, S, J]``.
            rotation: terrain ← base, ``[B, S, 3, 3]``.
            body: mass properties at the rest angles.
            points: body points at the rest angles, ``[N, 3]`` [m].
            loads: what acts on the links.
        """
        batch, steps, number = angles.shape
        poses = self.world_poses(angles, rates, rotation, body)
        forces = loads.forces.flatten(0, 1)
        turns = poses.turns[:, self.point_links]
        arms = (turns @ points[..., None])[..., 0] + poses.shifts[:, self.point_links]
        weight = loads.gravity.repeat_interleave(steps, 0)
        found = []
        for joint in range(number):
            axis, origin = poses.axes[:, joint], poses.origins[:, joint]
            carried = self.carried_by(joint)
            acting, levers = forces[:, carried], arms[:, carried] - origin[:, None]
            hanging = self.masses[joint] * weight
            if self.slides[joint]:
                total = acting.sum(1) + hanging
            else:
                total = torch.linalg.cross(levers, acting).sum(1)
                total = total + torch.linalg.cross(poses.places[:, joint] - origin, hanging)
            found.append(-(total * axis).sum(-1))
        return torch.stack(found, -1).unflatten(0, (batch, steps)) if found else angles.new_zeros(batch, steps, 0)

    def carried_by(self, joint: int) -> Tensor:
        """Which points a joint moves, itself or through a joint that it carries, ``[N]`` bool."""
        links = [joint + 1, *(other + 1 for other, parent in enumerate(self.parents) if parent == joint)]
        return torch.isin(self.point_links, torch.tensor(links, device=self.point_links.device))


@dataclass(frozen=True)
class BodyMass:
    """Mass properties of the whole robot at the rest angles of its joints."""

    mass: Tensor
    """``[B]`` [kg]."""
    centre: Tensor
    """Centre of mass in the base frame, ``[B, 3]`` [m]."""
    inertia: Tensor
    """About it in base axes, ``[B, 3, 3]`` [kg m²]."""

    def repeated(self, steps: int) -> BodyMass:
        """The same for each of ``steps`` steps of a trajectory, ``[B S]``."""
        return BodyMass(*(value.repeat_interleave(steps, 0) for value in (self.mass, self.centre, self.inertia)))


@dataclass(frozen=True)
class _Links:
    """Links and joints in the base frame, as lists of ``[B, ...]``; the body itself is the first link."""

    turns: list[Tensor]
    shifts: list[Tensor]
    spins: list[Tensor]
    drifts: list[Tensor]
    axes: list[Tensor]
    origins: list[Tensor]
    places: list[Tensor]


@dataclass(frozen=True)
class JointLoads:
    """What acts on the links of a robot."""

    forces: Tensor
    """Contact force on each point in terrain axes, ``[B, S, N, 3]`` [N]."""
    gravity: Tensor
    """Acceleration in terrain axes, ``[B, 3]`` [m/s²]."""


@dataclass(frozen=True)
class LinkPoses:
    """Links and joints at one time, in base axes; positions are relative to the centre of mass."""

    turns: Tensor
    """Rotation base ← link, ``[B, L, 3, 3]``."""
    shifts: Tensor
    """Position of the link's points: ``turns @ point + shifts``, ``[B, L, 3]`` [m]."""
    spins: Tensor
    """Angular velocity relative to the body, ``[B, L, 3]`` [rad/s]."""
    drifts: Tensor
    """Velocity of the link where the centre of mass is, relative to the body moving with it, ``[B, L, 3]`` [m/s]."""
    axes: Tensor
    """``[B, J, 3]``."""
    origins: Tensor
    """A point on each axis, ``[B, J, 3]`` [m]."""
    places: Tensor
    """Centres of the joints' masses, ``[B, J, 3]`` [m]."""
    centre: Tensor
    """Centre of mass in the base frame, ``[B, 3]`` [m]."""
    centre_rate: Tensor
    """Its velocity in the base frame, ``[B, 3]`` [m/s]."""
    inertia: Tensor
    """About the centre of mass, ``[B, 3, 3]`` [kg m²]."""

    def turned(self, rotation: Tensor) -> LinkPoses:
        """The same with all but ``centre`` and ``centre_rate`` in terrain axes; ``rotation`` ``[B, 3, 3]``."""
        across = rotation.transpose(1, 2)
        return LinkPoses(
            turns=rotation[:, None] @ self.turns,
            shifts=self.shifts @ across,
            spins=self.spins @ across,
            drifts=self.drifts @ across,
            axes=self.axes @ across,
            origins=self.origins @ across,
            places=self.places @ across,
            centre=self.centre,
            centre_rate=self.centre_rate,
            inertia=rotation @ self.inertia @ across,
        )


@dataclass(frozen=True)
class Servos:
    """Where coordinates are and are to be, each ``[B, K]`` [rad or m, per second]."""

    angle: Tensor
    rate: Tensor
    target: Tensor
    target_rate: Tensor


def coordinate_torque(
    parameters: Tensor, servos: Servos, time_step: float, limited: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Torque of springs, servos and stops, and the rate at which it decreases with the coordinate's rate.

    Linearly implicit like the contact forces: springs act at the position after the step.

    Args:
        parameters: ``[K, 11]``, see :data:`PARAMETERS`.
        servos: where the coordinates are and are to be.
        time_step: [s].
        limited: direction in which the servo gives all that it can, 1 or -1, or 0 where it can give what it is asked
            for, ``[B, K]``; None stands for zeros. See :func:`newly_limited`.

    Returns:
        torque ``[B, K]`` [N m] and gain ``[B, K]`` [N m s/rad], never negative.
    """
    _, _, _, preload, *_, low, high, stop = parameters.unbind(-1)
    torque, gain = _servo(parameters, servos, time_step)
    if limited is not None:
        limit, falls = _limit(parameters, servos.rate, limited)
        torque = torch.where(limited != 0, limited * limit, torque)
        gain = torch.where(limited != 0, falls, gain)
    angle = servos.angle
    ahead = angle + time_step * servos.rate
    beyond = torch.where(angle > high, ahead - high, torch.where(angle < low, ahead - low, 0.0))
    outside = (angle > high) | (angle < low)
    return torque - preload - stop * beyond, gain + torch.where(outside, time_step * stop, 0.0)


def newly_limited(parameters: Tensor, servos: Servos, time_step: float, change: Tensor, limited: Tensor) -> Tensor:
    """Direction in which servos would exceed their limits in a step, 1 or -1, else 0, ``[B, K]``.

    The torque counts that a servo gives in the step, not that it starts with: a stiff one asks for far more than takes
    it to its target. Given all of that at once, a strong motor would overshoot, more in each step.

    Args:
        parameters, servos, time_step: as for :func:`coordinate_torque`.
        change: change of the rates in this step, with the servos that are not ``limited`` unlimited, ``[B, K]``.
        limited: directions that are known already, ``[B, K]``.
    """
    demand, gain = _servo(parameters, servos, time_step)
    given = demand - gain * change
    side = torch.where(given >= 0, 1.0, -1.0).to(given)
    limit, falls = _limit(parameters, servos.rate, side)
    exceeds = side * given > limit - side * falls * change
    return torch.where(exceeds & (limited == 0), side, torch.zeros_like(side))


def _servo(parameters: Tensor, servos: Servos, time_step: float) -> tuple[Tensor, Tensor]:
    """Torque of springs and servos without limits, and the rate at which it decreases with the coordinate's rate."""
    _, stiffness, damping, *_ = parameters.unbind(-1)
    gain = damping + time_step * stiffness
    return stiffness * (servos.target - servos.angle) + gain * (servos.target_rate - servos.rate), gain


def _limit(parameters: Tensor, rate: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    """Largest torque in a direction (1 or -1), and the rate at which it decreases with the rate in that direction."""
    _, _, _, _, stall, no_load, strongest, power, *_ = parameters.unbind(-1)
    forward = (side * rate).clamp_min(0.0)
    curve = stall * (1.0 - forward / no_load).clamp_min(0.0)
    by_power = power / forward.clamp_min(SLOWEST)
    limit = torch.minimum(torch.minimum(curve, by_power), strongest.expand_as(curve))
    falls = torch.where((curve <= limit) & (forward > 0) & (forward < no_load), stall / no_load, 0.0)
    falls = falls + torch.where((by_power <= limit) & (forward > SLOWEST), by_power / forward.clamp_min(SLOWEST), 0.0)
    return limit, falls


def _square(arm: Tensor) -> Tensor:
    """``|r|² 1 - r rᵀ`` ``[B, 3, 3]`` (or ``[3, 3]``) of arms ``[B, 3]``: the inertia of a unit mass."""
    identity = torch.eye(3, dtype=arm.dtype, device=arm.device)
    return (arm * arm).sum(-1)[..., None, None] * identity - arm[..., :, None] * arm[..., None, :]


def _stacked(listed: list[Tensor], like: Tensor) -> Tensor:
    return torch.stack(listed, 1) if listed else like.new_zeros(like.shape[0], 0, 3)


_linkages: IdentityCache[Linkage] = IdentityCache()


def _table(like: Tensor, rows: list[tuple[float, float, float]]) -> Tensor:
    return like.new_tensor(rows).reshape(len(rows), 3)


def _parameters(like: Tensor, dynamics: list[Coordinate | None]) -> Tensor:
    rows = [[getattr(entry or Coordinate(1.0), name) for name in PARAMETERS] for entry in dynamics]
    return like.new_tensor(rows).reshape(len(rows), len(PARAMETERS)).clamp(-UNLIMITED, UNLIMITED)


def _history(
    targets: Tensor, start: Tensor, dynamic: Tensor, rates: Tensor | None = None, time_step: float = 0.0
) -> Tensor:
    """Values at all steps ``[B, T + 1, J]``: those prescribed, and the start of those with dynamics."""
    if not targets.shape[1]:
        return start[:, None]
    last = targets[:, -1:] if rates is None else targets[:, -1:] + time_step * rates[:, -1:]
    prescribed = torch.cat([targets, last], dim=1)
    first = torch.cat([start[:, None], torch.zeros_like(targets)], dim=1)
    return torch.where(dynamic, first, prescribed)
