"""Contact: forces between body points and ground, with their velocity gains for an implicit integrator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.physics.lookup import Ground
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.rotation import cross
from monoforce_ros.physics.soil_contact import SoilContact

STEEPEST_SOIL, RIGID_SLOPE = math.cos(math.radians(45.0)), math.cos(math.radians(60.0))
"""Vertical components of the normal between which ground goes from soil to something rigid: soil does not stand
steeper than about 45°, its angle of repose; beyond 60° it is a trunk, a wall or a kerb."""
RIGID_PER_MASS, LEAST_RIGID = 1.0, 50.0
"""Factor on stiffness and damping where a face of the hull meets rigid ground head-on, for each kilogram of the robot,
and the smallest one. A robot at 1 m/s that pushes with its full traction (0.5 J per kilogram, and 0.08 J per cm) stops
within about 1 cm at a contact 5 cm wide and 10 cm high if the stiffness is 2e6 N/m³ per kilogram, and that of firm soil
is 2e6 N/m³; on soil's own a robot of 50 kg would need 12 cm, more than a post is thick."""


SMALLEST_SLIP = 1e-6
"""Keeps a quotient finite without slip [m/s]."""
FLAT_TREAD = 0.9
"""Cosine of the angle to the ground within which a belt's surface moves along it at the belt's full speed (26°): tyres
and tracks lie flat in their contact. On the circle, a wheel that sinks by 8 mm would roll 1 % slower than its rim, and
one that is sampled every 30° 3.4 % slower, because its two lowest samples are 15° from the bottom."""


def tread(belt: Tensor, along: Tensor) -> Tensor:
    """Speed of the surface of a flattened belt along the ground ``[B, N]`` [m/s].

    Args:
        belt: its velocity on the circle, ``[B, 3, N]`` [m/s].
        along: the ground's direction along the wheel, ``[B, 3, N]``.
    """
    fastest = torch.sqrt((belt * belt).sum(1) + 1e-12)
    return ((belt * along).sum(1) / FLAT_TREAD).clamp(-fastest, fastest)


def held_slip(slip: Tensor, giving: Tensor, square: float | Tensor) -> Tensor:
    """Share of the longitudinal slip that is left when drives give way under their load, ``[B, N]``.

    A speed controller without integral action loses speed in proportion to its torque. A drive that loses ``c`` when
    it pulls with its wheel's load turns slower by ``c f / N``, so that ``s = s_0 - c μ s / sqrt(s² + s_y² + ε²)`` with
    the regularised Coulomb law. One step of Halley's method, from the larger one of the solutions for small and for
    large slip, both of which are too small: forces are within 0.2 % of the limit of friction for a loss of 0.2 m/s,
    and within 1.5 % for 1 m/s.

    Args:
        slip: longitudinal and lateral slip at the commanded speed, ``[B, 2, N]`` [m/s].
        giving: speed ``c μ`` that a drive loses at the limit of friction, ``[B, N]`` [m/s].
        square: of the slip ε at which friction is no longer proportional to slip, a number or ``[B, N]`` [m²/s²].
    """
    along, across = slip[:, 0].abs(), slip[:, 1] * slip[:, 1] + square
    least = torch.sqrt(across)
    share = torch.maximum(least / (least + giving), 1.0 - giving / (along + SMALLEST_SLIP))
    per_slip = torch.rsqrt((share * along) ** 2 + across)
    given = giving * per_slip
    excess = share + given * share - 1.0
    slope = 1.0 + given * across * per_slip * per_slip
    # Half of the slope's own slope, negative.
    bend = 1.5 * given * across * share * along * along * per_slip**4
    return share - excess * slope / (slope * slope + excess * bend)


def steepness(normal: Tensor) -> Tensor:
    """From 0 where soil stands to 1 where ground is rigid, ``[B, N]``, by the ground's normal ``[B, 3, N]``."""
    return ((STEEPEST_SOIL - normal[:, 2]) / (STEEPEST_SOIL - RIGID_SLOPE)).clamp(0.0, 1.0)


def against_hull(outward: Tensor, normal: Tensor, masses: Tensor) -> tuple[Tensor, Tensor]:
    """How steep ground pushes on faces of the hull: the direction ``[B, 3, N]`` and a factor on it ``[B, N]``.

    Ground pushes a face inwards. A map holds a thin post as a ridge, whose far side would push the face outwards once
    it has passed the ridge; that side's normal is mirrored at the face. Belts and soil keep normal and stiffness,
    others have the stiffness times the factor.

    Args:
        outward: unit normal of the hull in terrain axes, zero on belts, ``[B, 3, N]``.
        normal: unit normal of the ground, ``[B, 3, N]``.
        masses: of the robots, ``[B]`` [kg].
    """
    head_on = (outward * normal).sum(1)
    steep = steepness(normal)
    mirrored = normal - (2.0 * steep * head_on.clamp_min(0.0))[:, None] * outward
    mirrored = mirrored * torch.rsqrt((mirrored * mirrored).sum(1, keepdim=True) + 1e-12)
    # Where nothing is mirrored the normal stays as it is, to the last bit.
    direction = torch.where((head_on > 0.0)[:, None], mirrored, normal)
    factor = (RIGID_PER_MASS * masses).clamp_min(LEAST_RIGID)[:, None]
    return direction, 1.0 + (factor - 1.0) * steep * head_on.abs()


@dataclass(frozen=True)
class Contact:
    """Contact forces along three directions per point: normal, longitudinal, lateral.

    With the point's velocity ``u`` along these directions after a step, the force is ``force - gain * (u - u_now)``.
    The gains, the rates at which the forces decrease with velocity, keep the integrator stable at any stiffness.
    """

    directions: Tensor
    """Unit vectors in terrain axes, ``[B, 3 (axis), 3 (direction), N]``."""
    force: Tensor
    """``[B, 3 (direction), N]`` [N]."""
    gain: Tensor
    """``[B, 3 (direction), N]`` [N s/m], never negative."""
    grip_force: Tensor
    """Friction alone, which also acts on the belt: longitudinal, lateral, ``[B, 2, N]`` [N]."""
    grip_gain: Tensor
    """Its gain, ``[B, 2, N]`` [N s/m]."""

    @property
    def vectors(self) -> Tensor:
        """Total force on each point in terrain axes, ``[B, 3, N]`` [N]."""
        return (self.directions * self.force[:, None]).sum(2)


def contact(
    ground: Ground,
    points: Tensor,
    velocities: Tensor,
    belt_velocities: Tensor,
    outward: Tensor,
    lateral: Tensor,
    areas: Tensor,
    masses: Tensor,
    weights: Tensor,
    friction_factors: Tensor,
    drive_loads: Tensor,
    ground_factors: Tensor,
    rolling_resistance: Tensor,
    yield_speed: Tensor,
    options: PhysicsOptions,
    step_time: float | None = None,
    grip: Tensor | None = None,
    soil: SoilContact | None = None,
) -> Contact:
    """Forces on body points (paper III-C and III-D).

    The normal force is a spring and a damper at the penetration, per area, and never pulls. Tangential forces are
    regularised Coulomb friction with a friction ellipse, ``-N diag(μ) s / sqrt(|s|² + ε²)`` at slip ``s``, where tyres
    slip with ε² larger by the square of their slip ratio times their rolling speed, or the paper's
    ``μ m g (σ(-s) - ½)``. Faces of the hull meet steep ground stiffly, see :func:`against_hull`. On soft soil
    pressure and shear are those of :class:`SoilContact`.

    Args:
        ground: terrain under the points.
        points: positions, ``[B, 3, N]`` [m].
        velocities: velocities of the body at the points, ``[B, 3, N]`` [m/s].
        belt_velocities: velocities of the belt surface relative to the body, ``[B, 3, N]`` [m/s].
        outward: unit normal of the hull at the points, zero on belts, ``[B, 3, N]``.
        lateral: the robot's y axis, ``[B, 3]``, or that of each point's wheel, ``[B, 3, N]``.
        areas: area of each point, ``[N]`` [m²].
        masses: of the robots, ``[B]`` [kg].
        weights: share of the robot's weight m g per point, ``[B, N]`` or ``[N]`` [N] (``sigmoid`` only).
        friction_factors: longitudinal and lateral factor on the ground's friction, the compliance of drives that give
            way, see :func:`held_slip`, and the slip ratio of tyres, which soft soil replaces; ``[B, 2, 3 or 4]``.
        drive_loads: load of each point's drive beside that of the robot's file, 0 on the hull, which has no drive that
            could give way, ``[B, N]``.
        ground_factors: divisor of the ground's stiffness and damping [-], force of vegetation per area, height and
            speed [N s/m⁴], and factor on the slip regularisation of friction on firm ground [-], ``[B, 3]``.
        rolling_resistance: force against rolling as a fraction of the load, ``[B]``.
        yield_speed: speed at which bending force and viscous drag of vegetation are equal, ``[B]`` [m/s].
        options: contact laws.
        step_time: time over which the spring follows the motion [s] (default: the time step); 0 gives the
            instantaneous force.
        grip: 0 for points of wheels that roll freely, which have no longitudinal friction, else 1, ``[N]``; None: 1.
        soil: soft soil where ground is not too steep for it; None: firm ground.
    """
    normal = ground.normal
    if options.normal_force == "vertical":
        normal = torch.zeros_like(normal)
        normal[:, 2] = 1.0
    depth = (ground.height - points[:, 2]) * normal[:, 2]
    touching = depth > 0
    touching_areas = areas * touching
    upward = normal
    normal, rigid = against_hull(outward, normal, masses)
    if soil is not None:
        soft = 1.0 - steepness(upward)
        normal, facing = soil.direction(upward, normal, soft)
    lateral = lateral if lateral.ndim == 3 else lateral[..., None]
    across = lateral - (lateral * normal).sum(1, keepdim=True) * normal
    across = across * torch.rsqrt((across * across).sum(1, keepdim=True) + 1e-12)
    directions = torch.stack([normal, cross(across, normal), across], dim=2)
    point_velocity = (directions * velocities[:, :, None]).sum(1)
    belt_speeds = torch.stack([tread(belt_velocities, directions[:, :, 1]), (across * belt_velocities).sum(1)], dim=1)
    slip = point_velocity[:, 1:] + belt_speeds

    softness, drag, creep = ground_factors[..., None].unbind(1)
    stiffness, ground_damping = ground.stiffness / softness * rigid, ground.damping / softness * rigid
    # Approach of the ground is motion against its normal.
    spring = stiffness * depth
    load = touching_areas * (spring - ground_damping * point_velocity[:, 0]).clamp_min(0.0)
    # The spring force follows the motion within the step, which acts as additional damping (linearly implicit Euler).
    damping = ground_damping + (options.time_step if step_time is None else step_time) * stiffness
    pressing = touching_areas * (spring - damping * point_velocity[:, 0]).clamp_min(0.0)
    normal_gain = touching_areas * damping * (pressing > 0)

    friction = ground.friction[:, None] * friction_factors[:, :2, None]
    if grip is not None:
        held = torch.stack([grip, torch.ones_like(grip)])
        slip, friction = slip * held, friction * held
    slip_square: float | Tensor = options.slip_regularisation**2
    if soil is None:
        # Soft soil has its own slip at which its shear builds up.
        slip_square = slip_square * creep**2
    if friction_factors.shape[1] == 4 and soil is None:
        # The hull does not roll; the tread of a free wheel moves as fast as the robot.
        rolling = belt_speeds[:, 0] if grip is None else grip * belt_speeds[:, 0] + (1.0 - grip) * point_velocity[:, 1]
        slip_square = slip_square + (friction_factors[:, 3, None] * rolling) ** 2
    kept = None
    if friction_factors.shape[1] >= 3:
        giving = friction_factors[:, 2, None] * drive_loads * friction[:, 0]
        kept = held_slip(slip, giving, slip_square)
        slip = torch.stack([kept * slip[:, 0], slip[:, 1]], dim=1)
    if soil is not None:
        slip_speed = torch.sqrt((slip * slip).sum(1) + options.slip_regularisation**2)
        soft_ground = soil.pressure(
            depth, -point_velocity[:, 0], slip, (cross(across, upward) * velocities).sum(1),
            point_velocity[:, 1] if grip is None else grip * point_velocity[:, 1],
            (directions[:, :, 1] * belt_velocities).sum(1), -(upward * belt_velocities).sum(1), softness,
            options.time_step if step_time is None else step_time, options.slip_regularisation,
        )  # fmt: skip
        yielding = touching_areas * soft * facing
        held_by = ground.friction * (1.0 - soft) * load + yielding * soft_ground.shear
        load = (1.0 - soft) * load + yielding * soft_ground.load
        pressing = (1.0 - soft) * pressing + yielding * soft_ground.pressing
        normal_gain = (1.0 - soft) * normal_gain + yielding * soft_ground.gain
        factors = friction_factors[:, :2, None] if grip is None else friction_factors[:, :2, None] * held
        tangential_gain = factors * (held_by / slip_speed)[:, None]
        tangential_force = -tangential_gain * slip
    elif options.tangential_force == "coulomb":
        per_speed = load * torch.rsqrt((slip * slip).sum(1) + slip_square)
        tangential_gain = friction * per_speed[:, None]
        tangential_force = -tangential_gain * slip
    elif options.tangential_force == "sigmoid":
        scale = friction * (weights * touching)[:, None]
        activation = torch.sigmoid(-slip)
        tangential_force = scale * (activation - 0.5)
        tangential_gain = scale * activation * (1.0 - activation)
    else:
        tangential_force = torch.zeros_like(slip)
        tangential_gain = tangential_force
    if kept is not None:
        tangential_gain = torch.stack([kept * tangential_gain[:, 0], tangential_gain[:, 1]], dim=1)
    # Rolling resistance and vegetation depend on the velocity of the body, not on slip.
    along, across = point_velocity[:, 1], point_velocity[:, 2]
    inverse_speed = torch.rsqrt(along * along + across * across + options.slip_regularisation**2)
    vegetation = touching_areas * (drag * ground.vegetation) * (1.0 + yield_speed[:, None] * inverse_speed)
    rolling = rolling_resistance[:, None] * load * torch.rsqrt(along**2 + options.slip_regularisation**2)
    resistance = torch.stack([rolling + vegetation, vegetation], dim=1)
    return Contact(
        directions=directions,
        force=torch.cat([pressing[:, None], tangential_force - resistance * point_velocity[:, 1:]], dim=1),
        gain=torch.cat([normal_gain[:, None], tangential_gain + resistance], dim=1),
        grip_force=tangential_force,
        grip_gain=tangential_gain,
    )
