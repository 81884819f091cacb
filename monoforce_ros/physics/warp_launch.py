"""Launches of Warp kernels: structs and arrays from tensors, adjoints, and batches shared among threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from monoforce_ros.physics.clusters import PointClusters
from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.warp_kernels import COULOMB, NO_FRICTION, SIGMOID, Types, types
from monoforce_ros.terrain import TerrainMap

CPU_THREADS = 2
"""Simultaneous launches on the CPU; a launch uses one core and releases the GIL."""
SMALLEST_SHARE = 4
"""Smallest number of trajectories per thread; splitting smaller batches takes longer."""

CPU_CHUNK = 8
"""Number of trajectories whose per-step values are in memory at once in the backward pass on the CPU."""
CUDA_STEPS = 500_000
"""The same on CUDA, times the number of steps: about 100 MB of sums in float32. A GPU computes a thousand trajectories
at the same time, each as slowly as one alone."""

_TANGENTIAL = {"none": NO_FRICTION, "coulomb": COULOMB, "sigmoid": SIGMOID}
_threads: ThreadPoolExecutor | None = None


INPUTS = (
    "height", "material", "points", "areas", "tangents", "share", "speeds", "mass", "centre_of_mass", "inertia",
    "friction", "ground_factors", "tilt", "resistance", "wrench", "soil", "loads",
)  # fmt: skip
"""Kernel inputs with gradients, other than the states."""
BODY_INPUTS = INPUTS[2:6]
"""Those that are sampled over the body."""
STATES = ("centre", "rotation", "velocity", "angular_velocity")


class SampledBody:
    """Points of a body with what they stand for, as arrays of a kernel.

    Args:
        sampled: points, areas, tangents and shares of the area, in the order of :data:`INPUTS`.
        drives: drive index of each point, ``[N]``; -1 on the hull.
        outward: unit normal of the hull, zero on belts, ``[N, 3]``.
        strips: width [m] and curvature [1/m] of the surface, ``[N, 2]``.
        clusters: clusters of the points.
    """

    def __init__(
        self, sampled: tuple[Tensor, ...], drives: Tensor, outward: Tensor, strips: Tensor, clusters: PointClusters
    ):
        self.sampled = sampled
        self.drives = drives.to(torch.int32).contiguous()
        self.outward = outward.detach().contiguous()
        self.strips = strips.detach().contiguous()
        self.clusters = clusters
        # The arrays below do not keep their tensors.
        self._kept = contiguous(sampled)
        self._struct: Any = None

    def ordered(self) -> SampledBody:
        """The same with the points of each cluster beside each other."""
        order = self.clusters.order
        sampled = tuple(values[order] for values in self.sampled)
        return SampledBody(sampled, self.drives[order], self.outward[order], self.strips[order], self.clusters)

    def struct(self, kinds: Types) -> Any:
        """The kernel's struct, without gradients; made once."""
        if self._struct is None:
            element = elements(kinds)
            arrays = {
                name: wp.from_torch(value, dtype=element[name], requires_grad=False)
                for name, value in zip(BODY_INPUTS, self._kept, strict=True)
            }
            self._struct = self.filled(kinds, arrays)
        return self._struct

    def filled(self, kinds: Types, arrays: Mapping[str, Any]) -> Any:
        """A kernel's struct with given arrays of points, areas, tangents and shares."""
        body = kinds.Body()
        for name in BODY_INPUTS:
            setattr(body, name, arrays[name])
        body.drives = wp.from_torch(self.drives, dtype=wp.int32)
        body.outward = wp.from_torch(self.outward, dtype=kinds.vec3)
        body.strips = wp.from_torch(self.strips, dtype=kinds.vec2)
        for name, boxes in (("cluster", self.clusters.clusters), ("group", self.clusters.groups)):
            setattr(body, f"{name}_centres", wp.from_torch(boxes.centres, dtype=kinds.vec3))
            setattr(body, f"{name}_halves", wp.from_torch(boxes.halves, dtype=kinds.vec3))
            setattr(body, f"{name}_edges", wp.from_torch(boxes.edges, dtype=wp.int32))
        return body


class Fixed:
    """Inputs of a launch without gradients."""

    def __init__(self, options: PhysicsOptions, terrain: TerrainMap, body: SampledBody, compliant: bool):
        self.compliant = compliant
        self.options = options
        self.grid = terrain.grid
        self.body = body
        self._heights = terrain.height
        self.clusters = body.clusters
        self._ceilings: tuple[Tensor, Tensor] | None = None

    @property
    def soft(self) -> bool:
        """Whether the ground is soft soil."""
        return self.options.soil is not None

    def ceilings(self, height: Tensor) -> tuple[Tensor, Tensor]:
        """The highest ground near each node, against which clusters and groups are tested."""
        if self._ceilings is None:
            # ``height`` is the same on as many pages as the launch needs.
            values = len(height), self.grid.resolution
            self._ceilings = _ceilings.get((self._heights, self.clusters), lambda: self._highest(height), values=values)
        return self._ceilings

    def _highest(self, height: Tensor) -> tuple[Tensor, Tensor]:
        boxes, resolution = (self.clusters.clusters, self.clusters.groups), self.grid.resolution
        fine, coarse = (box.ceiling(height, resolution).contiguous() for box in boxes)
        return fine, coarse


_ceilings: IdentityCache[tuple[Tensor, Tensor]] = IdentityCache(8)


class Arguments:
    """Kernel structs for tensors, and the arrays that may have gradients.

    Args:
        fixed: inputs without gradients.
        inputs: tensors in the order of :data:`INPUTS`.
        states: tensors in the order of :data:`STATES`.
        gradients: whether to collect gradients of the inputs.
        state_gradients: tensors to which gradients of the states are added; allocated if None and ``gradients`` is set.
    """

    def __init__(
        self,
        fixed: Fixed,
        inputs: Sequence[Tensor],
        states: Sequence[Tensor],
        *,
        gradients: bool = False,
        state_gradients: Sequence[Tensor] | None = None,
    ):
        self.double, kinds = precision(inputs[0])
        element = elements(kinds)
        named = dict(zip(INPUTS, inputs, strict=True))
        if not gradients:
            # The points are those of the body, whose struct is made already.
            named = {name: value for name, value in named.items() if name not in BODY_INPUTS}
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
            for name, value, gradient in zip(STATES, states, state_gradients or (None,) * 4, strict=True)
        }
        body = fixed.body.filled(kinds, self.inputs) if gradients else fixed.body.struct(kinds)
        ground, robots, options = kinds.Ground(), kinds.Robots(), kinds.Options()
        ground.height, ground.material = self.inputs["height"], self.inputs["material"]
        ground.ceiling, ground.group_ceiling = (
            wp.from_torch(ceiling, dtype=kinds.scalar) for ceiling in fixed.ceilings(inputs[0])
        )
        ground.rows, ground.columns = fixed.grid.rows, fixed.grid.columns
        ground.origin_x, ground.origin_y = (kinds.scalar(value) for value in fixed.grid.origin)
        ground.inverse_resolution = kinds.scalar(1.0 / fixed.grid.resolution)
        for name in INPUTS[6:]:
            setattr(robots, name, self.inputs[name])
        options.time_step = kinds.scalar(fixed.options.time_step)
        options.gravity = kinds.scalar(fixed.options.gravity)
        options.slip_square = kinds.scalar(fixed.options.slip_regularisation**2)
        options.lookup = int(fixed.options.lookup == "bilinear")
        options.normal = int(fixed.options.normal_force == "normal")
        options.tangential = _TANGENTIAL[fixed.options.tangential_force]
        options.compliant = int(fixed.compliant)
        moving = kinds.States()
        for name, array in self.states.items():
            setattr(moving, name, array)
        self.structs: list[Any] = [ground, body, robots, options, moving]

    def gradients(self) -> list[Tensor]:
        """Gradients of the inputs, then of the states."""
        return [wp.to_torch(array.grad) for array in (*self.inputs.values(), *self.states.values())]


def precision(tensor: Tensor) -> tuple[bool, Types]:
    """Whether a tensor has double precision, and the kernels' types."""
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"rollout precision: got {tensor.dtype}, expected float32 or float64")
    double = tensor.dtype == torch.float64
    return double, types(double)


def elements(kinds: Types) -> dict[str, Any]:
    """Warp element types of inputs and states."""
    s, v2, v3, v4, m = kinds.scalar, kinds.vec2, kinds.vec3, kinds.vec4, kinds.mat33
    inputs = (s, v4, v3, s, v3, s, s, s, v3, m, v4, v3, v2, v4, kinds.wrench, kinds.soil, s)
    return dict(zip((*INPUTS, *STATES), (*inputs, v3, m, v3, v3), strict=True))


def contiguous(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The tensors without their graph and with contiguous memory."""
    return [t.detach().contiguous() for t in tensors]


def adjoint(inputs: Sequence[Any]) -> dict[str, Any]:
    """Launch arguments that run a kernel's adjoint: arrays have their own gradients, other arguments none."""
    adjoints = [None if isinstance(value, wp.array) else type(value)() for value in inputs]
    return {"adjoint": True, "adj_inputs": adjoints, "adj_outputs": []}


def summed(parts: list[list[Tensor]]) -> list[Tensor]:
    """Sum the gradients of several launches."""
    return [torch.stack(entries).sum(0) if len(entries) > 1 else entries[0] for entries in zip(*parts, strict=True)]


def shares(batch: int, device: torch.device) -> list[tuple[int, int]]:
    """Index of the first trajectory and number of trajectories of each launch."""
    workers = 1 if device.type == "cuda" else max(1, min(CPU_THREADS, batch // SMALLEST_SHARE))
    edges = [round(batch * k / workers) for k in range(workers + 1)]
    return [(low, high - low) for low, high in itertools.pairwise(edges)]


def chunks(part: tuple[int, int], steps: int, device: torch.device, *, backward: bool) -> list[tuple[int, int]]:
    """Index of the first trajectory and number of trajectories of each launch of one share of a batch.

    The forward pass takes all at once; the backward pass keeps the values of all steps, and takes as many as fit.
    """
    first, count = part
    most = (CPU_CHUNK if device.type == "cpu" else max(1, CUDA_STEPS // max(1, steps))) if backward else count
    return [(start, min(most, first + count - start)) for start in range(first, first + count, max(1, most))]


def in_parallel[Result](work: Callable[[tuple[int, int]], Result], shares: list[tuple[int, int]]) -> list[Result]:
    """Results of the shares of a batch, from a pool of threads if there are several."""
    global _threads
    if len(shares) == 1:
        return [work(shares[0])]
    if _threads is None:
        _threads = ThreadPoolExecutor(CPU_THREADS, thread_name_prefix="rollout")
    return list(_threads.map(work, shares))
