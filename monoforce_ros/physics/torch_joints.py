"""The PyTorch backend for robots in which something moves: joints, free wheels, drives with motor limits.

Joints and drives with dynamics are solved for together with the body: with the Jacobian J of the contact directions by
all velocities, ``(M + Δt Jᵀ G J) Δu = Δt f``. The mass matrix has no terms between the body and the coordinates: the
reaction of the body to an accelerating wheel or flipper is neglected, and so is its angular momentum.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from monoforce_ros.physics.articulation import ROUNDS, Articulation, LinkPoses, Servos, coordinate_torque, newly_limited
from monoforce_ros.physics.body_contact import BodyContact
from monoforce_ros.physics.contact import Contact, contact, tread
from monoforce_ros.physics.loads import LoadModel
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.rotation import cross, exponential_map


def integrate(
    problem: Problem, moving: Articulation, options: PhysicsOptions, with_forces: bool, force_every: int
) -> Motion:
    """Integrate with autograd recording each step; see :func:`monoforce_ros.physics.rollout`."""
    step_time, size = options.time_step, moving.size
    system = _System(problem, moving, options)
    loads = LoadModel.of(problem, options.gravity)
    linear_part = moving.parameters.new_zeros(6 + size, 6 + size)
    linear_part[:3, :3] = torch.eye(3)
    centre, rotation = problem.centre, problem.rotation
    velocity, angular_velocity = problem.velocity, problem.angular_velocity
    angles, rates, belts = moving.angles[:, 0], moving.rates[:, 0], moving.belts[:, 0]
    history = [(centre, rotation, velocity, angular_velocity, angles, rates, belts)]
    listed: list[tuple[Tensor, Tensor, Tensor]] = []
    for step in range(problem.steps):
        poses = moving.poses(angles, rates, problem.body_mass).turned(rotation)
        arms, touch, belt = system.contact(poses, centre, velocity, angular_velocity, belts)
        jacobian = system.jacobian(poses, arms, touch)
        driven = system.drive_jacobian(touch, belt)
        force, gain = touch.force.flatten(1), touch.gain.flatten(1)
        grip_force, grip_gain = touch.grip_force.flatten(1), touch.grip_gain.flatten(1)
        tangential = jacobian.unflatten(2, (3, -1))[:, :, 1:].flatten(2)
        external = loads.at(rotation, velocity, angular_velocity, poses.inertia)
        weight = loads.weight / problem.mass[:, None]
        servos = system.servos(angles, rates, belts, step)
        hanging, inertia = system.hanging(poses, weight), system.parameters[:, 0]
        wrench = torch.cat([jacobian @ force[..., None], driven @ grip_force[..., None]], 1)[..., 0]
        damping = (jacobian * gain[:, None]) @ jacobian.transpose(1, 2)
        mixed = (tangential * grip_gain[:, None]) @ driven.transpose(1, 2)
        belts_part = (driven * grip_gain[:, None]) @ driven.transpose(1, 2)
        damping = torch.cat([torch.cat([damping, mixed], 2), torch.cat([mixed.transpose(1, 2), belts_part], 2)], 1)
        matrix = system.mass_matrix(poses.inertia, inertia)
        matrix = matrix + step_time * (damping + external.drag[:, None, None] * linear_part)
        acting = wrench + torch.cat([external.force, external.torque, hanging], -1)
        change = system.change(matrix, acting, servos)
        if with_forces and step % force_every == 0:
            joints = jacobian.shape[1]
            loss = touch.gain * (change[:, None, :joints] @ jacobian).unflatten(2, (3, -1))[:, 0]
            slip_loss = touch.grip_gain * (change[:, None, joints:] @ driven).unflatten(2, (2, -1))[:, 0]
            loss = loss + torch.cat([torch.zeros_like(slip_loss[:, :1]), slip_loss], 1)
            listed.append(_forces(touch, touch.force - loss))
        velocity = velocity + change[:, :3]
        angular_velocity = angular_velocity + change[:, 3:6]
        centre = centre + step_time * velocity
        rotation = exponential_map(step_time * angular_velocity) @ rotation
        angles, rates, belts = system.advanced(angles, rates, belts, change[:, 6:], step)
        history.append((centre, rotation, velocity, angular_velocity, angles, rates, belts))
    states = (torch.stack(entries, 1) for entries in zip(*history, strict=True))
    centre, rotation, velocity, angular_velocity, angles, rates, belts = states
    motion = Motion(centre, rotation, velocity, angular_velocity, angles=angles, rates=rates, belts=belts)
    if not listed:
        return motion
    normal, tangential, whole = (torch.stack(entries, 1) for entries in zip(*listed, strict=True))
    return replace(motion, normal_forces=normal, tangential_forces=tangential, forces=whole)


def _forces(touch: Contact, acting: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normal, tangential and total forces of the points from those along the directions ``[B, 3, N]``."""
    normal = acting[:, 0].clamp_min(0.0)
    tangential = (touch.directions[:, :, 1:] * acting[:, None, 1:]).sum(2)
    whole = normal[:, None] * touch.directions[:, :, 0] + tangential
    return normal, tangential.transpose(1, 2), whole.transpose(1, 2)


class _System:
    """Contact and coordinates of a problem."""

    def __init__(self, problem: Problem, moving: Articulation, options: PhysicsOptions):
        self.problem, self.moving, self.options = problem, moving, options
        self.body = BodyContact.of(problem, options)
        self.joints, self.drives = moving.dynamic_joints, moving.dynamic_drives
        self.carried = [moving.carried_by(joint).to(problem.points) for joint in self.joints]
        self.driven = [(problem.point_drives == drive).to(problem.points) for drive in self.drives]
        drives = [drive + len(moving.slides) for drive in self.drives]
        self.parameters = moving.parameters[[*self.joints, *drives]]
        self.has_limits = moving.has_limits

    def contact(
        self, poses: LinkPoses, centre: Tensor, velocity: Tensor, angular_velocity: Tensor, belts: Tensor
    ) -> tuple[Tensor, Contact, Tensor]:
        """Lever arms from the centre of mass ``[B, 3, N]`` [m], contact, and the belts' directions ``[B, 3, N]``."""
        problem, body, links = self.problem, self.body, self.moving.point_links
        turns = poses.turns[:, links]
        arms = (turns @ problem.points[..., None])[..., 0].transpose(1, 2) + poses.shifts[:, links].transpose(1, 2)
        belt = (turns @ problem.point_tangents[..., None])[..., 0].transpose(1, 2)
        spins = angular_velocity[..., None] + poses.spins[:, links].transpose(1, 2)
        drifts = velocity[..., None] + poses.drifts[:, links].transpose(1, 2)
        points = centre[..., None] + arms
        speeds = torch.cat([belts, torch.zeros_like(belts[:, :1])], -1)[:, problem.point_drives]
        touch = contact(
            body.lookup(points),
            points,
            drifts + cross(spins, arms),
            belt * speeds[:, None],
            (turns @ problem.point_outward[..., None])[..., 0].transpose(1, 2),
            turns[..., 1].transpose(1, 2),
            body.areas,
            body.masses,
            body.weights,
            body.friction_factors,
            body.drive_loads,
            body.ground_factors,
            body.rolling_resistance,
            body.yield_speed,
            self.options,
            grip=self.moving.grip,
            soil=body.soil
            and replace(body.soil, faces=(turns @ problem.point_faces[..., None])[..., 0].transpose(1, 2)),
        )
        return arms, touch, belt

    def jacobian(self, poses: LinkPoses, arms: Tensor, touch: Contact) -> Tensor:
        """Velocities of the points along the directions by those of body and joints, ``[B, 6 + K_joints, 3 N]``."""
        rows = [touch.directions, cross(arms[:, :, None], touch.directions)]
        for joint, carried in zip(self.joints, self.carried, strict=True):
            axis = poses.axes[:, joint, :, None].expand_as(arms)
            moves = axis if self.moving.slides[joint] else cross(axis, arms - poses.origins[:, joint, :, None])
            rows.append((touch.directions * (moves * carried)[:, :, None]).sum(1, keepdim=True))
        return torch.cat(rows, 1).flatten(2)

    def drive_jacobian(self, touch: Contact, belt: Tensor) -> Tensor:
        """Slip of the points along and across by the speeds of drives with dynamics, ``[B, K_drives, 2 N]``."""
        slips = torch.stack([tread(belt, touch.directions[:, :, 1]), (touch.directions[:, :, 2] * belt).sum(1)], dim=1)
        rows = [(slips * driven).flatten(1) for driven in self.driven]
        return torch.stack(rows, 1) if rows else slips.new_zeros(len(slips), 0, slips[0].numel())

    def servos(self, angles: Tensor, rates: Tensor, belts: Tensor, step: int) -> Servos:
        """The coordinates at the start of a step."""
        moving, joints, drives = self.moving, self.joints, self.drives
        commanded = self.problem.drive_speeds[:, step, drives]
        return Servos(
            torch.cat([angles[:, joints], torch.zeros_like(belts[:, drives])], -1),
            torch.cat([rates[:, joints], belts[:, drives]], -1),
            torch.cat([moving.target_angles[:, step, joints], torch.zeros_like(commanded)], -1),
            torch.cat([moving.target_rates[:, step, joints], commanded], -1),
        )

    def hanging(self, poses: LinkPoses, weight: Tensor) -> Tensor:
        """Torques of the joints' own weights on the coordinates ``[B, K]``."""
        found = weight.new_zeros(len(weight), len(self.parameters))
        if not self.joints:
            return found
        joints = self.joints
        levers = poses.places[:, joints] - poses.origins[:, joints]
        turning = torch.linalg.cross(poses.axes[:, joints], levers) * weight[:, None]
        torques = self.moving.masses[joints] * turning.sum(-1)
        return torch.cat([torques, found[:, len(joints) :]], -1)

    def change(self, matrix: Tensor, acting: Tensor, servos: Servos) -> Tensor:
        """Change of the velocities of body and coordinates in a step, ``[B, 6 + K]``.

        Args:
            matrix: of masses and contact, ``[B, 6 + K, 6 + K]``.
            acting: all forces but those of springs, servos and stops, ``[B, 6 + K]``.
            servos: of :meth:`servos`.
        """
        limited = torch.zeros_like(servos.rate)
        if self.has_limits:
            with torch.no_grad():
                for _ in range(ROUNDS):
                    change = self._solved(matrix, acting, servos, limited)[:, 6:]
                    found = newly_limited(self.parameters, servos, self.options.time_step, change, limited)
                    if not bool(found.any()):
                        break
                    limited = limited + found
        return self._solved(matrix, acting, servos, limited)

    def _solved(self, matrix: Tensor, acting: Tensor, servos: Servos, limited: Tensor) -> Tensor:
        step_time = self.options.time_step
        torque, gain = coordinate_torque(self.parameters, servos, step_time, limited if self.has_limits else None)
        body = torch.zeros_like(acting[:, :6])
        matrix = matrix + step_time * torch.diag_embed(torch.cat([body, gain], -1))
        right = step_time * (acting + torch.cat([body, torque], -1))
        # Without error checks: a trajectory that diverged is marked invalid and must not end the others.
        return torch.linalg.solve_ex(matrix, right[..., None])[0][..., 0]

    def mass_matrix(self, inertia: Tensor, coordinate_inertia: Tensor) -> Tensor:
        """Masses of body and coordinates, ``[B, 6 + K, 6 + K]``."""
        batch, size = len(inertia), 6 + len(coordinate_inertia)
        matrix = inertia.new_zeros(batch, size, size)
        matrix[:, 0:3, 0:3] = self.problem.mass[:, None, None] * torch.eye(3).to(inertia)
        matrix[:, 3:6, 3:6] = inertia
        matrix[:, 6:, 6:] = torch.diag_embed(coordinate_inertia)
        return matrix

    def advanced(
        self, angles: Tensor, rates: Tensor, belts: Tensor, change: Tensor, step: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Angles, rates and drive speeds after the step."""
        moving = self.moving
        next_angles, next_rates, next_belts = (t[:, step + 1] for t in (moving.angles, moving.rates, moving.belts))
        for column, joint in enumerate(self.joints):
            rate = rates[:, joint] + change[:, column]
            next_rates = _with_column(next_rates, joint, rate)
            next_angles = _with_column(next_angles, joint, angles[:, joint] + self.options.time_step * rate)
        for column, drive in enumerate(self.drives, start=len(self.joints)):
            next_belts = _with_column(next_belts, drive, belts[:, drive] + change[:, column])
        return next_angles, next_rates, next_belts


def _with_column(values: Tensor, column: int, entry: Tensor) -> Tensor:
    return torch.cat([values[:, :column], entry[:, None], values[:, column + 1 :]], -1)
