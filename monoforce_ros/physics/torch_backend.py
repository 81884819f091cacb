"""The PyTorch backend: the reference for other backends, in any precision and on any device."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from monoforce_ros.physics import torch_joints
from monoforce_ros.physics.body_contact import NearbyContact
from monoforce_ros.physics.loads import LoadModel
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.rotation import cross, exponential_map


def integrate(
    problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool = False, force_every: int = 1
) -> Motion:
    """Integrate with autograd recording each step; see :func:`monoforce_ros.physics.rollout`."""
    if problem.articulation is not None:
        return torch_joints.integrate(problem, problem.articulation, options, with_forces or with_contact, force_every)
    dtype, device = problem.centre.dtype, problem.centre.device
    step_time = options.time_step
    contacts, loads = NearbyContact(problem, options), LoadModel.of(problem, options.gravity)
    translation = problem.mass[:, None, None] * torch.eye(3, dtype=dtype, device=device)
    zero = torch.zeros_like(translation)
    linear_part = torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], dtype=dtype, device=device))

    def mass_matrix(inertia: Tensor) -> Tensor:
        return torch.cat([torch.cat([translation, zero], 2), torch.cat([zero, inertia], 2)], 1)

    centre, rotation = problem.centre, problem.rotation
    velocity, angular_velocity = problem.velocity, problem.angular_velocity
    history: list[tuple[Tensor, ...]] = [(centre, rotation, velocity, angular_velocity)]
    normal_forces: list[Tensor] = []
    tangential_forces: list[Tensor] = []
    forces: list[Tensor] = []
    for step in range(problem.steps):
        body, chosen = contacts.near(centre, rotation)
        arms, touch = body.at(step, centre, rotation, velocity, angular_velocity)
        # Maps forces along the contact directions to the body's force and torque; its transpose maps the body's six
        # velocities to velocities of the points along these directions.
        levers = cross(arms[:, :, None], touch.directions)
        jacobian = torch.cat([touch.directions, levers], 1).flatten(2)
        force, gain = touch.force.flatten(1), touch.gain.flatten(1)
        wrench = (jacobian @ force[..., None])[..., 0]
        inertia = rotation @ problem.inertia @ rotation.transpose(1, 2)
        external = loads.at(rotation, velocity, angular_velocity, inertia)
        compliance = (jacobian * gain[:, None]) @ jacobian.transpose(1, 2)
        system = mass_matrix(inertia) + step_time * (compliance + external.drag[:, None, None] * linear_part)
        load = step_time * (wrench + torch.cat([external.force, external.torque], -1))
        # Without error checks: a trajectory that diverged is marked invalid and must not end the others.
        change = torch.linalg.solve_ex(system, load[..., None])[0][..., 0]
        velocity = velocity + change[:, :3]
        angular_velocity = angular_velocity + change[:, 3:]
        centre = centre + step_time * velocity
        rotation = exponential_map(step_time * angular_velocity) @ rotation
        history.append((centre, rotation, velocity, angular_velocity))
        if (with_forces or with_contact) and step % force_every == 0:
            step_force = touch.force - touch.gain * (change[:, None] @ jacobian).unflatten(2, (3, -1))[:, 0]
            normal_force = step_force[:, 0].clamp_min(0.0)
            tangential = (touch.directions[:, :, 1:] * step_force[:, None, 1:]).sum(2)
            whole = normal_force[:, None] * touch.directions[:, :, 0] + tangential
            listed = (normal_force, tangential.transpose(1, 2), whole.transpose(1, 2))
            if chosen is not None:
                shapes = ((problem.batch_size, contacts.count), *[(problem.batch_size, contacts.count, 3)] * 2)
                listed = tuple(t.new_zeros(s).index_copy(1, chosen, t) for t, s in zip(listed, shapes, strict=True))
            for history_of, entry in zip((normal_forces, tangential_forces, forces), listed, strict=True):
                history_of.append(entry)
    centre, rotation, velocity, angular_velocity = (torch.stack(entries, 1) for entries in zip(*history, strict=True))
    motion = Motion(centre, rotation, velocity, angular_velocity)
    if not normal_forces:
        return motion
    return replace(
        motion,
        normal_forces=torch.stack(normal_forces, 1),
        tangential_forces=torch.stack(tangential_forces, 1),
        forces=torch.stack(forces, 1),
    )
