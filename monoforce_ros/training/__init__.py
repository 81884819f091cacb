"""Training: terrain that explains how the robot moved, and encoders that learn to see it."""

from monoforce_ros.training.terrain_fit import FitSettings, TerrainFit, fit_terrain
from monoforce_ros.training.visible import split_maps

__all__ = [
    "FitSettings",
    "TerrainFit",
    "fit_terrain",
    "split_maps",
]
