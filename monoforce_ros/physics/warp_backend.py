"""The Warp backend: the rollout as compiled kernels on CPU or CUDA, differentiable with torch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from monoforce_ros.physics.clusters import PointClusters, point_clusters
from monoforce_ros.physics.contact_summary import STEEP, ContactSummary
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.warp_kernels import (
    COULOMB,
    NO_FRICTION,
    SIGMOID,
    Types,
    forces_kernel,
    integrate_kernel,
    summarise_kernel,
    types,
)
from monoforce_ros.physics.warp_start import start_warp
from monoforce_ros.terrain import Grid

CPU_THREADS = 2
"""Simultaneous launches on the CPU; a launch uses one core and releases the GIL."""
SMALLEST_SHARE = 4
"""Smallest number of trajectories per thread; splitting smaller batches takes longer."""

CHUNK = 8
"""Number of trajectories whose per-step sums are in memory at once in the backward pass."""

_TANGENTIAL = {"none": NO_FRICTION, "coulomb": COULOMB, "sigmoid": SIGMOID}
_threads: ThreadPoolExecutor | None = None

start_warp()


def integrate(
    problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool = False, force_every: int = 1
) -> Motion:
    """Integrate with Warp; see :func:`monoforce_ros.physics.rollout`."""
    terrain = problem.terrain
    height = terrain.height if terrain.height.ndim == 3 else terrain.height[None]
    listed = torch.broadcast_tensors(terrain.stiffness, terrain.damping, terrain.friction, problem.vegetation)
    material = torch.stack(listed, dim=-1)
    material = material if material.ndim == 4 else material[None]
    # The kernel reads both at the same page, so maps with equal heights but different materials are repeated.
    pages = max(len(height), len(material))
    height, material = height.expand(pages, -1, -1), material.expand(pages, -1, -1, -1)
    share = problem.point_areas / problem.point_areas.sum()
    drives = problem.point_drives.to(torch.int32)
    sampled = (problem.points, problem.point_areas, problem.point_tangents, share)

    def inputs(body: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Kernel inputs in the order of :data:`_INPUTS`."""
        return (
            height,
            material,
            *body,
            problem.drive_speeds,
            problem.mass,
            problem.centre_of_mass,
            problem.inertia,
            problem.friction_factors,
            problem.ground_factors,
            problem.gravity_tilt,
            problem.resistance,
            problem.wrench,
        )

    start = (problem.centre, problem.rotation, problem.velocity, problem.angular_velocity)
    clusters = point_clusters(problem.points)
    fixed = _Fixed(options, terrain.grid, drives[clusters.order], problem.point_outward[clusters.order], clusters)
    # Points of a cluster are contiguous.
    ordered = inputs(tuple(t[clusters.order] for t in sampled))
    states: tuple[Tensor, ...] = _Integrate.apply(fixed, *ordered, *start)
    centre, rotation, velocity, angular_velocity = states
    motion = Motion(centre, rotation, velocity, angular_velocity)
    if not problem.steps or not (with_forces or with_contact):
        return motion
    with_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in (*ordered, *states))
    if with_contact and not with_forces and not with_gradient:
        sums = _launch_summary(fixed, force_every, _contiguous(ordered), _contiguous(states))
        return replace(motion, contact=ContactSummary.split(sums, problem.drive_speeds.shape[2]))
    fixed = _Fixed(options, terrain.grid, drives, problem.point_outward, clusters)
    normal, tangential, forces = _Forces.apply(fixed, force_every, *inputs(sampled), *states)
    return replace(motion, normal_forces=normal, tangential_forces=tangential, forces=forces)


_INPUTS = (
    "height", "material", "points", "areas", "tangents", "share", "speeds", "mass", "centre_of_mass", "inertia",
    "friction", "ground_factors", "tilt", "resistance", "wrench",
)  # fmt: skip
"""Kernel inputs with gradients, other than the states."""
_STATES = ("centre", "rotation", "velocity", "angular_velocity")


class _Fixed:
    """Inputs of a launch without gradients."""

    def __init__(self, options: PhysicsOptions, grid: Grid, drives: Tensor, outward: Tensor, clusters: PointClusters):
        self.options = options
        self.grid = grid
        self.drives = drives.contiguous()
        self.outward = outward.detach().contiguous()
        self.clusters = clusters
        self._ceilings: tuple[Tensor, Tensor] | None = None

    def ceilings(self, height: Tensor) -> tuple[Tensor, Tensor]:
        """The highest ground near each node, against which clusters and groups are tested."""
        if self._ceilings is None:
            boxes, resolution = (self.clusters.clusters, self.clusters.groups), self.grid.resolution
            fine, coarse = (box.ceiling(height, resolution).contiguous() for box in boxes)
            self._ceilings = fine, coarse
        return self._ceilings


class _Arguments:
    """Kernel structs for tensors, and the arrays that may have gradients.

    Args:
        fixed: inputs without gradients.
        inputs: tensors in the order of :data:`_INPUTS`.
        states: tensors in the order of :data:`_STATES`.
        gradients: whether to collect gradients of the inputs.
        state_gradients: tensors to which gradients of the states are added; allocated if None and ``gradients`` is set.
    """

    def __init__(
        self,
        fixed: _Fixed,
        inputs: Sequence[Tensor],
        states: Sequence[Tensor],
        *,
        gradients: bool = False,
        state_gradients: Sequence[Tensor] | None = None,
    ):
        self.double, kinds = _precision(inputs[0])
        element = _elements(kinds)
        named = dict(zip(_INPUTS, inputs, strict=True))
        self.inputs = {
            name: wp.from_torch(
                value, dtype=element[name], requires_grad=gradients, grad=torch.zeros_like(value) if gradients else None
            )
            for name, value in named.items()
        }
        if state_gradients is None and gradients:
            state_gradients = [torch.zeros_like(value) for value in states]
        self.states = {
            name: wp.from_torch(value, dtype=element[name], requires_grad=gradients, grad=gradient)
            for name, value, gradient in zip(_STATES, states, state_gradients or (None,) * 4, strict=True)
        }
        clusters = fixed.clusters
        ground, body, robots, options = kinds.Ground(), kinds.Body(), kinds.Robots(), kinds.Options()
        ground.height, ground.material = self.inputs["height"], self.inputs["material"]
        ground.ceiling, ground.group_ceiling = (
            wp.from_torch(ceiling, dtype=kinds.scalar) for ceiling in fixed.ceilings(inputs[0])
        )
        ground.rows, ground.columns = fixed.grid.rows, fixed.grid.columns
        ground.origin_x, ground.origin_y = (kinds.scalar(value) for value in fixed.grid.origin)
        ground.inverse_resolution = kinds.scalar(1.0 / fixed.grid.resolution)
        body.points, body.areas = self.inputs["points"], self.inputs["areas"]
        body.tangents, body.share = self.inputs["tangents"], self.inputs["share"]
        body.drives = wp.from_torch(fixed.drives, dtype=wp.int32)
        body.outward = wp.from_torch(fixed.outward, dtype=kinds.vec3)
        for name, boxes in (("cluster", clusters.clusters), ("group", clusters.groups)):
            setattr(body, f"{name}_centres", wp.from_torch(boxes.centres, dtype=kinds.vec3))
            setattr(body, f"{name}_halves", wp.from_torch(boxes.halves, dtype=kinds.vec3))
            setattr(body, f"{name}_edges", wp.from_torch(boxes.edges, dtype=wp.int32))
        for name in _INPUTS[6:]:
            setattr(robots, name, self.inputs[name])
        options.time_step = kinds.scalar(fixed.options.time_step)
        options.gravity = kinds.scalar(fixed.options.gravity)
        options.slip_square = kinds.scalar(fixed.options.slip_regularisation**2)
        options.lookup = int(fixed.options.lookup == "bilinear")
        options.normal = int(fixed.options.normal_force == "normal")
        options.tangential = _TANGENTIAL[fixed.options.tangential_force]
        moving = kinds.States()
        for name, array in self.states.items():
            setattr(moving, name, array)
        self.structs: list[Any] = [ground, body, robots, options, moving]

    def gradients(self) -> list[Tensor]:
        """Gradients of the inputs, then of the states."""
        return [wp.to_torch(array.grad) for array in (*self.inputs.values(), *self.states.values())]


def _precision(tensor: Tensor) -> tuple[bool, Types]:
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"rollout precision: got {tensor.dtype}, expected float32 or float64")
    double = tensor.dtype == torch.float64
    return double, types(double)


def _elements(kinds: Types) -> dict[str, Any]:
    """Warp element types of inputs and states."""
    s, v2, v3, v4, m = kinds.scalar, kinds.vec2, kinds.vec3, kinds.vec4, kinds.mat33
    inputs = (s, v4, v3, s, v3, s, s, s, v3, m, v2, v2, v2, v4, kinds.wrench)
    return dict(zip((*_INPUTS, *_STATES), (*inputs, v3, m, v3, v3), strict=True))


def _contiguous(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [t.detach().contiguous() for t in tensors]


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: _Fixed, *tensors: Tensor) -> tuple[Tensor, ...]:
        contiguous = _contiguous(tensors)
        inputs, start = contiguous[: len(_INPUTS)], contiguous[len(_INPUTS) :]
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
        input_gradients = _launch(ctx.fixed, saved[: len(_INPUTS)], saved[len(_INPUTS) :], state_gradients=gradients)
        return (None, *input_gradients, *(g[:, 0] for g in gradients))


class _Forces(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: _Fixed, every: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        contiguous = _contiguous(tensors)
        speeds, points = contiguous[6], contiguous[2]
        batch, steps, count = speeds.shape[0], -(-speeds.shape[1] // every), points.shape[0]
        normal = speeds.new_zeros((batch, steps, count))
        tangential = speeds.new_zeros((batch, steps, count, 3))
        outputs = (normal, tangential, torch.zeros_like(tangential))
        _launch_forces(fixed, every, contiguous, outputs)
        if any(ctx.needs_input_grad):
            ctx.fixed, ctx.every = fixed, every
            ctx.save_for_backward(*contiguous, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:
        tensors, outputs = ctx.saved_tensors[:-3], ctx.saved_tensors[-3:]
        gradients = [gradient.contiguous() for gradient in output_gradients]
        return (None, None, *_launch_forces(ctx.fixed, ctx.every, tensors, outputs, output_gradients=gradients))


def _launch(
    fixed: _Fixed,
    inputs: Sequence[Tensor],
    states: Sequence[Tensor],
    *,
    state_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the integration, or with ``state_gradients`` its adjoint, which returns the inputs' gradients."""
    batch, steps = inputs[6].shape[:2]
    backward = state_gradients is not None
    device = str(inputs[0].device)
    double, kinds = _precision(inputs[0])
    kernel = integrate_kernel(double)
    # Computed before the threads start; otherwise each would compute it.
    fixed.ceilings(inputs[0])

    def work(part: tuple[int, int]) -> list[Tensor]:
        first, count = part
        arguments = _Arguments(fixed, inputs, states, gradients=backward, state_gradients=state_gradients)
        for chunk in range(first, first + count, CHUNK if backward else count):
            width = min(CHUNK, first + count - chunk) if backward else count
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
                    **_adjoint(values),
                )
        return arguments.gradients()[: len(_INPUTS)] if backward else []

    # Compile here, because two threads must not compile at the same time.
    kernel.module.load(wp.get_device(device))
    return _summed(list(_in_parallel(work, _shares(batch, inputs[0].device))))


def _launch_forces(
    fixed: _Fixed,
    every: int,
    tensors: Sequence[Tensor],
    outputs: Sequence[Tensor],
    *,
    output_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the forces of every n-th step, or with ``output_gradients`` their adjoint, which returns the gradients."""
    backward = output_gradients is not None
    device = str(tensors[0].device)
    inputs, states = tensors[: len(_INPUTS)], tensors[len(_INPUTS) :]
    double, kinds = _precision(tensors[0])
    kernel = forces_kernel(double)
    fixed.ceilings(inputs[0])

    def work(part: tuple[int, int]) -> list[Tensor]:
        first, count = part
        arguments = _Arguments(fixed, inputs, states, gradients=backward)
        results = [
            wp.from_torch(t, dtype=kind, requires_grad=backward, grad=g)
            for t, kind, g in zip(
                outputs, (kinds.scalar, kinds.vec3, kinds.vec3), output_gradients or (None,) * 3, strict=True
            )
        ]
        listed = [first, every, *arguments.structs, *results]
        extra = _adjoint(listed) if backward else {}
        dim = (count, *outputs[0].shape[1:])
        wp.launch(kernel, dim=dim, inputs=listed, device=device, record_tape=False, **extra)
        return arguments.gradients() if backward else []

    kernel.module.load(wp.get_device(device))
    return _summed(list(_in_parallel(work, _shares(outputs[0].shape[0], tensors[0].device))))


def _launch_summary(fixed: _Fixed, every: int, inputs: Sequence[Tensor], states: Sequence[Tensor]) -> Tensor:
    """Launch the sums of the forces of every n-th step; returns ``[B, S, 2 D + 8]``."""
    batch, steps, drives = inputs[6].shape
    device = str(inputs[0].device)
    double, kinds = _precision(inputs[0])
    kernel = summarise_kernel(double)
    sums = inputs[0].new_zeros((batch, -(-steps // every), 2 * drives + 8))
    arguments = _Arguments(fixed, inputs, states)
    result = wp.from_torch(sums, dtype=kinds.scalar)

    def work(part: tuple[int, int]) -> None:
        first, count = part
        values = [first, every, kinds.scalar(STEEP), *arguments.structs, result]
        wp.launch(kernel, dim=(count, sums.shape[1]), inputs=values, device=device, record_tape=False)

    kernel.module.load(wp.get_device(device))
    _in_parallel(work, _shares(batch, inputs[0].device))
    return sums


def _adjoint(inputs: Sequence[Any]) -> dict[str, Any]:
    """Launch arguments that run a kernel's adjoint: arrays have their own gradients, other arguments none."""
    adjoints = [None if isinstance(value, wp.array) else type(value)() for value in inputs]
    return {"adjoint": True, "adj_inputs": adjoints, "adj_outputs": []}


def _summed(parts: list[list[Tensor]]) -> list[Tensor]:
    """Sum the gradients of several launches."""
    return [torch.stack(entries).sum(0) if len(entries) > 1 else entries[0] for entries in zip(*parts, strict=True)]


def _shares(batch: int, device: torch.device) -> list[tuple[int, int]]:
    """Index of the first trajectory and number of trajectories of each launch."""
    workers = 1 if device.type == "cuda" else max(1, min(CPU_THREADS, batch // SMALLEST_SHARE))
    edges = [round(batch * k / workers) for k in range(workers + 1)]
    return [(low, high - low) for low, high in itertools.pairwise(edges)]


def _in_parallel[Result](work: Callable[[tuple[int, int]], Result], shares: list[tuple[int, int]]) -> list[Result]:
    global _threads
    if len(shares) == 1:
        return [work(shares[0])]
    if _threads is None:
        _threads = ThreadPoolExecutor(CPU_THREADS, thread_name_prefix="rollout")
    return list(_threads.map(work, shares))
