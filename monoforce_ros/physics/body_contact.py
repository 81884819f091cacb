"""BodyContact: contact of all body points in a state, shared by the PyTorch integrators."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from monoforce_ros.physics.clusters import point_clusters
from monoforce_ros.physics.contact import Contact, contact
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.rotation import cross_matrix
from monoforce_ros.physics.soil_contact import SoilContact

_WORTH_TESTING = 4096
"""Number of points of all trajectories from which the test for nearby points takes less time than it saves: with a
Husky's 791 points the test costs 12 % of a step at B = 1, and saves 30 % at B = 32 (one thread, bumpy ground)."""


@dataclass(frozen=True)
class BodyContact:
    """Inputs of the contact model other than the state; every tensor may require gradients."""

    lookup: TerrainLookup
    points: Tensor
    """Body points relative to the centre of mass in base axes, ``[B, 3, N]`` [m]."""
    tangents: Tensor
    """Direction in which each point's surface moves, ``[3, N]`` in base axes."""
    outward: Tensor
    """Unit normal of the hull at each point, zero on belts, ``[3, N]`` in base axes."""
    areas: Tensor
    """Area of each point, ``[N]`` [m²]."""
    masses: Tensor
    """``[B]`` [kg]."""
    weights: Tensor
    """Share of the robot's weight per point, ``[B, N]`` [N]."""
    speeds: Tensor
    """Surface speed of each drive; the last entry is the hull, at zero, ``[B, T, D + 1]`` [m/s]."""
    drives: Tensor
    """Drive index of each point, ``[N]`` int64; -1 on the hull."""
    friction_factors: Tensor
    """As of :class:`Problem`, ``[B, 2, 3 or 4]``."""
    drive_loads: Tensor
    """Load of each point's drive beside that of the robot's file, 0 on the hull, ``[B, N]`` [-]."""
    ground_factors: Tensor
    """Divisor of the ground's stiffness and damping, and vegetation drag [N s/m⁴], ``[B, 2]``."""
    rolling_resistance: Tensor
    """Coefficient per trajectory, ``[B]``."""
    yield_speed: Tensor
    """Yield speed of vegetation, ``[B]`` [m/s]."""
    options: PhysicsOptions
    soil: SoilContact | None = None
    """Soft soil, with faces in base axes ``[3, N]``."""

    @classmethod
    def of(cls, problem: Problem, options: PhysicsOptions) -> BodyContact:
        """Contact of a problem's robots with its terrain."""
        rolling, _, _, yield_speed = problem.resistance.unbind(-1)
        share = problem.point_areas / problem.point_areas.sum()
        return cls(
            lookup=TerrainLookup(problem.terrain, options.lookup, problem.batch_size, problem.vegetation),
            points=problem.points.T - problem.centre_of_mass[..., None],
            tangents=problem.point_tangents.T,
            outward=problem.point_outward.T,
            areas=problem.point_areas,
            masses=problem.mass,
            weights=problem.mass[:, None] * options.gravity * share,
            # Index -1, the hull, selects the zero at the end.
            speeds=torch.cat([problem.drive_speeds, torch.zeros_like(problem.drive_speeds[..., :1])], dim=-1),
            drives=problem.point_drives,
            friction_factors=problem.friction_factors,
            drive_loads=torch.cat([problem.drive_loads, torch.zeros_like(problem.drive_loads[:, :1])], dim=-1)[
                :, problem.point_drives
            ],
            ground_factors=problem.ground_factors,
            rolling_resistance=rolling,
            yield_speed=yield_speed,
            options=options,
            soil=None
            if problem.soil is None
            else SoilContact(
                parameters=problem.soil,
                faces=problem.point_faces.T,
                widths=problem.point_strips[:, 0],
                curvatures=problem.point_strips[:, 1],
                belted=(problem.point_drives >= 0).to(problem.points),
            ),
        )

    def part(self, chosen: Tensor) -> BodyContact:
        """Contact of some of the points ``[n]`` (indices)."""
        return replace(
            self,
            points=self.points[..., chosen],
            tangents=self.tangents[:, chosen],
            outward=self.outward[:, chosen],
            areas=self.areas[chosen],
            weights=self.weights[:, chosen],
            drives=self.drives[chosen],
            drive_loads=self.drive_loads[:, chosen],
            soil=self.soil and self.soil.part(chosen),
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
        """Lever arms from the centre of mass to the points ``[B, 3, N]`` [m] in terrain axes, and their contact.

        Args:
            step: index of the drive speeds.
            centre: centre of mass, ``[B, 3]`` [m].
            rotation: terrain ← base, ``[B, 3, 3]``.
            velocity: velocity of the centre of mass, ``[B, 3]`` [m/s].
            angular_velocity: angular velocity in terrain axes, ``[B, 3]`` [rad/s].
            step_time: as in :func:`contact`.
        """
        # One product for lever arms, velocities of the points due to rotation, and velocities of the belts.
        spin = cross_matrix(angular_velocity) @ rotation
        belts = self.tangents * self.speeds[:, step, self.drives][:, None]
        zero = torch.zeros_like(rotation)
        frames = torch.cat(
            [torch.cat([rotation, zero], 2), torch.cat([spin, zero], 2), torch.cat([zero, rotation], 2)], 1
        )
        arms, spun, belt = (frames @ torch.cat([self.points, belts], 1)).split(3, dim=1)
        points = centre[..., None] + arms
        return arms, contact(
            self.lookup(points),
            points,
            velocity[..., None] + spun,
            belt,
            rotation @ self.outward,
            rotation[..., 1],
            self.areas,
            self.masses,
            self.weights,
            self.friction_factors,
            self.drive_loads,
            self.ground_factors,
            self.rolling_resistance,
            self.yield_speed,
            self.options,
            step_time=step_time,
            soil=self.soil and replace(self.soil, faces=rotation @ self.soil.faces),
        )


class NearbyContact:
    """Contact of the points that the ground may touch; the others, most of a body, need no computation.

    Args:
        problem: the robots and their terrain.
        options: contact laws.
    """

    def __init__(self, problem: Problem, options: PhysicsOptions):
        self.whole = BodyContact.of(problem, options)
        self.count = len(problem.points)
        self._origin = problem.centre_of_mass.detach()
        self._grid = problem.terrain.grid
        self._parts: dict[tuple[int, ...], tuple[BodyContact, Tensor]] = {}
        found = point_clusters(problem.points)
        edges, self._groups = found.clusters.edges[found.groups.edges.long()], found.groups
        self._members = [found.order[first:last] for first, last in itertools.pairwise(edges.tolist())]
        height = problem.terrain.height
        self._ceiling = found.groups.ceiling(height if height.ndim == 3 else height[None], self._grid.resolution)

    def near(self, centre: Tensor, rotation: Tensor) -> tuple[BodyContact, Tensor | None]:
        """Contact of the points that may touch in any of the poses, and their indices; None stands for all.

        Args:
            centre: centre of mass, ``[B, 3]`` [m].
            rotation: terrain ← base, ``[B, 3, 3]``.
        """
        # A compiled step has one shape, and a GPU would have to wait for the answer.
        few = len(centre) * self.count < _WORTH_TESTING
        if few or torch.compiler.is_compiling() or centre.device.type != "cpu":
            return self.whole, None
        touched = self._groups.near(self._ceiling, self._grid, centre.detach(), rotation.detach(), self._origin)
        groups = tuple(torch.nonzero(touched)[:, 0].tolist()) or (0,)
        if len(groups) == len(self._members):
            return self.whole, None
        if groups not in self._parts:
            # In the order of the body, so that sums do not depend on the grouping.
            chosen = torch.cat([self._members[group] for group in groups]).sort().values
            self._parts[groups] = self.whole.part(chosen), chosen
        return self._parts[groups]
