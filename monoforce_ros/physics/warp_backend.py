"""The Warp backend: the rollout as compiled kernels on CPU or CUDA, differentiable with torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import pad

from monoforce_ros.core import start_warp
from monoforce_ros.physics import warp_joints
from monoforce_ros.physics.clusters import point_clusters
from monoforce_ros.physics.contact_summary import STEEP, ContactSummary
from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.soil import SOIL_PARAMETERS
from monoforce_ros.physics.warp_kernels import forces_kernel, integrate_kernel, summarise_kernel
from monoforce_ros.physics.warp_launch import (
    INPUTS,
    Arguments,
    Fixed,
    SampledBody,
    adjoint,
    chunks,
    contiguous,
    in_parallel,
    precision,
    shares,
    summed,
)

start_warp()


def integrate(
    problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool = False, force_every: int = 1
) -> Motion:
    """Integrate with Warp; see :func:`monoforce_ros.physics.rollout`."""
    terrain = problem.terrain
    height = terrain.height if terrain.height.ndim == 3 else terrain.height[None]
    channels = (terrain.stiffness, terrain.damping, terrain.friction)
    # Candidates, ensembles and fits roll out again and again on one map.
    material = _materials.get(
        (*channels, terrain.geometric_height, terrain.height), lambda: _interleaved(*channels, problem.vegetation)
    )
    # The kernel reads both at the same page, so maps with equal heights but different materials are repeated.
    pages = max(len(height), len(material))
    height, material = height.expand(pages, -1, -1), material.expand(pages, -1, -1, -1)
    moving = problem.articulation
    given = problem.friction_factors.shape[1]
    compliant, friction = given >= 3, pad(problem.friction_factors, (0, 4 - given))
    plain, ordered = _sampled_bodies(problem)

    def inputs(body: SampledBody) -> tuple[Tensor, ...]:
        """Kernel inputs in the order of :data:`INPUTS`."""
        return (
            height,
            material,
            *body.sampled,
            problem.drive_speeds,
            problem.mass,
            problem.centre_of_mass,
            problem.inertia,
            friction,
            problem.ground_factors,
            problem.gravity_tilt,
            problem.resistance,
            problem.wrench,
            problem.mass.new_zeros(1, SOIL_PARAMETERS) if problem.soil is None else problem.soil,
            problem.drive_loads,
        )

    start = (problem.centre, problem.rotation, problem.velocity, problem.angular_velocity)
    fixed, listed = Fixed(options, terrain, ordered, compliant), inputs(ordered)
    if moving is not None:
        motion = warp_joints.integrate(problem, moving, fixed, listed, start)
        if not problem.steps or not (with_forces or with_contact):
            return motion
        fixed = Fixed(options, terrain, plain, compliant)
        return warp_joints.with_forces(motion, problem, moving, fixed, inputs(plain), force_every)
    states: tuple[Tensor, ...] = _Integrate.apply(fixed, *listed, *start)
    centre, rotation, velocity, angular_velocity = states
    motion = Motion(centre, rotation, velocity, angular_velocity)
    if not problem.steps or not (with_forces or with_contact):
        return motion
    with_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in (*listed, *states))
    if with_contact and not with_forces and not with_gradient:
        sums = _launch_summary(fixed, force_every, contiguous(listed), contiguous(states))
        return replace(motion, contact=ContactSummary.split(sums, problem.drive_speeds.shape[2]))
    fixed = Fixed(options, terrain, plain, compliant)
    normal, tangential, forces = _Forces.apply(fixed, force_every, *inputs(plain), *states)
    return replace(motion, normal_forces=normal, tangential_forces=tangential, forces=forces)


def _interleaved(*channels: Tensor) -> Tensor:
    """Stiffness, damping, friction and vegetation of each cell beside each other, ``[1 or B, rows, columns, 4]``."""
    material = torch.stack(torch.broadcast_tensors(*channels), dim=-1)
    return material if material.ndim == 4 else material[None]


_materials: IdentityCache[Tensor] = IdentityCache(8)


def _sampled_bodies(problem: Problem) -> tuple[SampledBody, SampledBody]:
    """The body with its points in their own order, and with the points of each cluster beside each other."""
    links = None if problem.articulation is None else problem.articulation.point_links
    sampled = (problem.points, problem.point_areas, problem.point_tangents)
    surface = (problem.point_drives, problem.point_outward, problem.point_strips)

    def made() -> tuple[SampledBody, SampledBody]:
        clusters = point_clusters(sampled[0]) if links is None else warp_joints.clusters_by_link(sampled[0], links)
        plain = SampledBody((*sampled, sampled[1] / sampled[1].sum()), *surface, clusters)
        return plain, plain.ordered()

    return _bodies.get((*sampled, *surface, links), made)


_bodies: IdentityCache[tuple[SampledBody, SampledBody]] = IdentityCache()


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: Fixed, *tensors: Tensor) -> tuple[Tensor, ...]:
        listed = contiguous(tensors)
        inputs, start = listed[: len(INPUTS)], listed[len(INPUTS) :]
        batch, steps = inputs[6].shape[:2]
        states = []
        for value in start:
            history = value.new_empty((batch, steps + 1, *value.shape[1:]))
            history[:, 0] = value
            states.append(history)
        _launch(fixed, inputs, states)
        if any(ctx.needs_input_grad):
            ctx.fixed = fixed
            ctx.save_for_backward(*inputs, *states)
        return tuple(states)

    @staticmethod
    def backward(ctx: Any, *state_gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        # The adjoint accumulates into these backwards in time, hence the copies.
        gradients = [g.clone(memory_format=torch.contiguous_format) for g in state_gradients]
        input_gradients = _launch(ctx.fixed, saved[: len(INPUTS)], saved[len(INPUTS) :], state_gradients=gradients)
        return (None, *input_gradients, *(g[:, 0] for g in gradients))


class _Forces(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: Fixed, every: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        listed = contiguous(tensors)
        speeds, points = listed[6], listed[2]
        batch, steps, count = speeds.shape[0], -(-speeds.shape[1] // every), points.shape[0]
        normal = speeds.new_zeros((batch, steps, count))
        tangential = speeds.new_zeros((batch, steps, count, 3))
        outputs = (normal, tangential, torch.zeros_like(tangential))
        _launch_forces(fixed, every, listed, outputs)
        if any(ctx.needs_input_grad):
            ctx.fixed, ctx.every = fixed, every
            ctx.save_for_backward(*listed, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:
        tensors, outputs = ctx.saved_tensors[:-3], ctx.saved_tensors[-3:]
        gradients = [gradient.contiguous() for gradient in output_gradients]
        return (None, None, *_launch_forces(ctx.fixed, ctx.every, tensors, outputs, output_gradients=gradients))


def _launch(
    fixed: Fixed,
    inputs: Sequence[Tensor],
    states: Sequence[Tensor],
    *,
    state_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the integration, or with ``state_gradients`` its adjoint, which returns the inputs' gradients."""
    batch, steps = inputs[6].shape[:2]
    backward = state_gradients is not None
    device = str(inputs[0].device)
    double, kinds = precision(inputs[0])
    kernel = integrate_kernel(double, fixed.soft)
    # Computed before the threads start; otherwise each would compute it. Gradients are each thread's own.
    fixed.ceilings(inputs[0])
    forward = None if backward else Arguments(fixed, inputs, states)

    def work(part: tuple[int, int]) -> list[Tensor]:
        arguments = forward or Arguments(fixed, inputs, states, gradients=True, state_gradients=state_gradients)
        for chunk, width in chunks(part, steps, inputs[0].device, backward=backward):
            # The adjoint reads the sums of every step. Storing them for a few trajectories at a time requires a second
            # forward launch, but saves most of the memory.
            slots = max(1, steps) if backward else 1
            sums = inputs[0].new_zeros((width, slots, 9, 3))
            scratch = wp.from_torch(
                sums, dtype=kinds.vec3, requires_grad=backward, grad=torch.zeros_like(sums) if backward else None
            )
            values = [chunk, steps, int(backward), *arguments.structs, scratch]
            wp.launch(kernel, dim=width, inputs=values, device=device, record_tape=False)
            if backward:
                wp.launch(
                    kernel,
                    dim=width,
                    inputs=values,
                    device=device,
                    record_tape=False,
                    **adjoint(values),
                )
        return arguments.gradients()[: len(INPUTS)] if backward else []

    # Compile here, because two threads must not compile at the same time.
    kernel.module.load(wp.get_device(device))
    return summed(list(in_parallel(work, shares(batch, inputs[0].device))))


def _launch_forces(
    fixed: Fixed,
    every: int,
    tensors: Sequence[Tensor],
    outputs: Sequence[Tensor],
    *,
    output_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the forces of every n-th step, or with ``output_gradients`` their adjoint, which returns the gradients."""
    backward = output_gradients is not None
    device = str(tensors[0].device)
    inputs, states = tensors[: len(INPUTS)], tensors[len(INPUTS) :]
    double, kinds = precision(tensors[0])
    kernel = forces_kernel(double, fixed.soft)
    fixed.ceilings(inputs[0])

    def work(part: tuple[int, int]) -> list[Tensor]:
        first, count = part
        arguments = Arguments(fixed, inputs, states, gradients=backward)
        results = [
            wp.from_torch(t, dtype=kind, requires_grad=backward, grad=g)
            for t, kind, g in zip(
                outputs, (kinds.scalar, kinds.vec3, kinds.vec3), output_gradients or (None,) * 3, strict=True
            )
        ]
        listed = [first, every, *arguments.structs, *results]
        extra = adjoint(listed) if backward else {}
        dim = (count, *outputs[0].shape[1:])
        wp.launch(kernel, dim=dim, inputs=listed, device=device, record_tape=False, **extra)
        return arguments.gradients() if backward else []

    kernel.module.load(wp.get_device(device))
    return summed(list(in_parallel(work, shares(outputs[0].shape[0], tensors[0].device))))


def _launch_summary(fixed: Fixed, every: int, inputs: Sequence[Tensor], states: Sequence[Tensor]) -> Tensor:
    """Launch the sums of the forces of every n-th step; returns ``[B, S, 2 D + 8]``."""
    batch, steps, drives = inputs[6].shape
    device = str(inputs[0].device)
    double, kinds = precision(inputs[0])
    kernel = summarise_kernel(double, fixed.soft)
    sums = inputs[0].new_zeros((batch, -(-steps // every), 2 * drives + 8))
    arguments = Arguments(fixed, inputs, states)
    result = wp.from_torch(sums, dtype=kinds.scalar)

    def work(part: tuple[int, int]) -> None:
        first, count = part
        values = [first, every, kinds.scalar(STEEP), *arguments.structs, result]
        wp.launch(kernel, dim=(count, sums.shape[1]), inputs=values, device=device, record_tape=False)

    kernel.module.load(wp.get_device(device))
    in_parallel(work, shares(batch, inputs[0].device))
    return sums
