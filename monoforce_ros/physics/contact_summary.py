"""ContactSummary: contact forces summed over a body, all that most questions about a rollout need of them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from monoforce_ros.robots import RobotModel

STEEP = 0.5
"""A contact whose normal has a smaller vertical part pushes rather than carries: it is steeper than 60°."""


@dataclass(frozen=True)
class ContactSummary:
    """Sums over the body's points during ``S`` of a rollout's steps [N]."""

    load: Tensor
    """Force of the ground along its normal on the points of each drive and, last, of the hull, ``[B, S, D + 1]``."""
    traction: Tensor
    """Force along the ground and the body's x axis on the points of each drive, ``[B, S, D]``."""
    sides: Tensor
    """Normal force on all points to the left and to the right of the base frame, ``[B, S, 2]``."""
    push: Tensor
    """Horizontal part of the normal forces of steep contacts, ``[B, S, 2]`` in terrain axes."""
    force: Tensor
    """Whole contact force, ``[B, S, 3]`` in terrain axes."""

    @classmethod
    def split(cls, sums: Tensor, drives: int) -> ContactSummary:
        """Of all of it side by side, ``[B, S, 2 D + 8]``."""
        return cls(*sums.split((drives + 1, drives, 2, 2, 3), dim=-1))

    @classmethod
    def of_points(
        cls, robot: RobotModel, rotation: Tensor, normal_forces: Tensor, tangential_forces: Tensor, forces: Tensor
    ) -> ContactSummary:
        """Sums of each point's forces; differentiable.

        Args:
            robot: whose points they act on.
            rotation: at the start of each of the steps, ``[B, S, 3, 3]``.
            normal_forces: ``[B, S, N]``.
            tangential_forces: ``[B, S, N, 3]``.
            forces: ``[B, S, N, 3]``.
        """
        drives = robot.number_of_drives
        # The hull, drive -1, is the last one.
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
        """Of these trajectories and of others after them."""
        return ContactSummary(*(torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))
