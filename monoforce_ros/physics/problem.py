"""Problem: inputs of a rollout in the form used by both backends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from monoforce_ros.effects import applied_setup
from monoforce_ros.physics.articulation import Articulation, BodyMass
from monoforce_ros.physics.contact_summary import ContactSummary
from monoforce_ros.physics.drive_loads import drive_loads
from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.soil import Soil
from monoforce_ros.physics.state import State
from monoforce_ros.robots import Controls, RobotModel
from monoforce_ros.terrain import TerrainMap


@dataclass(frozen=True)
class Problem:
    """All inputs, finite, with one precision and device, and relative to the centre of mass."""

    terrain: TerrainMap
    """One map or a batch ``[B]``."""
    centre: Tensor
    """Start position of the centre of mass [m], ``[B, 3]``."""
    rotation: Tensor
    """Start rotation terrain ← base, ``[B, 3, 3]``."""
    velocity: Tensor
    """Start velocity of the centre of mass [m/s], ``[B, 3]``."""
    angular_velocity: Tensor
    """Start angular velocity in terrain axes [rad/s], ``[B, 3]``."""
    drive_speeds: Tensor
    """``[B, T, D]`` [m/s]."""
    points: Tensor
    """Body points in the base frame [m], ``[N, 3]``."""
    point_areas: Tensor
    """``[N]`` [m²]."""
    point_tangents: Tensor
    """``[N, 3]``."""
    point_drives: Tensor
    """``[N]`` int64; -1 on the hull."""
    point_outward: Tensor
    """Unit normal of the hull, outwards, ``[N, 3]``; zero on belts."""
    point_strips: Tensor
    """Width [m] and curvature [1/m] of the surface, ``[N, 2]``, where the ground is soft soil; else zeros."""
    mass: Tensor
    """``[B]`` [kg]."""
    centre_of_mass: Tensor
    """In the base frame [m], ``[B, 3]``."""
    inertia: Tensor
    """About the centre of mass in base axes [kg m²], ``[B, 3, 3]``."""
    friction_factors: Tensor
    """Longitudinal and lateral factor on the ground's friction and, of drives that give way or tyres that slip, the
    compliance of the drives [m/s] and the slip ratio of the tyres [-], ``[B, 2, 3 or 4]``."""
    drive_loads: Tensor
    """Load of each drive beside that of the robot's file, by which drives that give way lose speed, ``[B, D]`` [-]."""
    gravity_tilt: Tensor
    """Tilt of gravity about x and y [rad], ``[B, 2]``."""
    resistance: Tensor
    """Rolling resistance [-], linear [N s/m], quadratic drag [N s²/m²], yield speed of vegetation [m/s], ``[B, 4]``."""
    vegetation: Tensor
    """Height of the vegetation above the ground [m], shaped like the terrain ``[(B,) rows, cols]``."""
    ground_factors: Tensor
    """Divisor of stiffness and damping [-], vegetation drag per area, height and speed [N s/m⁴], and factor on the slip
    regularisation of friction on firm ground [-], ``[B, 3]``."""
    wrench: Tensor
    """Body-frame force and torque per feature of the motion, ``[B, 6, F]``."""
    soil: Tensor | None = None
    """Parameters of soft soil, ``[B, 9]``; None: firm ground."""
    articulation: Articulation | None = None
    """What moves in the body; None if nothing does."""

    @classmethod
    def pose(
        cls,
        terrain: TerrainMap,
        robot: RobotModel,
        controls: Tensor | Controls,
        state: State,
        time_step: float = 0.01,
        soil: Soil | None = None,
    ) -> tuple[Problem, Tensor]:
        """The problem and a mask of the trajectories with finite inputs, ``[B]`` bool.

        Other trajectories are replaced by a robot at rest at the map's origin, because NaN would propagate into the
        gradient of the shared terrain.
        """
        if isinstance(controls, Tensor):
            controls = Controls(controls)
        batch, dtype, device = state.position.shape[0], state.position.dtype, state.position.device
        file = robot.to(dtype, device)
        setup = applied_setup(terrain.to(dtype, device), file)
        terrain, robot, loads = setup.terrain, setup.robot, setup.loads
        drive_speeds = controls.drive_speeds
        values = (state.position, state.rotation, state.velocity, state.angular_velocity, drive_speeds.to(dtype))
        joint_inputs = [getattr(controls, name) for name in _JOINT_INPUTS]
        checked = [t.detach() for t in (*values, *(t for t in joint_inputs if t is not None))]
        finite = torch.stack([torch.isfinite(t).reshape(batch, -1).all(1) for t in checked]).all(0)
        if bool(finite.all()):
            position, rotation, velocity, angular_velocity, speeds = values
        else:
            identity = torch.eye(3, dtype=dtype, device=device)
            neutral = (torch.zeros_like(t) if t is not values[1] else identity.expand_as(t) for t in values)
            position, rotation, velocity, angular_velocity, speeds = (
                torch.where(finite.view(-1, *[1] * (t.ndim - 1)), t, n) for t, n in zip(values, neutral, strict=True)
            )
            controls = _without_invalid(controls, finite)
        centre_of_mass = robot.centre_of_mass.expand(batch, 3)
        offset = (rotation @ centre_of_mass[..., None])[..., 0]
        drift = torch.zeros_like(offset)
        moves = controls.joint_angles is not None or robot.moves_joints or robot.point_grip is not None
        articulation = None
        if moves:
            linear, angular = (rotation.transpose(1, 2) @ torch.stack([velocity, angular_velocity], -1)).unbind(-1)
            articulation = Articulation.of(robot, controls, speeds, linear, angular, time_step)
        if articulation is not None:
            body = BodyMass(robot.mass.expand(batch), centre_of_mass, robot.inertia.expand(batch, 3, 3))
            centre, centre_rate = articulation.centres(articulation.angles[:, :1], articulation.rates[:, :1], body)
            offset = (rotation @ centre[:, 0, :, None])[..., 0]
            drift = (rotation @ centre_rate[:, 0, :, None])[..., 0]
        resistance = (loads.rolling_resistance, loads.linear_drag, loads.quadratic_drag, loads.vegetation_yield)
        vegetation = (terrain.geometric_height - terrain.height).clamp_min(0.0)
        ground_factors = (setup.softness, loads.vegetation_drag, loads.friction_creep)
        factors = [robot.friction_longitudinal, robot.friction_lateral]
        compliance, slip = loads.drive_compliance, loads.tyre_slip
        if compliance is not None or slip is not None:
            factors.append(torch.zeros_like(robot.mass) if compliance is None else compliance.to(dtype))
        if slip is not None:
            factors.append(slip.to(dtype))
        carried = drive_speeds.new_ones(batch, drive_speeds.shape[2], dtype=dtype)
        if compliance is not None:
            carried = drive_loads(file, robot.mass.expand(batch), centre_of_mass)
        problem = cls(
            terrain=terrain,
            centre=position + offset,
            rotation=rotation,
            velocity=velocity + torch.linalg.cross(angular_velocity, offset) + drift,
            angular_velocity=angular_velocity,
            drive_speeds=speeds,
            points=robot.points,
            point_areas=robot.point_areas,
            point_tangents=robot.point_tangents,
            point_drives=robot.point_drives,
            point_outward=_no_normals(robot.points) if robot.point_outward is None else robot.point_outward,
            point_strips=_strips(robot, soil),
            mass=robot.mass.expand(batch),
            centre_of_mass=centre_of_mass,
            inertia=robot.inertia.expand(batch, 3, 3),
            friction_factors=torch.stack([value.expand(batch) for value in factors], dim=-1),
            drive_loads=carried,
            gravity_tilt=loads.gravity_tilt.expand(batch, 2),
            resistance=torch.stack([value.expand(batch) for value in resistance], dim=-1),
            vegetation=vegetation,
            ground_factors=torch.stack([value.expand(batch) for value in ground_factors], dim=-1),
            wrench=loads.wrench.expand(batch, 6, -1),
            soil=None if soil is None else soil.table(position, batch),
            articulation=articulation,
        )
        return problem, finite

    @property
    def batch_size(self) -> int:
        """Number of trajectories."""
        return self.centre.shape[0]

    @property
    def steps(self) -> int:
        """Number of time steps."""
        return self.drive_speeds.shape[1]

    @property
    def point_faces(self) -> Tensor:
        """Outward unit normals of hull and belts in the base frame, ``[N, 3]``."""
        # A belt runs along its tangent, across the y axis of the part that carries it.
        x, _, z = self.point_tangents.unbind(-1)
        return self.point_outward + torch.stack([-z, torch.zeros_like(x), x], dim=-1)

    @property
    def body_mass(self) -> BodyMass:
        """Mass properties at the rest angles of the joints."""
        return BodyMass(self.mass, self.centre_of_mass, self.inertia)


@dataclass(frozen=True)
class Motion:
    """Result of a backend; index 0 along time is the start state."""

    centre: Tensor
    """``[B, T + 1, 3]``."""
    rotation: Tensor
    """``[B, T + 1, 3, 3]``."""
    velocity: Tensor
    """``[B, T + 1, 3]``."""
    angular_velocity: Tensor
    """``[B, T + 1, 3]``."""
    normal_forces: Tensor | None = None
    """``[B, T, N]``."""
    tangential_forces: Tensor | None = None
    """``[B, T, N, 3]``."""
    forces: Tensor | None = None
    """``[B, T, N, 3]``."""
    contact: ContactSummary | None = None
    """Sums of the forces, if the backend computed them."""
    angles: Tensor | None = None
    """Of the joints, ``[B, T + 1, J]``, of a robot in which something moves."""
    rates: Tensor | None = None
    """``[B, T + 1, J]``."""
    belts: Tensor | None = None
    """Surface speeds of the drives, ``[B, T + 1, D]``."""


def _strips(robot: RobotModel, soil: Soil | None) -> Tensor:
    """Width and curvature at each point ``[N, 2]``."""
    if soil is None:
        return _zeros.get((robot.points,), lambda: torch.zeros_like(robot.points[:, :2]), values="strips")
    if robot.point_widths is None or robot.point_curvatures is None:
        raise ValueError(
            f"soil: got robot {robot.name!r} without point_widths and point_curvatures, expected one of load_robot"
        )
    return torch.stack([robot.point_widths, robot.point_curvatures], dim=-1)


def _no_normals(points: Tensor) -> Tensor:
    return _zeros.get((points,), lambda: torch.zeros_like(points), values="normals")


_zeros: IdentityCache[Tensor] = IdentityCache()
"""The same tensors for the same points, so that what follows from them is found again."""


_JOINT_INPUTS = ("joint_angles", "joint_rates", "start_angles", "start_rates")


def _without_invalid(controls: Controls, finite: Tensor) -> Controls:
    """The controls with the joints of invalid trajectories at zero."""
    changed = {}
    for name in _JOINT_INPUTS:
        value = getattr(controls, name)
        if value is not None:
            chosen = finite.view(-1, *[1] * (value.ndim - 1))
            changed[name] = torch.where(chosen, value, torch.zeros_like(value))
    return replace(controls, **changed)
