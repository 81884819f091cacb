"""State and Rollout: current state and predicted motion of a robot."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from monoforce_ros.physics.contact_summary import ContactSummary


@dataclass(frozen=True)
class State:
    """Rigid-body state of a batch of robots, in the terrain frame."""

    position: Tensor
    """Origin of the base frame [m], ``[B, 3]``."""
    rotation: Tensor
    """Rotation terrain ← base, ``[B, 3, 3]``."""
    velocity: Tensor
    """Velocity of the base frame's origin in terrain axes [m/s], ``[B, 3]``."""
    angular_velocity: Tensor
    """Angular velocity in terrain axes [rad/s], ``[B, 3]``."""

    def __post_init__(self):
        batch = self.position.shape[0]
        for name, shape in (
            ("position", (batch, 3)),
            ("rotation", (batch, 3, 3)),
            ("velocity", (batch, 3)),
            ("angular_velocity", (batch, 3)),
        ):
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise ValueError(f"state {name}: got shape {got}, expected {shape}")

    @classmethod
    def at_rest(
        cls, height: float = 0.0, *, batch: int = 1, heading: float = 0.0, dtype: torch.dtype = torch.float32
    ) -> State:
        """Robots at rest and level, ``height`` [m] above the map's origin, with yaw ``heading`` [rad]."""
        angle = torch.tensor(heading, dtype=dtype)
        cos, sin, zero, one = (
            torch.cos(angle),
            torch.sin(angle),
            torch.zeros((), dtype=dtype),
            torch.ones((), dtype=dtype),
        )
        rotation = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one]).reshape(3, 3)
        position = torch.zeros(batch, 3, dtype=dtype)
        position[:, 2] = height
        return cls(position, rotation.repeat(batch, 1, 1), torch.zeros_like(position), torch.zeros_like(position))


@dataclass(frozen=True)
class Rollout:
    """Predicted motion and forces; index 0 along time is the start state."""

    times: Tensor
    """Time since the start [s], ``[T + 1]``."""
    position: Tensor
    """``[B, T + 1, 3]`` [m]."""
    rotation: Tensor
    """``[B, T + 1, 3, 3]``."""
    velocity: Tensor
    """``[B, T + 1, 3]`` [m/s]."""
    angular_velocity: Tensor
    """``[B, T + 1, 3]`` [rad/s]."""
    inside: Tensor
    """Whether the base frame's origin is on the map, ``[B, T + 1]`` bool; border values continue beyond the edge."""
    valid: Tensor
    """Whether a trajectory is finite throughout, ``[B]`` bool; invalid ones are NaN and have no gradient."""
    normal_forces: Tensor | None = None
    """Normal force of the ground on each body point during each step [N], ``[B, T, N]``, never negative."""
    tangential_forces: Tensor | None = None
    """Tangential contact force on each body point [N], ``[B, T, N, 3]`` in terrain axes."""
    forces: Tensor | None = None
    """Total contact force on each body point during each step [N], ``[B, T, N, 3]`` in terrain axes."""
    contact: ContactSummary | None = None
    """The forces summed over the body's points, ``[B, T, …]``."""
    joint_angles: Tensor | None = None
    """Angles of the joints [rad], ``[B, T + 1, J]``; None if nothing moves in the robot."""
    joint_rates: Tensor | None = None
    """``[B, T + 1, J]`` [rad/s]."""
    drive_speeds: Tensor | None = None
    """Surface speed of each drive [m/s], ``[B, T + 1, D]``; below its command where the motor's limits are reached."""
    joint_torques: Tensor | None = None
    """Torque of each joint's motor or spring against contact forces and weight [N m], ``[B, T, J]``, with forces."""
    force_every: int = 1
    """Forces and their sums are those of every n-th step; their dimension ``T`` is smaller by this factor."""

    def joined(self, other: Rollout) -> Rollout:
        """These trajectories followed by others with the same times; forces only if both have them."""
        parts = {}
        for entry in fields(self):
            mine, theirs = getattr(self, entry.name), getattr(other, entry.name)
            if entry.name in ("times", "force_every"):
                parts[entry.name] = mine
            elif isinstance(mine, ContactSummary):
                parts[entry.name] = None if theirs is None else mine.joined(theirs)
            else:
                parts[entry.name] = None if mine is None or theirs is None else torch.cat([mine, theirs])
        return Rollout(**parts)
