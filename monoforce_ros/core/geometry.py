"""Rotations, quaternions and rigid transforms as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Quaternions ``[..., 4]`` (x, y, z, w) of rotations ``[..., 3, 3]``; the component of largest size is positive.

    The matrices must be rotations (Shepperd 1978). SciPy orthogonalises each one first, which for a few thousand
    predicted poses takes longer than all other processing.
    """
    diagonal = np.einsum("...ii->...i", rotations)
    trace = diagonal.sum(axis=-1, keepdims=True)
    squares = np.concatenate([1.0 - trace + 2.0 * diagonal, 1.0 + trace], axis=-1)
    largest = squares.argmax(axis=-1)
    antisymmetric = rotations - np.swapaxes(rotations, -1, -2)
    symmetric = rotations + np.swapaxes(rotations, -1, -2)
    # Four times the products of all pairs of components: row k holds those with component k.
    products = np.empty((*rotations.shape[:-2], 4, 4))
    products[..., :3, :3] = symmetric
    products[..., 3, :3] = products[..., :3, 3] = np.stack(
        [antisymmetric[..., 2, 1], antisymmetric[..., 0, 2], antisymmetric[..., 1, 0]], axis=-1
    )
    np.einsum("...ii->...i", products)[...] = squares
    found = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def homogeneous(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """``[4, 4]`` transform of a rotation ``[3, 3]`` and a translation ``[3]``."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def pose_matrix(values: Sequence[float]) -> np.ndarray:
    """``[4, 4]`` transform of x, y, z [m] and roll, pitch, yaw [rad] about fixed axes, as in URDF."""
    if len(values) != 6:
        raise ValueError(f"pose: got {len(values)} numbers, expected x, y, z, roll, pitch, yaw")
    return homogeneous(Rotation.from_euler("xyz", values[3:]).as_matrix(), np.asarray(values[:3], float))


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points ``[..., 3]`` transformed by a homogeneous transform ``[4, 4]``."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def wrap_angle(angle: np.ndarray | float) -> np.ndarray:
    """Angles wrapped to -π … π [rad]."""
    return np.angle(np.exp(1j * np.asarray(angle)))


def small_rotation(relative: Any) -> tuple[Any, Any, Any]:
    """Components x, y, z of the rotation vectors of small rotations ``[..., 3, 3]``, arrays or tensors [rad].

    Half the antisymmetric part: exact to third order in the angle, and smooth at zero, unlike the logarithm.
    """
    return (
        0.5 * (relative[..., 2, 1] - relative[..., 1, 2]),
        0.5 * (relative[..., 0, 2] - relative[..., 2, 0]),
        0.5 * (relative[..., 1, 0] - relative[..., 0, 1]),
    )
