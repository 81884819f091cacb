"""Mass properties of a rigid body with a point mass added or removed."""

from __future__ import annotations

import torch
from torch import Tensor


def add_point_mass(
    mass: Tensor, centre: Tensor, inertia: Tensor, added: Tensor, place: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mass, centre of mass and inertia of a body with a point mass added to it (removed, if negative).

    Args:
        mass: ``[]`` or ``[B]`` [kg].
        centre: centre of mass ``[..., 3]`` [m].
        inertia: inertia about that centre ``[..., 3, 3]`` [kg m²].
        added: ``[]`` or ``[B]`` [kg].
        place: position of the point mass ``[..., 3]`` [m].

    Returns:
        mass, centre and inertia about the new centre, by the parallel-axis theorem.
    """
    total = mass + added
    arm = place - centre
    moved = centre + (added / total)[..., None] * arm
    # Two bodies about their common centre: the reduced mass at the distance between them.
    reduced = (mass * added / total)[..., None, None]
    square = (arm * arm).sum(-1)[..., None, None] * torch.eye(3, dtype=arm.dtype, device=arm.device)
    return total, moved, inertia + reduced * (square - arm[..., :, None] * arm[..., None, :])
