"""Accumulation: several lidar sweeps of a recording as one cloud in one frame."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from monoforce_ros.core import transform_points

VOXEL = 0.1
"""Edge of the cubes in which neighbouring returns are counted [m]."""
_LARGEST_INDEX = 1 << 20


def accumulate(
    sweeps: Iterable[tuple[np.ndarray, np.ndarray]], *, maximum_range: float = 12.0, minimum_returns: int = 3
) -> np.ndarray:
    """Join sweeps, each from its own pose, and remove isolated returns.

    A return is isolated if its cube and the 26 around it contain fewer than ``minimum_returns`` of all sweeps together:
    dust, rain, or a beam split by an edge.

    Args:
        sweeps: returns ``[n, 3]`` [m] in the base frame, without those from the robot's body, and the pose ``[4, 4]``
            of the base frame in the common frame, in which z points up.
        maximum_range: largest distance of returns from the robot [m]; attitude errors displace distant ones.
        minimum_returns: smallest number of returns in the neighbourhood of a return, including itself.

    Returns:
        ``[m, 3]`` [m], float64.
    """
    joined = []
    for points, pose in sweeps:
        points = np.asarray(points, np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        points = points[np.linalg.norm(points, axis=1) < maximum_range]
        joined.append(transform_points(np.asarray(pose, np.float64), points))
    cloud = np.concatenate(joined) if joined else np.zeros((0, 3))
    if not len(cloud):
        return cloud
    return cloud[count_neighbours(cloud, VOXEL) >= minimum_returns]


def count_neighbours(points: np.ndarray, voxel: float) -> np.ndarray:
    """Number of points in the cube of each point and in the 26 around it, including itself, ``[n]``."""
    index = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64) + 1
    if (index >= _LARGEST_INDEX).any():
        raise ValueError(f"points: spread over {np.ptp(points, axis=0).max():.0f} m, too far for voxels of {voxel} m")
    keys, inverse, counts = np.unique(_key(index), return_inverse=True, return_counts=True)
    cubes = np.stack([keys >> 40, (keys >> 20) & (_LARGEST_INDEX - 1), keys & (_LARGEST_INDEX - 1)], axis=1)
    around = np.zeros(len(keys), np.int64)
    for offset in np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3):
        wanted = _key(cubes + offset)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        around += np.where(keys[place] == wanted, counts[place], 0)
    return around[inverse]


def _key(index: np.ndarray) -> np.ndarray:
    return (index[:, 0] << 40) | (index[:, 1] << 20) | index[:, 2]
