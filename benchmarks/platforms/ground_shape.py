"""Ground: heights on a grid, and the map of them that a user would have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from monoforce_ros.terrain import Grid, TerrainMap, save_terrain

RESOLUTION = 0.1
"""Of the height field [m]."""
HALF_SIZE = 22.0
"""Of the square ground [m]; drives turn back at 9 m."""


@dataclass(frozen=True)
class Ground:
    """Heights ``[n, n]`` [m], ``[row = y, column = x]``, centred at the origin; None where level."""

    heights: np.ndarray | None = None

    @property
    def coordinates(self) -> np.ndarray:
        """Of the rows and columns [m]."""
        count = round(2 * HALF_SIZE / RESOLUTION) + 1
        return (np.arange(count) - (count - 1) / 2) * RESOLUTION

    def height(self, points: np.ndarray) -> np.ndarray:
        """Height of the nearest grid points to ``[..., 2]`` [m]."""
        if self.heights is None:
            return np.zeros(points.shape[:-1])
        index = np.clip(np.rint((points + HALF_SIZE) / RESOLUTION).astype(int), 0, len(self.heights) - 1)
        return self.heights[index[..., 1], index[..., 0]]


def draw_hills(seed: int, friction: float) -> Ground:
    """Bare hills: waves of 5 to 16 m with slopes of 3 to 9° RMS, and bumps of up to 1 cm.

    Args:
        seed: seed of the draw.
        friction: of the robot; slopes are kept within its grip.
    """
    random = np.random.default_rng([seed, 4])
    axis = Ground().coordinates
    x, y = np.meshgrid(axis, axis)
    heights = np.zeros_like(x)
    for _ in range(8):
        number = 2 * math.pi / random.uniform(5.0, 16.0)
        direction, phase = random.uniform(0.0, 2 * math.pi, 2)
        heights += np.cos(number * (np.cos(direction) * x + np.sin(direction) * y) + phase) / number
    slopes = np.hypot(*np.gradient(heights, RESOLUTION))
    slope = min(math.radians(random.uniform(3.0, 9.0)), 0.3 * friction)
    heights *= math.tan(slope) / np.sqrt(np.mean(slopes**2))
    bumps = gaussian_filter(random.standard_normal(x.shape), 2.5)
    heights += random.uniform(0.0, 0.01) * bumps / np.abs(bumps).max()
    return Ground(heights)


def write_map(ground: Ground, start: np.ndarray, seed: int, file: Path) -> Path:
    """Write the ground as a user's map in the odometry frame, for ``diagnose --terrain FILE``.

    Like a map from a good lidar: every cell is wrong by 1 cm RMS, correlated over 0.3 m.

    Args:
        ground: hills.
        start: position ``[3]`` at which the odometry frame lies in the world [m].
        seed: seed of the errors.
        file: the map.
    """
    if ground.heights is None:
        raise ValueError("ground: got level ground, expected heights")
    random = np.random.default_rng([seed, 5])
    noise = gaussian_filter(random.standard_normal(ground.heights.shape), 1.5)
    heights = torch.as_tensor(ground.heights - start[2] + 0.01 * noise / noise.std(), dtype=torch.float32)
    count = len(ground.heights)
    grid = Grid(count, count, RESOLUTION, (float(-HALF_SIZE - start[0]), float(-HALF_SIZE - start[1])))
    return save_terrain(file, TerrainMap.from_height(heights, grid))
