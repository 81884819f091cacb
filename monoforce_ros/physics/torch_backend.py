"""The PyTorch backend: the reference that every other one is checked against, in any precision, on any device."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.physics.contact import contact, cross
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.rotation import cross_matrix, exponential_map

SMALLEST_SPEED = 1e-6
"""Keeps the gradient of a speed finite at rest [m/s]."""


def tilted_gravity(tilt: Tensor, gravity: float) -> Tensor:
    """Gravity ``[B, 3]`` [m/s²] turned about the y axis, then about the x axis, by ``tilt`` ``[B, 2]`` (x, y) [rad]."""
    about_x, about_y = tilt.unbind(-1)
    level = torch.cos(about_y)
    return -gravity * torch.stack([torch.sin(about_y), -torch.sin(about_x) * level, torch.cos(about_x) * level], -1)


def features(in_body: Tensor, rotation: Tensor) -> Tensor:
    """Features ``[B, F]`` (:data:`monoforce_ros.effects.FEATURES`) of the body-frame velocities ``[B, 3, 2]``."""
    forward, left, rate = in_body[:, 0, 0], in_body[:, 1, 0], in_body[:, 2, 1]
    listed = [torch.ones_like(forward), forward, left, rate]
    listed += [forward * forward.abs(), left * left.abs(), rate * rate.abs(), forward * rate, left * rate]
    return torch.stack([*listed, rotation[:, 2, 0], rotation[:, 2, 1]], dim=-1)


def integrate(
    problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool = False, force_every: int = 1
) -> Motion:
    """Integrate with autograd recording each step; see :func:`monoforce_ros.physics.rollout`."""
    batch, dtype, device = problem.batch_size, problem.centre.dtype, problem.centre.device
    step_time = options.time_step
    lookup = TerrainLookup(problem.terrain, options.lookup, batch, problem.vegetation_drag)
    body_points = problem.points.T - problem.centre_of_mass[..., None]
    tangents = problem.point_tangents.T
    nothing = body_points.new_zeros(batch, 3, 3)
    share = problem.point_areas / problem.point_areas.sum()
    weights = problem.mass[:, None] * options.gravity * share
    # Drive -1, the hull, finds its zero at the end.
    speeds = torch.cat([problem.drive_speeds, torch.zeros_like(problem.drive_speeds[..., :1])], dim=-1)
    weight = problem.mass[:, None] * tilted_gravity(problem.gravity_tilt, options.gravity)
    rolling, linear_drag, quadratic_drag, yield_speed = problem.resistance.unbind(-1)
    translation = problem.mass[:, None, None] * torch.eye(3, dtype=dtype, device=device)
    zero = torch.zeros_like(translation)
    linear_part = torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], dtype=dtype, device=device))

    def mass_matrix(inertia: Tensor) -> Tensor:
        return torch.cat([torch.cat([translation, zero], 2), torch.cat([zero, inertia], 2)], 1)

    centre, rotation = problem.centre, problem.rotation
    velocity, angular_velocity = problem.velocity, problem.angular_velocity
    history: list[tuple[Tensor, ...]] = [(centre, rotation, velocity, angular_velocity)]
    normal_forces, tangential_forces, forces = [], [], []
    for step in range(problem.steps):
        turned = rotation.transpose(1, 2)
        # Three products in one: arms to the points, their velocities by the rotation, velocities of the belts.
        spin = cross_matrix(angular_velocity) @ rotation
        belts = tangents * speeds[:, step, problem.point_drives][:, None]
        frames = torch.cat(
            [torch.cat([rotation, nothing], 2), torch.cat([spin, nothing], 2), torch.cat([nothing, rotation], 2)], 1
        )
        arms, spun, belt = (frames @ torch.cat([body_points, belts], 1)).split(3, dim=1)
        points = centre[..., None] + arms
        touch = contact(
            lookup(points),
            points,
            velocity[..., None] + spun,
            belt,
            rotation[..., 1],
            problem.point_areas,
            weights,
            problem.friction_factors,
            rolling,
            yield_speed,
            options,
        )
        # Rows that turn the body's six velocities into the points' velocities along the contact directions, and by
        # their transpose forces along these into the body's force and torque.
        levers = cross(arms[:, :, None], touch.directions)
        jacobian = torch.cat([touch.directions, levers], 1).flatten(2)
        force, gain = touch.force.flatten(1), touch.gain.flatten(1)
        wrench = (jacobian @ force[..., None])[..., 0]
        inertia = rotation @ problem.inertia @ turned
        gyroscopic = cross(angular_velocity, (inertia @ angular_velocity[..., None])[..., 0])
        in_body = turned @ torch.stack([velocity, angular_velocity], dim=-1)
        extra = (problem.wrench @ features(in_body, rotation)[..., None])[..., 0]
        drag = linear_drag + quadratic_drag * torch.sqrt((velocity * velocity).sum(-1) + SMALLEST_SPEED**2)
        external = torch.cat(
            [
                weight - drag[:, None] * velocity + (rotation @ extra[:, :3, None])[..., 0],
                (rotation @ extra[:, 3:, None])[..., 0] - gyroscopic,
            ],
            dim=-1,
        )
        yielding = (jacobian * gain[:, None]) @ jacobian.transpose(1, 2)
        system = mass_matrix(inertia) + step_time * (yielding + drag[:, None, None] * linear_part)
        change = torch.linalg.solve(system, step_time * (wrench + external))
        velocity = velocity + change[:, :3]
        angular_velocity = angular_velocity + change[:, 3:]
        centre = centre + step_time * velocity
        rotation = exponential_map(step_time * angular_velocity) @ rotation
        history.append((centre, rotation, velocity, angular_velocity))
        if (with_forces or with_contact) and step % force_every == 0:
            acted = touch.force - touch.gain * (change[:, None] @ jacobian).unflatten(2, (3, -1))[:, 0]
            pressing = acted[:, 0].clamp_min(0.0)
            normal_forces.append(pressing)
            tangential = (touch.directions[:, :, 1:] * acted[:, None, 1:]).sum(2)
            tangential_forces.append(tangential.transpose(1, 2))
            forces.append((pressing[:, None] * touch.directions[:, :, 0] + tangential).transpose(1, 2))
    states = [torch.stack(entries, dim=1) for entries in zip(*history, strict=True)]
    if not normal_forces:
        return Motion(*states)
    return Motion(*states, *(torch.stack(f, dim=1) for f in (normal_forces, tangential_forces, forces)))
