"""BodyContact: contact of all body points in a state, the same for every PyTorch integrator."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.physics.contact import Contact, contact
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.rotation import cross_matrix


@dataclass(frozen=True)
class BodyContact:
    """What contact depends on besides the state; every tensor may carry gradients."""

    lookup: TerrainLookup
    points: Tensor
    """Body points from the centre of mass, ``[B, 3, N]`` [m]."""
    tangents: Tensor
    """Direction in which each point's surface moves, ``[3, N]`` in base axes."""
    areas: Tensor
    """``[N]`` [m²]."""
    weights: Tensor
    """Share of each point in the robot's weight, ``[B, N]`` [N]."""
    speeds: Tensor
    """Of each drive and, last, of the hull, which does not move, ``[B, T, D + 1]`` [m/s]."""
    drives: Tensor
    """Drive of each point, ``[N]`` int64; -1 on the hull."""
    friction_factors: Tensor
    """``[B, 2]``."""
    rolling_resistance: Tensor
    """``[B]``."""
    yield_speed: Tensor
    """Of vegetation, ``[B]`` [m/s]."""
    options: PhysicsOptions

    @classmethod
    def of(cls, problem: Problem, options: PhysicsOptions) -> BodyContact:
        """Contact of a problem's robots with its terrain."""
        rolling, _, _, yield_speed = problem.resistance.unbind(-1)
        share = problem.point_areas / problem.point_areas.sum()
        return cls(
            lookup=TerrainLookup(problem.terrain, options.lookup, problem.batch_size, problem.vegetation_drag),
            points=problem.points.T - problem.centre_of_mass[..., None],
            tangents=problem.point_tangents.T,
            areas=problem.point_areas,
            weights=problem.mass[:, None] * options.gravity * share,
            # Drive -1, the hull, finds its zero at the end.
            speeds=torch.cat([problem.drive_speeds, torch.zeros_like(problem.drive_speeds[..., :1])], dim=-1),
            drives=problem.point_drives,
            friction_factors=problem.friction_factors,
            rolling_resistance=rolling,
            yield_speed=yield_speed,
            options=options,
        )

    def at(
        self,
        step: int,
        centre: Tensor,
        rotation: Tensor,
        velocity: Tensor,
        angular_velocity: Tensor,
        *,
        step_time: float | None = None,
    ) -> tuple[Tensor, Contact]:
        """Arms from the centre of mass to the points ``[B, 3, N]`` [m] in terrain axes, and the contact there.

        Args:
            step: whose drive speeds act.
            centre: of mass, ``[B, 3]`` [m].
            rotation: terrain ← base, ``[B, 3, 3]``.
            velocity: of the centre of mass, ``[B, 3]`` [m/s].
            angular_velocity: in terrain axes, ``[B, 3]`` [rad/s].
            step_time: see :func:`contact`.
        """
        # Three products in one: arms to the points, their velocities by the rotation, velocities of the belts.
        spin = cross_matrix(angular_velocity) @ rotation
        belts = self.tangents * self.speeds[:, step, self.drives][:, None]
        nothing = torch.zeros_like(rotation)
        frames = torch.cat(
            [torch.cat([rotation, nothing], 2), torch.cat([spin, nothing], 2), torch.cat([nothing, rotation], 2)], 1
        )
        arms, spun, belt = (frames @ torch.cat([self.points, belts], 1)).split(3, dim=1)
        points = centre[..., None] + arms
        return arms, contact(
            self.lookup(points),
            points,
            velocity[..., None] + spun,
            belt,
            rotation[..., 1],
            self.areas,
            self.weights,
            self.friction_factors,
            self.rolling_resistance,
            self.yield_speed,
            self.options,
            step_time=step_time,
        )
