"""The Warp backend for robots in which something moves: joints, free wheels, drives with motor limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from monoforce_ros.physics.articulation import Articulation
from monoforce_ros.physics.clusters import PointClusters, joined, point_clusters
from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.warp_kernels import (
    Types,
    forces_joints_kernel,
    integrate_joints_kernel,
    joint_functions,
)
from monoforce_ros.physics.warp_launch import (
    CPU_THREADS,
    INPUTS,
    Arguments,
    Fixed,
    adjoint,
    chunks,
    contiguous,
    in_parallel,
    precision,
    shares,
    summed,
)

_BODY_STATES = 4


def integrate(
    problem: Problem, moving: Articulation, fixed: Fixed, inputs: Sequence[Tensor], body: Sequence[Tensor]
) -> Motion:
    """The motion; ``inputs`` in the order of :data:`INPUTS` with points ordered by cluster, ``body`` its start."""
    joints = _Joints.of(moving, fixed.clusters.order)
    extra = (_padded(moving.target_angles), _padded(moving.target_rates))
    histories = (_padded(moving.angles), _padded(moving.rates), moving.belts)
    states: tuple[Tensor, ...] = _Integrate.apply(fixed, joints, *inputs, *extra, *body, *histories)
    centre, rotation, velocity, angular_velocity, angles, rates, belts = states
    number = len(moving.slides)
    return Motion(
        centre,
        rotation,
        velocity,
        angular_velocity,
        angles=angles[..., :number],
        rates=rates[..., :number],
        belts=belts,
    )


def with_forces(
    motion: Motion, problem: Problem, moving: Articulation, fixed: Fixed, inputs: Sequence[Tensor], every: int
) -> Motion:
    """The motion with the forces of every n-th step; ``inputs`` with points in their own order."""
    if motion.angles is None or motion.rates is None or motion.belts is None:
        raise ValueError("forces of joints: got a motion without joints")
    batch, steps = problem.batch_size, -(-problem.steps // every)
    listed = (motion.angles[:, :-1:every], motion.rates[:, :-1:every], motion.rotation[:, :-1:every])
    poses = moving.world_poses(*listed, problem.body_mass)
    zero = torch.zeros_like(poses.shifts[:, :1])
    axes, origins, places = (torch.cat([zero, value], 1) for value in (poses.axes, poses.origins, poses.places))
    frames = torch.stack([poses.shifts, poses.spins, poses.drifts, axes, origins, places], dim=2)
    links = (poses.turns.unflatten(0, (batch, steps)), frames.unflatten(0, (batch, steps)))
    joints = _Joints.of(moving, None)
    extra = (_padded(moving.target_angles), _padded(moving.target_rates))
    states = (motion.centre, motion.rotation, motion.velocity, motion.angular_velocity)
    histories = (_padded(motion.angles), _padded(motion.rates), motion.belts)
    normal, tangential, forces = _Forces.apply(fixed, joints, every, *inputs, *extra, *states, *histories, *links)
    return replace(motion, normal_forces=normal, tangential_forces=tangential, forces=forces)


def clusters_by_link(points: Tensor, links: Tensor) -> PointClusters:
    """Clusters of points ``[N, 3]``; each cluster and each group belongs to one link."""
    data = (points.detach().cpu().double().numpy().tobytes(), links.cpu().numpy().astype(np.int64).tobytes())
    return _clusters_by_link(*data, points.dtype, points.device)


@lru_cache(maxsize=32)
def _clusters_by_link(places: bytes, carriers: bytes, dtype: torch.dtype, device: torch.device) -> PointClusters:
    points = torch.from_numpy(np.frombuffer(places).reshape(-1, 3).copy()).to(dtype=dtype, device=device)
    links = torch.from_numpy(np.frombuffer(carriers, np.int64).copy()).to(device)
    parts = []
    for link in torch.unique(links):
        chosen = torch.nonzero(links == link)[:, 0]
        found = point_clusters(points[chosen])
        parts.append((chosen[found.order], found))
    return PointClusters(
        order=torch.cat([order for order, _ in parts]),
        clusters=joined([found.clusters for _, found in parts]),
        groups=joined([found.groups for _, found in parts]),
    )


def _padded(values: Tensor) -> Tensor:
    """Values ``[..., J]`` with at least one column, because Warp has no empty arrays."""
    return values if values.shape[-1] else torch.zeros_like(values[..., :1]).new_zeros(*values.shape[:-1], 1)


class _Joints:
    """Joints without gradients."""

    def __init__(self, moving: Articulation, order: Tensor | None):
        self.number, self.size = len(moving.slides), moving.size
        self.limited = int(moving.has_limits)
        self.links = 1 + self.number
        self.drives = moving.belts.shape[-1]
        self.dynamic_joints, self.dynamic_drives = moving.dynamic_joints, moving.dynamic_drives
        like, device = moving.grip, moving.grip.device

        def rows(values: Tensor) -> Tensor:
            return (values if len(values) else like.new_zeros(1, *values.shape[1:])).detach().contiguous()

        def indices(values: Sequence[int]) -> Tensor:
            return torch.tensor(list(values) or [-1], dtype=torch.int32, device=device)

        self.vectors = {name: rows(getattr(moving, name)) for name in ("axes", "origins", "places")}
        self.scalars = {name: rows(getattr(moving, name)) for name in ("masses", "rest")}
        chosen = slice(None) if order is None else order
        self.scalars["grip"] = moving.grip[chosen].contiguous()
        self.indices = {
            "slides": indices([int(slides) for slides in moving.slides]),
            "parents": indices(moving.parents),
            "coordinates": indices(moving.coordinates),
            "links": moving.point_links[chosen].to(torch.int32).contiguous(),
        }
        self.scalars["parameters"] = moving.parameters.contiguous()
        self.on_cuda = device.type == "cuda"
        self._arrays: dict[str, Any] = {}
        self._idle: list[_Scratch] = []

    @classmethod
    def of(cls, moving: Articulation, order: Tensor | None) -> _Joints:
        """Those of an articulation; ``order`` is that of the points, None for their own."""
        tables = (moving.axes, moving.origins, moving.places, moving.masses, moving.rest, moving.parameters)
        given = (*tables, moving.point_links, moving.grip, moving.slides, moving.parents, moving.coordinates, order)
        return _joints.get(given, lambda: cls(moving, order))

    def borrowed(self, kinds: Types, like: Tensor, width: int) -> _Scratch:
        """Scratch arrays without gradients, which no other launch uses until they are given back."""
        # Only lists' own operations, which are atomic, as launches run in several threads.
        idle = self._idle
        while idle:
            try:
                scratch = idle.pop()
            except IndexError:
                break
            if scratch.width == width:
                scratch.clear()
                return scratch
        return _Scratch(self, kinds, like, width)

    def give_back(self, scratch: _Scratch) -> None:
        """Let another launch have scratch arrays; those of launches that may still run are not kept."""
        if not self.on_cuda and len(self._idle) < CPU_THREADS:
            self._idle.append(scratch)

    def struct(self, kinds: Types) -> Any:
        """A kernel's struct, without the arrays that may have gradients."""
        if not self._arrays:
            listed = ((self.vectors, kinds.vec3), (self.scalars, kinds.scalar), (self.indices, wp.int32))
            self._arrays = {
                name: wp.from_torch(value, dtype=kind, requires_grad=False)
                for table, kind in listed
                for name, value in table.items()
            }
        struct = kinds.Joints()
        struct.number, struct.size, struct.limited = self.number, self.size, self.limited
        for name, array in self._arrays.items():
            setattr(struct, name, array)
        return struct

    def without_overwritten(self, gradients: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of the given angles, rates and belts from those of the states: the kernel wrote some of these."""
        result = []
        for gradient, columns in zip(
            gradients, (self.dynamic_joints, self.dynamic_joints, self.dynamic_drives), strict=True
        ):
            if columns:
                gradient[:, 1:, columns] = 0.0
            result.append(gradient)
        return result


_joints: IdentityCache[_Joints] = IdentityCache()


class _Arguments:
    """Kernel structs of a launch, and the arrays that may have gradients."""

    def __init__(
        self,
        fixed: Fixed,
        joints: _Joints,
        inputs: Sequence[Tensor],
        states: Sequence[Tensor],
        *,
        gradients: bool = False,
        state_gradients: Sequence[Tensor] | None = None,
    ):
        count = len(INPUTS)
        self.double, kinds = precision(inputs[0])
        if state_gradients is None and gradients:
            state_gradients = [torch.zeros_like(value) for value in states]
        self.base = Arguments(
            fixed, inputs[:count], states[:_BODY_STATES], gradients=gradients,
            state_gradients=state_gradients and state_gradients[:_BODY_STATES],
        )  # fmt: skip
        moving = joints.struct(kinds)
        self.extra = [
            wp.from_torch(
                value, dtype=kinds.scalar, requires_grad=gradients, grad=torch.zeros_like(value) if gradients else None
            )
            for value in inputs[count:]
        ]
        moving.target_angles, moving.target_rates = self.extra
        self.histories = [
            wp.from_torch(value, dtype=kinds.scalar, requires_grad=gradients, grad=gradient)
            for value, gradient in zip(
                states[_BODY_STATES:], state_gradients[_BODY_STATES:] if state_gradients else (None,) * 3, strict=True
            )
        ]
        moving_states = self.base.structs[-1]
        moving_states.angles, moving_states.rates, moving_states.belts = self.histories
        self.structs = [*self.base.structs, moving]

    def input_gradients(self) -> list[Tensor]:
        """Gradients of the inputs."""
        return [*self.base.gradients()[: len(INPUTS)], *(wp.to_torch(array.grad) for array in self.extra)]

    def state_gradients(self) -> list[Tensor]:
        """Gradients of the states."""
        return [*self.base.gradients()[len(INPUTS) :], *(wp.to_torch(array.grad) for array in self.histories)]


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: Fixed, joints: _Joints, *tensors: Tensor) -> tuple[Tensor, ...]:
        number = len(INPUTS) + 2
        listed = contiguous(tensors)
        inputs, start = listed[:number], listed[number:]
        batch, steps = inputs[6].shape[:2]
        states = []
        for value in start[:_BODY_STATES]:
            history = value.new_empty((batch, steps + 1, *value.shape[1:]))
            history[:, 0] = value
            states.append(history)
        states += [value.clone() for value in start[_BODY_STATES:]]
        differentiable = any(ctx.needs_input_grad)
        _launch(fixed, joints, inputs, states, differentiable=differentiable)
        if differentiable:
            ctx.fixed, ctx.joints = fixed, joints
            ctx.save_for_backward(*inputs, *states)
        return tuple(states)

    @staticmethod
    def backward(ctx: Any, *state_gradients: Tensor) -> tuple[Tensor | None, ...]:
        number = len(INPUTS) + 2
        saved = ctx.saved_tensors
        # The adjoint accumulates into these backwards in time, hence the copies.
        gradients = [g.clone(memory_format=torch.contiguous_format) for g in state_gradients]
        found = _launch(ctx.fixed, ctx.joints, saved[:number], saved[number:], state_gradients=gradients)
        histories = ctx.joints.without_overwritten(gradients[_BODY_STATES:])
        return (None, None, *found, *(g[:, 0] for g in gradients[:_BODY_STATES]), *histories)


class _Forces(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fixed: Fixed, joints: _Joints, every: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        listed = contiguous(tensors)
        speeds, points = listed[6], listed[2]
        batch, steps, count = speeds.shape[0], -(-speeds.shape[1] // every), points.shape[0]
        normal = speeds.new_zeros((batch, steps, count))
        tangential = speeds.new_zeros((batch, steps, count, 3))
        outputs = (normal, tangential, torch.zeros_like(tangential))
        differentiable = any(ctx.needs_input_grad)
        _launch_forces(fixed, joints, every, listed, outputs, differentiable=differentiable)
        if differentiable:
            ctx.fixed, ctx.joints, ctx.every = fixed, joints, every
            ctx.save_for_backward(*listed, *outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:
        tensors, outputs = ctx.saved_tensors[:-3], ctx.saved_tensors[-3:]
        gradients = [gradient.contiguous() for gradient in output_gradients]
        found = _launch_forces(ctx.fixed, ctx.joints, ctx.every, tensors, outputs, output_gradients=gradients)
        return (None, None, None, *found)


class _Scratch:
    """Arrays between the loops of a step: links, coordinates, and sums over the points; zero at first."""

    def __init__(
        self, joints: _Joints, kinds: Any, like: Tensor, width: int, slots: int = 1, *, gradients: bool = False
    ):
        self.width = width
        self._tensors: list[Tensor] = []
        links, inner = joints.links, max(1, joints.size)

        def array(kind: Any, *shape: int) -> Any:
            values = like.new_zeros((width, slots, *shape))
            self._tensors.append(values)
            gradient = torch.zeros_like(values) if gradients else None
            return wp.from_torch(values, dtype=kind, requires_grad=gradients, grad=gradient)

        posed = kinds.Links()
        posed.turns, posed.frames = array(kinds.mat33, links, 3, 3), array(kinds.vec3, links, 6, 3)
        work = joint_functions(like.dtype == torch.float64).Work()
        work.turns, work.frames = array(kinds.mat33, links, 3, 3), array(kinds.vec3, links, 6, 3)
        work.centre, work.inertia = array(kinds.vec3, 2, 3), array(kinds.mat33, 3, 3)
        dense = joints.size + 6 if joints.size else 1
        work.block = array(kinds.scalar, 6, 6) if joints.size else array(kinds.scalar, 1, 1)
        work.joined = array(kinds.scalar, dense, inner)
        work.pivots, work.factor = array(kinds.scalar, dense, dense), array(kinds.scalar, dense, dense)
        work.values = array(kinds.scalar, dense, 6)
        if gradients:
            work.block_gradient, work.joined_gradient = work.block.grad, work.joined.grad
            work.values_gradient = work.values.grad
        self.structs = [posed, work, array(kinds.vec3, 9, 3)]

    def clear(self) -> None:
        """Set everything to zero."""
        torch._foreach_zero_(self._tensors)


def _launch(
    fixed: Fixed,
    joints: _Joints,
    inputs: Sequence[Tensor],
    states: Sequence[Tensor],
    *,
    differentiable: bool = True,
    state_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the integration, or with ``state_gradients`` its adjoint, which returns the inputs' gradients."""
    batch, steps = inputs[6].shape[:2]
    backward = state_gradients is not None
    device = str(inputs[0].device)
    double, kinds = precision(inputs[0])
    kernel = integrate_joints_kernel(double, differentiable, fixed.soft)
    # Computed before the threads start; otherwise each would compute it.
    fixed.ceilings(inputs[0])

    def work(part: tuple[int, int]) -> list[Tensor]:
        arguments = _Arguments(fixed, joints, inputs, states, gradients=backward, state_gradients=state_gradients)
        for chunk, width in chunks(part, steps, inputs[0].device, backward=backward):
            # As without joints, the adjoint reads what the steps left in the scratch arrays.
            if backward:
                scratch = _Scratch(joints, kinds, inputs[0], width, max(1, steps), gradients=True)
            else:
                scratch = joints.borrowed(kinds, inputs[0], width)
            values = [chunk, steps, int(backward), *arguments.structs, *scratch.structs]
            wp.launch(kernel, dim=width, inputs=values, device=device, record_tape=False)
            if backward:
                wp.launch(kernel, dim=width, inputs=values, device=device, record_tape=False, **adjoint(values))
            else:
                joints.give_back(scratch)
        return arguments.input_gradients() if backward else []

    # Compile here, because two threads must not compile at the same time.
    kernel.module.load(wp.get_device(device))
    return summed(list(in_parallel(work, shares(batch, inputs[0].device))))


def _launch_forces(
    fixed: Fixed,
    joints: _Joints,
    every: int,
    tensors: Sequence[Tensor],
    outputs: Sequence[Tensor],
    *,
    differentiable: bool = True,
    output_gradients: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """Launch the forces of every n-th step, or with ``output_gradients`` their adjoint, which returns the gradients."""
    backward = output_gradients is not None
    device = str(tensors[0].device)
    number = len(INPUTS) + 2
    inputs, states, links = tensors[:number], tensors[number:-2], tensors[-2:]
    double, kinds = precision(tensors[0])
    kernel = forces_joints_kernel(double, differentiable, fixed.soft)
    fixed.ceilings(inputs[0])

    def work(part: tuple[int, int]) -> list[Tensor]:
        first, count = part
        arguments = _Arguments(fixed, joints, inputs, states, gradients=backward)
        posed = kinds.Links()
        arrays = [
            wp.from_torch(value, dtype=kind, requires_grad=backward, grad=torch.zeros_like(value) if backward else None)
            for value, kind in zip(links, (kinds.mat33, kinds.vec3), strict=True)
        ]
        posed.turns, posed.frames = arrays
        results = [
            wp.from_torch(t, dtype=kind, requires_grad=backward, grad=g)
            for t, kind, g in zip(
                outputs, (kinds.scalar, kinds.vec3, kinds.vec3), output_gradients or (None,) * 3, strict=True
            )
        ]
        listed = [first, every, *arguments.structs, posed, *results]
        extra = adjoint(listed) if backward else {}
        dim = (count, *outputs[0].shape[1:])
        wp.launch(kernel, dim=dim, inputs=listed, device=device, record_tape=False, **extra)
        if not backward:
            return []
        found = [*arguments.input_gradients(), *arguments.state_gradients()]
        return [*found, *(wp.to_torch(array.grad) for array in arrays)]

    kernel.module.load(wp.get_device(device))
    return summed(list(in_parallel(work, shares(outputs[0].shape[0], tensors[0].device))))
