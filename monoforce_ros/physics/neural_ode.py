"""The paper's Neural-ODE variant (III-E): the same forces as a continuous-time system for torchdiffeq's solvers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from monoforce_ros.physics.contact import contact, cross
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.rotation import cross_matrix
from monoforce_ros.physics.torch_backend import SMALLEST_SPEED, features, tilted_gravity

METHODS = ("euler", "midpoint", "rk4", "dopri5")


@dataclass(frozen=True)
class OdeOptions:
    """Which solver integrates, and how exactly."""

    method: str = "rk4"
    """torchdiffeq's name: fixed steps (``euler``, ``midpoint``, ``rk4``) or adaptive (``dopri5``)."""
    adjoint: bool = False
    """Gradients by solving the adjoint equation backwards in time (constant memory) instead of through the solver."""
    step: float = 0.001
    """Step of the fixed-step methods [s]: stiff contacts need short ones."""
    tolerance: float = 1e-5
    """Relative and absolute tolerance of the adaptive method."""

    def __post_init__(self):
        if self.method not in METHODS:
            raise ValueError(f"ode method: got {self.method!r}, expected one of {METHODS}")
        if not 1e-6 <= self.step <= 0.1:
            raise ValueError(f"ode step: got {self.step}, expected 1e-6 to 0.1 s")


def integrate(problem: Problem, options: PhysicsOptions, ode: OdeOptions) -> Motion:
    """Solve for the motion at the rollout's time steps; forces are not returned."""
    from torchdiffeq import odeint, odeint_adjoint

    system = _System(problem, options)
    count = problem.steps + 1
    times = options.time_step * torch.arange(count, dtype=problem.centre.dtype, device=problem.centre.device)
    settings: dict = {"method": ode.method}
    if ode.method == "dopri5":
        settings.update(rtol=ode.tolerance, atol=ode.tolerance)
    else:
        settings["options"] = {"step_size": ode.step}
    start = (problem.centre, problem.rotation, problem.velocity, problem.angular_velocity)
    if ode.adjoint:
        # What the system depends on must be named for the adjoint to return its gradient.
        parameters = tuple(t for t in system.dependencies if t.requires_grad)
        states = odeint_adjoint(system, start, times, adjoint_params=parameters, **settings)
    else:
        states = odeint(system, start, times, **settings)
    centre, rotation, velocity, angular_velocity = (state.transpose(0, 1) for state in states)
    # A general solver does not know that rotations are orthonormal. Two Newton steps lead back to the nearest ones;
    # a singular value decomposition would too, but has no gradient where the values are equal.
    for _ in range(2):
        rotation = 1.5 * rotation - 0.5 * rotation @ rotation.transpose(-1, -2) @ rotation
    return Motion(centre, rotation, velocity, angular_velocity)


class _System(nn.Module):
    """Time derivative of (centre, rotation, velocity, angular velocity), paper eq. 1."""

    def __init__(self, problem: Problem, options: PhysicsOptions):
        super().__init__()
        self._problem = problem
        self._options = options
        self._lookup = TerrainLookup(problem.terrain, options.lookup, problem.batch_size, problem.vegetation_drag)
        self._points = problem.points.T - problem.centre_of_mass[..., None]
        hull = torch.zeros_like(problem.drive_speeds[..., :1])
        self._speeds = torch.cat([problem.drive_speeds, hull], dim=-1)
        share = problem.point_areas / problem.point_areas.sum()
        self._weights = problem.mass[:, None] * options.gravity * share

    @property
    def dependencies(self) -> tuple[Tensor, ...]:
        problem, terrain = self._problem, self._problem.terrain
        maps = (terrain.height, terrain.stiffness, terrain.damping, terrain.friction)
        body = (problem.mass, problem.centre_of_mass, problem.inertia, problem.friction_factors, problem.drive_speeds)
        return maps + body

    def forward(self, time: Tensor, state: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        problem, options = self._problem, self._options
        centre, rotation, velocity, angular_velocity = state
        turned = rotation.transpose(1, 2)
        arms = rotation @ self._points
        points = centre[..., None] + arms
        step = min(int(float(time.detach()) / options.time_step + 1e-9), problem.steps - 1)
        belt = rotation @ (self._speeds[:, step, problem.point_drives][:, None] * problem.point_tangents.T)
        rolling, linear_drag, quadratic_drag, yield_speed = problem.resistance.unbind(-1)
        touch = contact(
            self._lookup(points),
            points,
            velocity[..., None] + cross_matrix(angular_velocity) @ arms,
            belt,
            rotation[..., 1],
            problem.point_areas,
            self._weights,
            problem.friction_factors,
            rolling,
            yield_speed,
            options,
            step_time=0.0,
        )
        forces = touch.vectors
        in_body = turned @ torch.stack([velocity, angular_velocity], dim=-1)
        extra = (problem.wrench @ features(in_body, rotation)[..., None])[..., 0]
        drag = linear_drag + quadratic_drag * torch.sqrt((velocity * velocity).sum(-1) + SMALLEST_SPEED**2)
        force = forces.sum(2) + problem.mass[:, None] * tilted_gravity(problem.gravity_tilt, options.gravity)
        force = force - drag[:, None] * velocity + (rotation @ extra[:, :3, None])[..., 0]
        inertia = rotation @ problem.inertia @ turned
        torque = cross(arms, forces).sum(2) + (rotation @ extra[:, 3:, None])[..., 0]
        torque = torque - cross(angular_velocity, (inertia @ angular_velocity[..., None])[..., 0])
        return (
            velocity,
            cross_matrix(angular_velocity) @ rotation,
            force / problem.mass[:, None],
            torch.linalg.solve(inertia, torque),
        )
