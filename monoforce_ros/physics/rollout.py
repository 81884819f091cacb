"""The rollout: a robot's motion over terrain (paper eq. 1), with the fastest available backend."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Protocol

import torch
from torch import Tensor

from monoforce_ros.physics import neural_ode, torch_backend
from monoforce_ros.physics.articulation import Articulation, JointLoads
from monoforce_ros.physics.contact_summary import ContactSummary
from monoforce_ros.physics.loads import tilted_gravity
from monoforce_ros.physics.neural_ode import OdeOptions
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Motion, Problem
from monoforce_ros.physics.state import Rollout, State
from monoforce_ros.robots import Controls, RobotModel
from monoforce_ros.terrain import TerrainMap

BACKENDS = ("auto", "torch", "warp")


def rollout(
    terrain: TerrainMap,
    robot: RobotModel,
    drive_speeds: Tensor | Controls,
    state: State,
    *,
    options: PhysicsOptions = PhysicsOptions(),  # noqa: B008  (frozen)
    with_forces: bool = True,
    with_contact: bool = False,
    force_every: int = 1,
    backend: str = "auto",
    ode: OdeOptions | None = None,
) -> Rollout:
    """Predict the motion of a batch of robots.

    Semi-implicit Euler: velocities are updated first, then positions from them, and rotations by the exponential map.
    Contact forces are linearly implicit: with their gains D on the body's six velocities, each step solves
    ``(M + Δt D) Δv = Δt f``, which is stable for any stiffness, damping and friction.

    Differentiable in the terrain's channels, drive speeds, start state, mass, centre of mass, inertia and friction.
    On soft soil (``options.soil``) also in its parameters. Uses the precision and device of ``state``; inputs are not
    modified.

    Args:
        terrain: one map for all trajectories, or a batch ``[B]`` of maps.
        robot: robot; physical quantities may have a batch dimension.
        drive_speeds: surface speed of each drive during each step [m/s], ``[B, T, D]``, or these with the angles of the
            robot's joints. Without angles, steering and flippers stay where they are.
        state: start states, ``[B]``.
        with_forces: whether to return per-point forces (memory grows with B · T · N).
        with_contact: whether to return their sums over the body, which cost little without gradients.
        force_every: return forces of every n-th step only; with many candidates the forces of all steps would take
            longer than the motion.
        ode: integrate with a torchdiffeq solver, as in the paper's Neural-ODE variant; forces are then those at the
            beginning of each step.
        backend: ``warp`` (compiled kernels), ``torch`` (the reference), or ``auto``: Warp if installed.

    Raises:
        ValueError: inconsistent shapes, or a backend that is not available.
    """
    batch = state.position.shape[0]
    controls = Controls(drive_speeds) if isinstance(drive_speeds, Tensor) else drive_speeds
    drive_speeds = controls.drive_speeds
    if force_every < 1:
        raise ValueError(f"forces of every {force_every} steps: expected 1 or more")
    if drive_speeds.ndim != 3 or drive_speeds.shape[0] != batch or drive_speeds.shape[2] != robot.number_of_drives:
        raise ValueError(
            f"drive speeds: got shape {tuple(drive_speeds.shape)}, expected [{batch}, T, {robot.number_of_drives}] "
            f"for the drives {robot.drive_names}"
        )
    _check_joints(robot, controls, (batch, drive_speeds.shape[1]))
    if terrain.batch_size not in (None, 1, batch):
        raise ValueError(f"terrain: got a batch of {terrain.batch_size} maps, expected 1 or {batch}")
    problem, finite = Problem.pose(terrain, robot, controls, state, options.time_step, options.soil)
    if ode is not None:
        if problem.articulation is not None:
            raise ValueError(
                f"ode: got a robot with moving joints, free wheels or motor limits ({robot.name}), which the "
                "Neural-ODE variant does not integrate; use rollout() without ode"
            )
        motion = neural_ode.integrate(problem, options, ode, with_forces or with_contact, force_every)
    else:
        motion = _backend(backend).integrate(problem, options, with_forces, with_contact, force_every)
    result = replace(_result(problem, motion, finite, options), force_every=force_every)
    if problem.articulation is not None and motion.forces is not None and with_forces:
        result = replace(
            result, joint_torques=_joint_torques(problem, problem.articulation, motion, options, force_every)
        )
    normal, tangential, forces = result.normal_forces, result.tangential_forces, result.forces
    if not with_contact or result.contact is not None or normal is None or tangential is None or forces is None:
        return result
    contact = ContactSummary.of_points(
        robot.to(result.position.dtype, result.position.device), result.rotation[:, :-1:force_every],
        normal, tangential, forces,
    )  # fmt: skip
    if with_forces:
        return replace(result, contact=contact)
    return replace(result, contact=contact, normal_forces=None, tangential_forces=None, forces=None)


def _joint_torques(
    problem: Problem, moving: Articulation, motion: Motion, options: PhysicsOptions, every: int
) -> Tensor | None:
    if motion.forces is None or motion.angles is None or motion.rates is None or not moving.slides:
        return None
    loads = JointLoads(motion.forces, tilted_gravity(problem.gravity_tilt, options.gravity))
    part = slice(None, -1, every)
    states = (motion.angles[:, part], motion.rates[:, part], motion.rotation[:, part])
    return moving.torques(*states, problem.body_mass, problem.points, loads)


def _check_joints(robot: RobotModel, controls: Controls, shape: tuple[int, int]) -> None:
    batch, steps = shape
    number = len(robot.joints)
    for name, expected in (
        ("joint_angles", (batch, steps, number)),
        ("joint_rates", (batch, steps, number)),
        ("start_angles", (batch, number)),
        ("start_rates", (batch, number)),
    ):
        value = getattr(controls, name)
        if value is not None and tuple(value.shape) != expected:
            raise ValueError(
                f"controls, {name}: got shape {tuple(value.shape)}, expected {list(expected)} for the joints "
                f"{robot.joint_names}"
            )


class _Backend(Protocol):
    def integrate(
        self, problem: Problem, options: PhysicsOptions, with_forces: bool, with_contact: bool, force_every: int, /
    ) -> Motion: ...


def _backend(name: str) -> _Backend:
    if name not in BACKENDS:
        raise ValueError(f"backend: got {name!r}, expected one of {BACKENDS}")
    if name == "torch":
        return torch_backend
    try:
        from monoforce_ros.physics import warp_backend
    except ImportError as error:
        if name == "auto":
            return torch_backend
        raise ValueError(f"backend: got 'warp', but {error}: pip install warp-lang, or use 'torch'") from error
    return warp_backend


def _result(problem: Problem, motion: Motion, finite: Tensor, options: PhysicsOptions) -> Rollout:
    if problem.articulation is None or motion.angles is None or motion.rates is None:
        offset = (motion.rotation @ problem.centre_of_mass[:, None, :, None])[..., 0]
        velocity = motion.velocity - torch.linalg.cross(motion.angular_velocity, offset)
    else:
        centre, rate = problem.articulation.centres(motion.angles, motion.rates, problem.body_mass)
        offset = (motion.rotation @ centre[..., None])[..., 0]
        drift = (motion.rotation @ rate[..., None])[..., 0]
        velocity = motion.velocity - torch.linalg.cross(motion.angular_velocity, offset) - drift
    position = motion.centre - offset
    states = (position, motion.rotation, velocity, motion.angular_velocity)
    # A sum is finite where all its terms are: far faster than asking each of them.
    valid = finite & torch.isfinite(torch.stack([t.detach().flatten(1).sum(1) for t in states])).all(0)

    all_valid = bool(valid.all())

    def mark(values: Tensor) -> Tensor:
        if all_valid:
            return values
        return values.masked_fill(~valid.view(-1, *[1] * (values.ndim - 1)), torch.nan)

    def mark_optional(values: Tensor | None) -> Tensor | None:
        return None if values is None else mark(values)

    grid, points = problem.terrain.grid, position.detach()[..., :2]
    left, right, bottom, top = grid.extent
    low, high = points.new_tensor([[left, bottom], [right, top]])
    return Rollout(
        times=options.time_step * torch.arange(problem.steps + 1, dtype=position.dtype, device=position.device),
        position=mark(position),
        rotation=mark(motion.rotation),
        velocity=mark(velocity),
        angular_velocity=mark(motion.angular_velocity),
        inside=((points >= low) & (points <= high)).all(dim=-1),
        valid=valid,
        normal_forces=mark_optional(motion.normal_forces),
        tangential_forces=mark_optional(motion.tangential_forces),
        forces=mark_optional(motion.forces),
        joint_angles=mark_optional(motion.angles),
        joint_rates=mark_optional(motion.rates),
        drive_speeds=mark_optional(motion.belts),
        contact=motion.contact
        and ContactSummary(*(mark(getattr(motion.contact, f.name)) for f in fields(motion.contact))),
    )
