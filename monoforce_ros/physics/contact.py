"""Contact: forces between body points and ground, with what an implicit integrator needs to know of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.physics.lookup import Ground
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.rotation import cross


@dataclass(frozen=True)
class Contact:
    """Contact forces along three directions per point: normal, longitudinal, lateral.

    With the point's velocity ``u`` along these directions after a step, the force is ``force - gain * (u - u_now)``:
    the gains are how fast the forces give way, by which the integrator stays stable however stiff the ground is.
    """

    directions: Tensor
    """Unit vectors in terrain axes, ``[B, 3 (axis), 3 (direction), N]``."""
    force: Tensor
    """``[B, 3 (direction), N]`` [N]."""
    gain: Tensor
    """``[B, 3 (direction), N]`` [N s/m], never negative."""

    @property
    def vectors(self) -> Tensor:
        """Whole force on each point in terrain axes, ``[B, 3, N]`` [N]."""
        return (self.directions * self.force[:, None]).sum(2)


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
    yield_speed: Tensor,
    options: PhysicsOptions,
    step_time: float | None = None,
) -> Contact:
    """Forces on body points (paper III-C and III-D).

    The normal force is a spring and a damper at the penetration, per area, and never pulls. Tangential forces are
    regularised Coulomb friction with a friction ellipse, ``-N diag(μ) s / sqrt(|s|² + ε²)`` at slip ``s``, or the
    paper's ``μ m g (σ(-s) - ½)``.

    Args:
        ground: terrain under the points.
        points: ``[B, 3, N]`` [m].
        velocities: of the body at the points, ``[B, 3, N]`` [m/s].
        belt_velocities: of the moving surface relative to the body, ``[B, 3, N]`` [m/s].
        lateral: the robot's y axis, ``[B, 3]``.
        areas: ``[N]`` [m²].
        weights: share m g of each point in the robot's weight, ``[B, N]`` or ``[N]`` [N] (``sigmoid`` only).
        friction_factors: longitudinal and lateral factor on the ground's friction, ``[B, 2]``.
        rolling_resistance: force against rolling as a part of the load, ``[B]``.
        yield_speed: at which vegetation holds as much by being bent as by being moved, ``[B]`` [m/s].
        options: which laws.
        step_time: over which the spring follows the motion [s]; the options' time step unless given, 0 for the force
            at this very moment.
    """
    normal = ground.normal
    if options.normal_force == "vertical":
        normal = torch.zeros_like(normal)
        normal[:, 2] = 1.0
    depth = (ground.height - points[:, 2]) * normal[:, 2]
    touching = depth > 0
    touching_areas = areas * touching
    lateral = lateral[..., None]
    across = lateral - (lateral * normal).sum(1, keepdim=True) * normal
    across = across * torch.rsqrt((across * across).sum(1, keepdim=True) + 1e-12)
    directions = torch.stack([normal, cross(across, normal), across], dim=2)
    moved = (directions * velocities[:, :, None]).sum(1)
    slip = moved[:, 1:] + (directions[:, :, 1:] * belt_velocities[:, :, None]).sum(1)

    # Pressing on the ground is moving against its normal.
    spring = ground.stiffness * depth
    load = touching_areas * (spring - ground.damping * moved[:, 0]).clamp_min(0.0)
    # Within the step the spring follows the motion: it acts as further damping (linearly implicit Euler).
    damping = ground.damping + (options.time_step if step_time is None else step_time) * ground.stiffness
    pressing = touching_areas * (spring - damping * moved[:, 0]).clamp_min(0.0)
    normal_gain = touching_areas * damping * (pressing > 0)

    friction = ground.friction[:, None] * friction_factors[..., None]
    if options.tangential_force == "coulomb":
        per_speed = load * torch.rsqrt((slip * slip).sum(1) + options.slip_regularisation**2)
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
    # What holds the body back, rather than the belt: rolling resistance and vegetation.
    along, across = moved[:, 1], moved[:, 2]
    pace = torch.rsqrt(along * along + across * across + options.slip_regularisation**2)
    brushing = touching_areas * ground.drag * (1.0 + yield_speed[:, None] * pace)
    rolling = rolling_resistance[:, None] * load * torch.rsqrt(moved[:, 1] ** 2 + options.slip_regularisation**2)
    held = torch.stack([rolling + brushing, brushing], dim=1)
    return Contact(
        directions=directions,
        force=torch.cat([pressing[:, None], tangential_force - held * moved[:, 1:]], dim=1),
        gain=torch.cat([normal_gain[:, None], tangential_gain + held], dim=1),
    )
