"""Training: terrain fitted to recorded motion, and the terrain encoders trained on it."""

from monoforce_ros.training.terrain_fit import FitSettings, TerrainFit, fit_terrain
from monoforce_ros.training.visible import split_maps

__all__ = [
    "FitSettings",
    "TerrainFit",
    "fit_terrain",
    "split_maps",
]
