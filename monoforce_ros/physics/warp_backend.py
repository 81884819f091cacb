"""The Warp backend: the same rollout as compiled kernels on CPU or CUDA, differentiable through torch."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import torch
import warp as wp
from torch import Tensor

from monoforce_ros.physics import warp_kernels
from monoforce_ros.physics.clusters import PointClusters, point_clusters
from monoforce_ros.physics.contact_summary import STEEP, ContactSummary
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.terrain import Grid

CPU_THREADS = 2
"""Launches at a time on the CPU: a launch runs in one core and lets other Python threads go on."""
SMALLEST_SHARE = 4
"""Trajectories below which splitting a batch over threads does not pay."""

CHUNK = 8
"""Trajectories whose per-step sums are kept at a time on the way back."""

_TANGENTIAL = {"none": warp_kernels.NO_FRICTION, "coulomb": warp_kernels.COULOMB, "sigmoid": warp_kernels.SIGMOID}
_threads: ThreadPoolExecutor | None = None

wp.init()


def integrate(
    problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool = False, force_every: int = 1
) -> Motion:
    """Integrate with Warp; see :func:`monoforce_ros.physics.rollout`."""
    terrain = problem.terrain
    height = terrain.height if terrain.height.ndim == 3 else terrain.height[None]
    listed = torch.broadcast_tensors(terrain.stiffness, terrain.damping, terrain.friction, problem.vegetation_drag)
    material = torch.stack(listed, dim=-1)
    material = material if material.ndim == 4 else material[None]
    # Both are read at one page, so a map of which only the material varies is repeated.
    pages = max(len(height), len(material))
    height, material = height.expand(pages, -1, -1), material.expand(pages, -1, -1, -1)
    share = problem.point_areas / problem.point_areas.sum()
    drives = problem.point_drives.to(torch.int32)
    sampled = (problem.points, problem.point_areas, problem.point_tangents, share)

    def common(body: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return (
            height,
            material,
            problem.drive_speeds,
            *body,
            problem.mass,
            problem.centre_of_mass,
            problem.friction_factors,
            problem.gravity_tilt,
            problem.resistance,
            problem.wrench,
        )

    start = (problem.centre, problem.rotation, problem.velocity, problem.angular_velocity)
    clusters = point_clusters(problem.points)
    fixed = _Fixed(options, terrain.grid, drives[clusters.order], clusters)
    # Points of a cluster lie side by side.
    ordered = common(tuple(t[clusters.order] for t in sampled))
    states = _Integrate.apply(fixed, *ordered, problem.inertia, *start)
    if not problem.steps or not (with_forces or with_contact):
        return Motion(*states)
    with_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in (*ordered, *states))
    if with_contact and not with_forces and not with_gradient:
        sums = _launch_summary(fixed, force_every, _contiguous(ordered), states)
        return Motion(*states, contact=ContactSummary.split(sums, problem.drive_speeds.shape[2]))
    fixed = _Fixed(options, terrain.grid, drives, clusters)
    return Motion(*states, *_Forces.apply(fixed, force_every, *common(sampled), *states))


class _Fixed:
    """What a launch needs besides tensors that carry gradients."""

    def __init__(self, options: PhysicsOptions, grid: Grid, drives: Tensor, clusters: PointClusters):
        self.options = options
        self.grid = grid
        self.drives = drives.contiguous()
        self.clusters = clusters
        self._ceiling: Tensor | None = None

    def structs(self, kernels: warp_kernels.Kernels):
        grid = kernels.integrate.grid_type()
        grid.rows, grid.columns = self.grid.rows, self.grid.columns
        grid.origin_x, grid.origin_y = (kernels.scalar(value) for value in self.grid.origin)
        grid.inverse_resolution = kernels.scalar(1.0 / self.grid.resolution)
        options = kernels.integrate.options_type()
        options.time_step = kernels.scalar(self.options.time_step)
        options.gravity = kernels.scalar(self.options.gravity)
        options.slip_square = kernels.scalar(self.options.slip_regularisation**2)
        options.lookup = int(self.options.lookup == "bilinear")
        options.normal = int(self.options.normal_force == "normal")
        options.tangential = _TANGENTIAL[self.options.tangential_force]
        return grid, options

    def broad_phase(self, kernels: warp_kernels.Kernels, height: Tensor) -> tuple[wp.array, tuple[wp.array, ...]]:
        """The highest ground near each node, and the clusters of points that it is compared with."""
        found = self.clusters
        listed = ((found.centres, kernels.vec3), (found.radii, kernels.scalar), (found.edges, wp.int32))
        if self._ceiling is None:
            self._ceiling = found.ceiling(height, self.grid.resolution).contiguous()
        return wp.from_torch(self._ceiling, dtype=kernels.scalar), tuple(wp.from_torch(t, dtype=k) for t, k in listed)


def _kernels(tensor: Tensor) -> warp_kernels.Kernels:
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"rollout precision: got {tensor.dtype}, expected float32 or float64")
    return warp_kernels.kernels(tensor.dtype == torch.float64)


def _types(kernels: warp_kernels.Kernels) -> tuple:
    """Warp element types of the tensors in ``common``, in their order."""
    s, v2, v3, v4 = kernels.scalar, kernels.vec2, kernels.vec3, kernels.vec4
    return (s, v4, s, v3, s, v3, s, s, v3, v2, v2, v4, kernels.wrench)


def _wrap(tensors, types, *, gradients: bool) -> list[wp.array]:
    """Zero-copy Warp arrays of contiguous tensors, with fresh gradient arrays where asked for."""
    return [
        wp.from_torch(t, dtype=kind, requires_grad=gradients, grad=torch.zeros_like(t) if gradients else None)
        for t, kind in zip(tensors, types, strict=True)
    ]


def _contiguous(tensors) -> list[Tensor]:
    return [t.detach().contiguous() for t in tensors]


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fixed, *tensors):
        kernels = _kernels(tensors[0])
        inputs = _contiguous(tensors)
        (*common, inertia), start = inputs[:14], inputs[14:]
        batch, steps = common[2].shape[:2]
        states = []
        for value in start:
            history = value.new_empty((batch, steps + 1, *value.shape[1:]))
            history[:, 0] = value
            states.append(history)
        needs_gradient = any(ctx.needs_input_grad)
        _launch(kernels, fixed, common, inertia, states)
        if needs_gradient:
            ctx.fixed = fixed
            ctx.save_for_backward(*common, inertia, *states)
        return tuple(states)

    @staticmethod
    def backward(ctx, *state_gradients):
        (*common, inertia), states = ctx.saved_tensors[:14], ctx.saved_tensors[14:]
        kernels = _kernels(common[0])
        # The adjoint adds to these while it walks back in time, hence copies.
        gradients = [g.clone(memory_format=torch.contiguous_format) for g in state_gradients]
        given = _launch(kernels, ctx.fixed, common, inertia, states, state_gradients=gradients)
        start = [g[:, 0] for g in gradients]
        return (None, *given, *start)


class _Forces(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fixed, every, *tensors):
        kernels = _kernels(tensors[0])
        inputs = _contiguous(tensors)
        batch, steps = inputs[2].shape[0], -(-inputs[2].shape[1] // every)
        count = inputs[3].shape[0]
        normal = inputs[0].new_zeros((batch, steps, count))
        tangential = inputs[0].new_zeros((batch, steps, count, 3))
        whole = torch.zeros_like(tangential)
        _launch_forces(kernels, fixed, every, inputs, (normal, tangential, whole))
        if any(ctx.needs_input_grad):
            ctx.fixed, ctx.every = fixed, every
            ctx.save_for_backward(*inputs, normal, tangential, whole)
        return normal, tangential, whole

    @staticmethod
    def backward(ctx, *output_gradients):
        *inputs, normal, tangential, whole = ctx.saved_tensors
        kernels = _kernels(inputs[0])
        given = _launch_forces(
            kernels,
            ctx.fixed,
            ctx.every,
            inputs,
            (normal, tangential, whole),
            output_gradients=[gradient.contiguous() for gradient in output_gradients],
        )
        return (None, None, *given)


def _launch(kernels, fixed, common, inertia, states, *, state_gradients=None):
    """Launch the integration, or its adjoint if ``state_gradients`` are given; then return the inputs' gradients."""
    batch, steps = common[2].shape[:2]
    backward = state_gradients is not None
    grid, options = fixed.structs(kernels)
    device = str(common[0].device)
    types = (*_types(kernels), kernels.mat33)
    state_types = (kernels.vec3, kernels.mat33, kernels.vec3, kernels.vec3)
    drives = wp.from_torch(fixed.drives, dtype=wp.int32)
    ceiling, clusters = fixed.broad_phase(kernels, common[0])

    def work(part: tuple[int, int]) -> list[Tensor | None]:
        first, count = part
        arrays = _wrap((*common, inertia), types, gradients=backward)
        (
            height, material, speeds, points, areas, tangents, weights, mass, centre_of_mass, factors, tilt, resistance,
            wrench, moments,
        ) = arrays  # fmt: skip
        moving = [
            wp.from_torch(t, dtype=kind, requires_grad=backward, grad=g)
            for t, kind, g in zip(states, state_types, state_gradients or [None] * 4, strict=True)
        ]
        for chunk in range(first, first + count, CHUNK if backward else count):
            width = min(CHUNK, first + count - chunk) if backward else count
            # The adjoint reads the sums of every step; keeping them for a few trajectories at a time costs one more
            # forward launch and saves most of the memory.
            slots = max(1, steps) if backward else 1
            scratch = _wrap((common[0].new_zeros((width, slots, 9, 3)),), (kernels.vec3,), gradients=backward)
            inputs = [
                chunk, steps, int(backward), height, ceiling, material, grid, options, speeds, *clusters, points, areas,
                tangents, drives, weights, mass, centre_of_mass, moments, factors, tilt, resistance, wrench,
            ]  # fmt: skip
            launch = {"dim": width, "inputs": inputs, "outputs": [*moving, *scratch], "device": device}
            wp.launch(kernels.integrate, record_tape=False, **launch)
            if backward:
                wp.launch(kernels.integrate, record_tape=False, **launch, **_adjoint(inputs, outputs=5))
        return [wp.to_torch(array.grad) if backward else None for array in arrays]

    # Compiled here: two threads must not do so at once.
    kernels.integrate.module.load(wp.get_device(device))
    parts = list(_in_parallel(work, _shares(batch, common[0].device)))
    if not backward:
        return []
    return [torch.stack(entries).sum(0) if len(entries) > 1 else entries[0] for entries in zip(*parts, strict=True)]


def _launch_forces(kernels, fixed, every, inputs, outputs, *, output_gradients=None):
    """Launch the forces of every so many steps, or their adjoint; then return the inputs' gradients."""
    backward = output_gradients is not None
    grid, options = fixed.structs(kernels)
    state_types = (kernels.vec3, kernels.mat33, kernels.vec3, kernels.vec3)
    device = str(inputs[0].device)
    drives = wp.from_torch(fixed.drives, dtype=wp.int32)

    def work(part: tuple[int, int]) -> list[Tensor]:
        first, count = part
        arrays = _wrap(inputs, (*_types(kernels), *state_types), gradients=backward)
        (
            height, material, speeds, points, areas, tangents, weights, mass, centre_of_mass, factors, tilt, resistance,
            wrench, *moving,
        ) = arrays  # fmt: skip
        gradients = output_gradients or (None, None, None)
        results = [
            wp.from_torch(t, dtype=kind, requires_grad=backward, grad=g)
            for t, kind, g in zip(outputs, (kernels.scalar, kernels.vec3, kernels.vec3), gradients, strict=True)
        ]
        before = [
            first, every, height, material, grid, options, speeds, points, areas, tangents, drives, weights, mass,
            centre_of_mass, factors, tilt, resistance, wrench, *moving,
        ]  # fmt: skip
        extra = _adjoint(before, outputs=3) if backward else {}
        wp.launch(
            kernels.forces,
            dim=(count, *outputs[0].shape[1:]),
            inputs=before,
            outputs=results,
            device=device,
            record_tape=False,
            **extra,
        )
        return [wp.to_torch(array.grad) for array in arrays] if backward else []

    parts = list(_in_parallel(work, _shares(outputs[0].shape[0], inputs[0].device)))
    if not backward:
        return []
    return [torch.stack(entries).sum(0) if len(entries) > 1 else entries[0] for entries in zip(*parts, strict=True)]


def _launch_summary(fixed, every, common, states) -> Tensor:
    """Launch the sums of the forces of every so many steps, ``[B, S, 2 D + 8]``."""
    kernels = _kernels(common[0])
    grid, options = fixed.structs(kernels)
    batch, steps, drives = common[2].shape
    state_types = (kernels.vec3, kernels.mat33, kernels.vec3, kernels.vec3)
    sums = common[0].new_zeros((batch, -(-steps // every), 2 * drives + 8))
    ceiling, clusters = fixed.broad_phase(kernels, common[0])
    (
        height, material, speeds, points, areas, tangents, weights, mass, centre_of_mass, factors, tilt, resistance,
        wrench, *moving,
    ) = _wrap((*common, *_contiguous(states)), (*_types(kernels), *state_types), gradients=False)  # fmt: skip
    result, moved = wp.from_torch(sums, dtype=kernels.scalar), wp.from_torch(fixed.drives, dtype=wp.int32)

    def work(part: tuple[int, int]) -> None:
        first, count = part
        inputs = [
            first, every, kernels.scalar(STEEP), height, ceiling, material, grid, options, speeds, *clusters, points,
            areas, tangents, moved, weights, mass, centre_of_mass, factors, tilt, resistance, wrench, *moving,
        ]  # fmt: skip
        device = str(common[0].device)
        wp.launch(
            kernels.summarise, dim=(count, sums.shape[1]), inputs=inputs, outputs=[result], device=device,
            record_tape=False,
        )  # fmt: skip

    kernels.summarise.module.load(wp.get_device(str(common[0].device)))
    list(_in_parallel(work, _shares(batch, common[0].device)))
    return sums


def _adjoint(inputs: list, outputs: int) -> dict:
    """Arguments that make a launch run a kernel's adjoint: arrays bring their gradients, the rest has none."""
    adjoints = [None if isinstance(value, wp.array) else type(value)() for value in inputs]
    return {"adjoint": True, "adj_inputs": adjoints, "adj_outputs": [None] * outputs}


def _shares(batch: int, device: torch.device) -> list[tuple[int, int]]:
    """First trajectory and number of trajectories of each launch."""
    workers = 1 if device.type == "cuda" else max(1, min(CPU_THREADS, batch // SMALLEST_SHARE))
    edges = [round(batch * k / workers) for k in range(workers + 1)]
    return [(low, high - low) for low, high in itertools.pairwise(edges)]


def _in_parallel(work, shares):
    global _threads
    if len(shares) == 1:
        return [work(shares[0])]
    if _threads is None:
        _threads = ThreadPoolExecutor(CPU_THREADS, thread_name_prefix="rollout")
    return list(_threads.map(work, shares))
