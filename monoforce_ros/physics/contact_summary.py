"""ContactSummary: contact forces summed over the body, sufficient for costs and most other uses of a rollout."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from monoforce_ros.robots import RobotModel

STEEP = 0.5
"""Vertical component of the normal below which a contact is steep (more than 60°) and pushes rather than supports."""


@dataclass(frozen=True)
class ContactSummary:
    """Sums over the body's points during ``S`` steps of a rollout [N]."""

    load: Tensor
    """Normal force of the ground on each drive's points; the last entry is the hull, ``[B, S, D + 1]``."""
    traction: Tensor
    """Tangential force along the body's x axis on each drive's points, ``[B, S, D]``."""
    sides: Tensor
    """Normal force on all points left and right of the base frame, ``[B, S, 2]``."""
    push: Tensor
    """Horizontal component of the normal forces of steep contacts, ``[B, S, 2]`` in terrain axes."""
    force: Tensor
    """Total contact force, ``[B, S, 3]`` in terrain axes."""

    @classmethod
    def split(cls, sums: Tensor, drives: int) -> ContactSummary:
        """From one tensor with all sums concatenated, ``[B, S, 2 D + 8]``."""
        return cls(*sums.split((drives + 1, drives, 2, 2, 3), dim=-1))

    @classmethod
    def of_points(
        cls, robot: RobotModel, rotation: Tensor, normal_forces: Tensor, tangential_forces: Tensor, forces: Tensor
    ) -> ContactSummary:
        """Sum the forces of each point; differentiable.

        Args:
            robot: robot with the points.
            rotation: rotation terrain ← base at the start of each step, ``[B, S, 3, 3]``.
            normal_forces: ``[B, S, N]`` [N].
            tangential_forces: ``[B, S, N, 3]`` [N] in terrain axes.
            forces: total forces, ``[B, S, N, 3]`` [N] in terrain axes.
        """
        drives = robot.number_of_drives
        # The hull, drive -1, becomes the last entry.
        member = torch.nn.functional.one_hot(robot.point_drives % (drives + 1), drives + 1).to(normal_forces)
        ahead = (tangential_forces * rotation[..., None, :, 0]).sum(-1)
        lateral = robot.points[:, 1].to(normal_forces)
        sides = torch.stack([lateral > 0, lateral < 0], dim=-1).to(normal_forces)
        pressing = forces - tangential_forces
        steep = pressing[..., 2] < STEEP * normal_forces
        push = torch.where(steep[..., None], pressing[..., :2], 0.0).sum(dim=2)
        return cls(
            load=normal_forces @ member,
            traction=ahead @ member[:, :drives],
            sides=normal_forces @ sides,
            push=push,
            force=forces.sum(dim=2),
        )

    def joined(self, other: ContactSummary) -> ContactSummary:
        """These trajectories followed by others."""
        return ContactSummary(*(torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))
