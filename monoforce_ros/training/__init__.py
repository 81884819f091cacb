"""Training: terrain fitted to recorded motion, and the terrain encoders trained on it."""

from monoforce_ros.training.terrain_fit import FitSettings, TerrainFit, fit_terrain, traced_heights
from monoforce_ros.training.visible import split_maps

__all__ = [
    "FitSettings",
    "TerrainFit",
    "fit_terrain",
    "split_maps",
    "traced_heights",
]
