"""Rotations as tensors: exponential map, cross products, angle between rotations."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.core import small_rotation


def exponential_map(vector: Tensor) -> Tensor:
    """Rotation matrices ``[..., 3, 3]`` of rotation vectors ``[..., 3]`` [rad] (Rodrigues' formula)."""
    square = (vector * vector).sum(-1, keepdim=True)[..., None]
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = torch.sqrt(safe)
    # Taylor series near zero, where the quotients lose precision and have no gradient.
    first = torch.where(small, 1.0 - square / 6.0, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - square / 24.0, (1.0 - torch.cos(angle)) / safe)
    cross = cross_matrix(vector)
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + first * cross + second * (cross @ cross)


def cross_matrix(vector: Tensor) -> Tensor:
    """Skew-symmetric matrices ``[..., 3, 3]`` of the cross product with ``[..., 3]`` from the left."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def rotation_angle(first: Tensor, second: Tensor) -> Tensor:
    """Angle [rad] between rotations ``[..., 3, 3]`` (paper eq. 6), accurate also for small angles."""
    relative = first.transpose(-1, -2) @ second
    sine = torch.stack(small_rotation(relative), dim=-1).norm(dim=-1)
    cosine = 0.5 * (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(sine, cosine)


def cross(first: Tensor, second: Tensor) -> Tensor:
    """Cross product along dimension 1, by components: here many times faster than ``torch.cross``."""
    a, b = first.unbind(1), second.unbind(1)
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], dim=1)
