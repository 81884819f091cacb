"""The rollout in PyTorch: integrates a robot's motion over terrain (paper eq. 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.physics.contact import contact
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.rotation import exponential_map
from monoforce_ros.physics.state import Rollout, State
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap


def rollout(
    terrain: TerrainMap,
    robot: RobotModel,
    drive_speeds: Tensor,
    state: State,
    *,
    options: PhysicsOptions = PhysicsOptions(),  # noqa: B008  (frozen)
    with_forces: bool = True,
) -> Rollout:
    """Predict the motion of a batch of robots.

    Semi-implicit Euler: velocities first, then positions by the new velocities, the rotation by the exponential map.
    Contact forces enter linearly implicitly: with the forces' gains D on the body's six velocities,
    ``(M + Δt D) Δv = Δt f`` is solved each step, which is stable for any stiffness, damping and friction.

    Differentiable in the terrain's channels, drive speeds, start state, mass, centre of mass, inertia and friction.
    Works in the precision of ``state``; nothing given is written to.

    Args:
        terrain: one map for all, or a batch ``[B]`` of maps.
        robot: its physical quantities may carry a batch dimension.
        drive_speeds: surface speed of each drive during each step [m/s], ``[B, T, D]``.
        state: start states, ``[B]``.
        with_forces: whether to keep per-point forces (memory grows with B · T · N).

    Raises:
        ValueError: shapes that do not fit together.
    """
    position = state.position
    batch, dtype = position.shape[0], position.dtype
    terrain, robot = terrain.to(dtype, position.device), robot.to(dtype, position.device)
    if drive_speeds.ndim != 3 or drive_speeds.shape[0] != batch or drive_speeds.shape[2] != robot.number_of_drives:
        raise ValueError(
            f"drive speeds: got shape {tuple(drive_speeds.shape)}, expected [{batch}, T, {robot.number_of_drives}] "
            f"for the drives {robot.drive_names}"
        )
    # A trajectory that starts from NaN would poison the gradient of the terrain it shares with the others.
    valid = torch.stack(
        [torch.isfinite(t.detach()).reshape(batch, -1).all(1) for t in (*_tensors(state), drive_speeds)]
    ).all(0)
    position, rotation, velocity, angular_velocity, speeds = (
        torch.where(valid.view(-1, *[1] * (t.ndim - 1)), t, n)
        for t, n in zip((*_tensors(state), drive_speeds.to(dtype)), _neutral(state, drive_speeds, dtype), strict=True)
    )

    body = _Body(robot, batch)
    lookup = TerrainLookup(terrain, options.lookup, batch)
    steps = speeds.shape[1]
    point_speeds = _point_speeds(robot, speeds)
    gravity = torch.tensor([0.0, 0.0, -options.gravity], dtype=dtype, device=position.device)

    offset = rotation @ body.centre_of_mass[..., None]
    centre = position + offset[..., 0]
    velocity = velocity + torch.linalg.cross(angular_velocity, offset[..., 0])
    history: list[tuple[Tensor, ...]] = [(centre, rotation, velocity, angular_velocity)]
    normal_forces, forces = [], []
    for step in range(steps):
        arms = body.points @ rotation.transpose(1, 2)
        points = centre[:, None] + arms
        belt = (point_speeds[:, step, :, None] * robot.point_tangents) @ rotation.transpose(1, 2)
        velocities = velocity[:, None] + torch.linalg.cross(angular_velocity[:, None], arms)
        touch = contact(
            lookup(points),
            points,
            velocities,
            belt,
            rotation[:, None, :, 1],
            robot.point_areas,
            body.weights(options.gravity),
            body.friction_factors,
            options,
        )
        # Rows that turn the body's six velocities into the points' velocities along the contact directions, and by
        # their transpose forces along these into the body's force and torque.
        jacobian = torch.cat(
            [touch.directions, torch.linalg.cross(arms[:, :, None].expand_as(touch.directions), touch.directions)], -1
        ).flatten(1, 2)
        force, gain = touch.force.flatten(1), touch.gain.flatten(1)
        wrench = (force[:, None] @ jacobian)[:, 0]
        inertia = rotation @ body.inertia @ rotation.transpose(1, 2)
        gyroscopic = torch.linalg.cross(angular_velocity, (inertia @ angular_velocity[..., None])[..., 0])
        external = torch.cat([body.mass[:, None] * gravity, -gyroscopic], dim=-1)
        system = body.mass_matrix(inertia) + options.time_step * (
            (jacobian * gain[..., None]).transpose(1, 2) @ jacobian
        )
        change = torch.linalg.solve(system, options.time_step * (wrench + external))
        velocity = velocity + change[:, :3]
        angular_velocity = angular_velocity + change[:, 3:]
        centre = centre + options.time_step * velocity
        rotation = exponential_map(options.time_step * angular_velocity) @ rotation
        history.append((centre, rotation, velocity, angular_velocity))
        if with_forces:
            acted = (force - gain * (jacobian @ change[..., None])[..., 0]).unflatten(1, (-1, 3))
            pressing = acted[..., 0].clamp_min(0.0)
            normal_forces.append(pressing)
            acted = torch.cat([pressing[..., None], acted[..., 1:]], dim=-1)
            forces.append((acted[..., None] * touch.directions).sum(2))

    centre, rotation, velocity, angular_velocity = (torch.stack(t, dim=1) for t in zip(*history, strict=True))
    offset = (rotation @ body.centre_of_mass[:, None, :, None])[..., 0]
    position = centre - offset
    velocity = velocity - torch.linalg.cross(angular_velocity, offset)
    finite = torch.stack(
        [torch.isfinite(t).flatten(1).all(1) for t in (position, rotation, velocity, angular_velocity)]
    ).all(0)
    valid = valid & finite.detach()

    def mark(values: Tensor) -> Tensor:
        return values.masked_fill(~valid.view(-1, *[1] * (values.ndim - 1)), torch.nan)

    return Rollout(
        times=options.time_step * torch.arange(steps + 1, dtype=dtype, device=position.device),
        position=mark(position),
        rotation=mark(rotation),
        velocity=mark(velocity),
        angular_velocity=mark(angular_velocity),
        inside=lookup.inside(position.detach()),
        valid=valid,
        normal_forces=mark(torch.stack(normal_forces, dim=1)) if with_forces and steps else None,
        forces=mark(torch.stack(forces, dim=1)) if with_forces and steps else None,
    )


def _tensors(state: State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return state.position, state.rotation, state.velocity, state.angular_velocity


def _neutral(state: State, drive_speeds: Tensor, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """What an unusable trajectory is computed from instead: the robot standing at the map's origin."""
    identity = torch.eye(3, dtype=dtype, device=state.position.device).expand_as(state.rotation)
    zero = torch.zeros_like(state.position)
    return zero, identity, zero, zero, torch.zeros_like(drive_speeds, dtype=dtype)


def _point_speeds(robot: RobotModel, speeds: Tensor) -> Tensor:
    """Belt speed of each body point, ``[B, T, N]``; zero on the hull."""
    hull = torch.zeros_like(speeds[..., :1])
    return torch.cat([speeds, hull], dim=-1)[..., robot.point_drives]


class _Body:
    """The robot's quantities with a batch dimension, points relative to the centre of mass."""

    def __init__(self, robot: RobotModel, batch: int):
        self.mass = robot.mass.expand(batch)
        self.centre_of_mass = robot.centre_of_mass.expand(batch, 3)
        self.inertia = robot.inertia.expand(batch, 3, 3)
        self.points = robot.points - self.centre_of_mass[:, None]
        factors = torch.stack([robot.friction_longitudinal.expand(batch), robot.friction_lateral.expand(batch)], -1)
        self.friction_factors = factors[:, None]
        self._share = robot.point_areas / robot.point_areas.sum()
        self._translation = self.mass[:, None, None] * torch.eye(3, dtype=self.mass.dtype, device=self.mass.device)

    def weights(self, gravity: float) -> Tensor:
        """Share of each point in the robot's weight [N], ``[B, N]``: the paper's m_i g with mass spread over area."""
        return self.mass[:, None] * gravity * self._share

    def mass_matrix(self, inertia: Tensor) -> Tensor:
        """``[B, 6, 6]`` of the world-frame inertia ``[B, 3, 3]``."""
        zero = torch.zeros_like(inertia)
        return torch.cat([torch.cat([self._translation, zero], 2), torch.cat([zero, inertia], 2)], 1)
