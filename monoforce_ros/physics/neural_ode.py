"""The paper's Neural-ODE variant (III-E): the same forces as a continuous-time system for torchdiffeq's solvers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from monoforce_ros.physics.body_contact import BodyContact
from monoforce_ros.physics.loads import LoadModel
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.rotation import cross, cross_matrix

METHODS = ("euler", "midpoint", "rk4", "dopri5")
_STABLE = 0.66
"""Largest product of a fixed step and the rate at which friction stops a sliding robot. On the negative axis methods
of Runge and Kutta are stable to 2 (``euler``, ``midpoint``) or 2.78 (``rk4``; Hairer and Wanner 1996), and a robot that
turns stops up to three times as fast as one that slides: its mass lies nearer to its centre than its wheels do."""


@dataclass(frozen=True)
class OdeOptions:
    """Solver and its accuracy."""

    method: str = "rk4"
    """torchdiffeq's name: fixed steps (``euler``, ``midpoint``, ``rk4``) or adaptive (``dopri5``)."""
    adjoint: bool = False
    """Compute gradients from the adjoint equation backwards in time (constant memory) instead of through the solver."""
    step: float = 0.001
    """Step of the fixed-step methods [s], divided by a whole number where friction that is mobilised at little slip
    (``friction_creep``, ``slip_regularisation``) needs shorter ones; so do stiff contacts."""
    tolerance: float = 1e-5
    """Relative and absolute tolerance of the adaptive method."""

    def __post_init__(self):
        if self.method not in METHODS:
            raise ValueError(f"ode method: got {self.method!r}, expected one of {METHODS}")
        if not 1e-6 <= self.step <= 0.1:
            raise ValueError(f"ode step: got {self.step}, expected 1e-6 to 0.1 s")


def integrate(
    problem: Problem,
    options: PhysicsOptions,
    ode: OdeOptions,
    with_forces: bool = False,
    force_every: int = 1,
) -> Motion:
    """Solve for the motion at the rollout's time steps.

    Forces are those at the beginning of each step; a continuous-time solver has no average over a step.
    """
    from torchdiffeq import odeint

    system = _System.of(problem, options)
    if ode.adjoint:
        states = _AdjointSolution.apply(system, problem.steps, ode, *system.tensors, *_start(problem))
    else:
        times, settings = _solver(system, problem.steps, ode)
        states = odeint(system, _start(problem), times, **settings)
    centre, rotation, velocity, angular_velocity = (state.transpose(0, 1) for state in states)
    # A general solver does not keep rotations orthonormal. Two Newton steps restore them; a singular value
    # decomposition would too, but has no gradient at equal singular values.
    for _ in range(2):
        rotation = 1.5 * rotation - 0.5 * rotation @ rotation.transpose(-1, -2) @ rotation
    motion = Motion(centre, rotation, velocity, angular_velocity)
    return _with_forces(motion, system.body, range(0, problem.steps, force_every)) if with_forces else motion


def _start(problem: Problem) -> tuple[Tensor, ...]:
    return problem.centre, problem.rotation, problem.velocity, problem.angular_velocity


def _solver(system: _System, steps: int, ode: OdeOptions) -> tuple[Tensor, dict[str, Any]]:
    """Times of the rollout's steps, and torchdiffeq's settings."""
    like = system.body.points
    times = system.options.time_step * torch.arange(steps + 1, dtype=like.dtype, device=like.device)
    settings: dict[str, Any] = {"method": ode.method}
    if ode.method == "dopri5":
        settings.update(rtol=ode.tolerance, atol=ode.tolerance)
    else:
        settings["options"] = {"step_size": ode.step / max(1, math.ceil(ode.step * _friction_rate(system) / _STABLE))}
    return times, settings


def _friction_rate(system: _System) -> float:
    """Rate at which friction stops a robot that slides slowly [1/s]: μ g / ε."""
    body, options = system.body, system.options
    if options.tangential_force != "coulomb":
        return 0.0
    friction = float(body.lookup.largest_friction) * float(body.friction_factors[:, :2].detach().max())
    creep = 1.0 if body.soil is not None else float(body.ground_factors[:, 2].detach().min())
    return friction * options.gravity / (options.slip_regularisation * creep)


def _with_forces(motion: Motion, body: BodyContact, steps: range) -> Motion:
    normal_forces, tangential_forces, forces = [], [], []
    for step in steps:
        state = (motion.centre, motion.rotation, motion.velocity, motion.angular_velocity)
        _, touch = body.at(step, *(values[:, step] for values in state), step_time=0.0)
        tangential = (touch.directions[:, :, 1:] * touch.force[:, None, 1:]).sum(2)
        normal_forces.append(touch.force[:, 0])
        tangential_forces.append(tangential.transpose(1, 2))
        forces.append(touch.vectors.transpose(1, 2))
    if not forces:
        return motion
    return replace(
        motion,
        normal_forces=torch.stack(normal_forces, dim=1),
        tangential_forces=torch.stack(tangential_forces, dim=1),
        forces=torch.stack(forces, dim=1),
    )


class _System(nn.Module):
    """Time derivative of (centre, rotation, velocity, angular velocity), paper eq. 1."""

    def __init__(self, body: BodyContact, loads: LoadModel, mass: Tensor, inertia: Tensor, options: PhysicsOptions):
        super().__init__()
        self.body, self.loads, self.mass, self.inertia, self.options = body, loads, mass, inertia, options

    @classmethod
    def of(cls, problem: Problem, options: PhysicsOptions) -> _System:
        """The system of a problem."""
        body, loads = BodyContact.of(problem, options), LoadModel.of(problem, options.gravity)
        return cls(body, loads, problem.mass, problem.inertia, options)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors on which the derivative depends and that may require gradients."""
        body, loads = self.body, self.loads
        soil = () if body.soil is None else (body.soil.parameters,)
        return (
            *soil,
            body.lookup.channels, body.points, body.tangents, body.areas, body.weights, body.speeds,
            body.friction_factors, body.drive_loads, body.ground_factors, body.rolling_resistance, body.yield_speed,
            loads.weight, loads.linear_drag, loads.quadratic_drag, loads.wrench, self.mass, self.inertia,
        )  # fmt: skip

    def with_tensors(self, tensors: tuple[Tensor, ...]) -> _System:
        """The same system with other :attr:`tensors`."""
        body = self.body
        if body.soil is not None:
            body, tensors = replace(body, soil=replace(body.soil, parameters=tensors[0])), tensors[1:]
        channels, points, tangents, areas, weights, speeds, friction, carried, *rest = tensors
        ground, rolling, yield_speed, *loads, mass, inertia = rest
        body = replace(
            body, lookup=body.lookup.with_channels(channels), points=points, tangents=tangents, areas=areas,
            weights=weights, speeds=speeds, friction_factors=friction, drive_loads=carried,
            ground_factors=ground, rolling_resistance=rolling, yield_speed=yield_speed,
        )  # fmt: skip
        return _System(body, LoadModel(*loads), mass, inertia, self.options)

    def forward(self, time: Tensor, state: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        centre, rotation, velocity, angular_velocity = state
        steps = self.body.speeds.shape[1]
        step = min(int(float(time.detach()) / self.options.time_step + 1e-9), steps - 1)
        arms, touch = self.body.at(step, centre, rotation, velocity, angular_velocity, step_time=0.0)
        forces = touch.vectors
        inertia = rotation @ self.inertia @ rotation.transpose(1, 2)
        external = self.loads.at(rotation, velocity, angular_velocity, inertia)
        return (
            velocity,
            cross_matrix(angular_velocity) @ rotation,
            (forces.sum(2) + external.force) / self.mass[:, None],
            torch.linalg.solve(inertia, cross(arms, forces).sum(2) + external.torque),
        )


class _AdjointSolution(torch.autograd.Function):
    """Solves the adjoint equation for the gradients of all tensors of the system and the start state.

    torchdiffeq's adjoint repeatedly differentiates the system with respect to these tensors. They are detached copies,
    because some depend on others (mass and centre of mass of a payload, height and vegetation of a map), and their
    gradients would otherwise be counted twice and their graphs traversed twice.
    """

    @staticmethod
    def forward(ctx: Any, system: _System, steps: int, ode: OdeOptions, *tensors: Tensor) -> tuple[Tensor, ...]:
        from torchdiffeq import odeint_adjoint

        leaves = [tensor.detach().requires_grad_(tensor.requires_grad) for tensor in tensors]
        detached = system.with_tensors(tuple(leaves[:-4]))
        times, settings = _solver(detached, steps, ode)
        with torch.enable_grad():
            parameters = tuple(leaf for leaf in leaves[:-4] if leaf.requires_grad)
            states = odeint_adjoint(detached, tuple(leaves[-4:]), times, adjoint_params=parameters, **settings)
        ctx.leaves, ctx.states = leaves, states
        return tuple(state.detach() for state in states)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        differentiable = [leaf for leaf in ctx.leaves if leaf.requires_grad]
        found = iter(torch.autograd.grad(ctx.states, differentiable, gradients, allow_unused=True))
        return (None, None, None, *(next(found) if leaf.requires_grad else None for leaf in ctx.leaves))
