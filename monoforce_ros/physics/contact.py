"""Contact: forces between body points and ground, with what an implicit integrator needs to know of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.physics.lookup import Ground
from monoforce_ros.physics.options import PhysicsOptions


@dataclass(frozen=True)
class Contact:
    """Contact forces along three directions per point: normal, longitudinal, lateral.

    With the point's velocity ``u`` along these directions after a step, the force is ``force - gain * (u - u_now)``:
    the gains are how fast the forces give way, by which the integrator stays stable however stiff the ground is.
    """

    directions: Tensor
    """Unit vectors in terrain axes, ``[B, N, 3 (direction), 3 (axis)]``."""
    force: Tensor
    """``[B, N, 3]`` [N]."""
    gain: Tensor
    """``[B, N, 3]`` [N s/m], never negative."""


def contact(
    ground: Ground,
    points: Tensor,
    velocities: Tensor,
    belt_velocities: Tensor,
    lateral: Tensor,
    areas: Tensor,
    weights: Tensor,
    friction_factors: Tensor,
    rolling_resistance: Tensor,
    options: PhysicsOptions,
    step_time: float | None = None,
) -> Contact:
    """Forces on body points (paper III-C and III-D).

    The normal force is a spring and a damper at the penetration, per area, and never pulls. Tangential forces are
    regularised Coulomb friction with a friction ellipse, ``-N diag(μ) s / sqrt(|s|² + ε²)`` at slip ``s``, or the
    paper's ``μ m g (σ(-s) - ½)``.

    Args:
        ground: terrain under the points.
        points: ``[B, N, 3]`` [m].
        velocities: of the body at the points, ``[B, N, 3]`` [m/s].
        belt_velocities: of the moving surface relative to the body, ``[B, N, 3]`` [m/s].
        lateral: the robot's y axis, ``[B, 1, 3]``.
        areas: ``[N]`` [m²].
        weights: share m g of each point in the robot's weight, ``[B, N]`` or ``[N]`` [N] (``sigmoid`` only).
        friction_factors: longitudinal and lateral factor on the ground's friction, ``[B, 1, 2]``.
        rolling_resistance: force against rolling as a part of the load, ``[B, 1]``.
        options: which laws.
        step_time: over which the spring follows the motion [s]; the options' time step unless given, 0 for the force
            at this very moment.
    """
    vertical = options.normal_force == "vertical"
    normal = torch.zeros_like(ground.normal) if vertical else ground.normal
    if vertical:
        normal[..., 2] = 1.0
    depth = (ground.height - points[..., 2]) * normal[..., 2]
    touching = depth > 0
    approach = -(velocities * normal).sum(-1)
    spring = ground.stiffness * depth
    load = areas * (spring + ground.damping * approach).clamp_min(0.0) * touching
    # Within the step the spring follows the motion: it acts as further damping (linearly implicit Euler).
    damping = ground.damping + (options.time_step if step_time is None else step_time) * ground.stiffness
    pressing = areas * (spring + damping * approach).clamp_min(0.0) * touching
    normal_gain = areas * damping * (pressing > 0)

    across = lateral - (lateral * normal).sum(-1, keepdim=True) * normal
    across = across * torch.rsqrt((across * across).sum(-1, keepdim=True) + 1e-12)
    along = torch.linalg.cross(across, normal)
    tangential = torch.stack([along, across], dim=2)
    moved = (tangential * velocities[:, :, None]).sum(-1)
    slip = moved + (tangential * belt_velocities[:, :, None]).sum(-1)
    friction = ground.friction[..., None] * friction_factors
    if options.tangential_force == "coulomb":
        speed = torch.sqrt((slip * slip).sum(-1, keepdim=True) + options.slip_regularisation**2)
        tangential_gain = friction * (load[..., None] / speed)
        tangential_force = -tangential_gain * slip
    elif options.tangential_force == "sigmoid":
        scale = friction * (weights * touching)[..., None]
        activation = torch.sigmoid(-slip)
        tangential_force = scale * (activation - 0.5)
        tangential_gain = scale * activation * (1.0 - activation)
    else:
        tangential_force = torch.zeros_like(slip)
        tangential_gain = tangential_force
    # What holds the body back, rather than the belt: rolling resistance and vegetation.
    held = rolling_resistance * load / torch.sqrt(moved[..., 0] ** 2 + options.slip_regularisation**2)
    held = torch.stack([held, torch.zeros_like(held)], dim=-1) + (areas * ground.drag * touching)[..., None]
    tangential_force = tangential_force - held * moved
    tangential_gain = tangential_gain + held
    return Contact(
        directions=torch.cat([normal[:, :, None], tangential], dim=2),
        force=torch.cat([pressing[..., None], tangential_force], dim=-1),
        gain=torch.cat([normal_gain[..., None], tangential_gain], dim=-1),
    )
