"""Terrain maps: heights and material of the ground on a grid, their construction from lidar, and their files."""

from monoforce_ros.terrain.accumulation import accumulate
from monoforce_ros.terrain.files import TerrainFileError, load_terrain, save_terrain
from monoforce_ros.terrain.grid import Grid
from monoforce_ros.terrain.interpolation import interpolated
from monoforce_ros.terrain.lidar import (
    LidarSettings,
    TerrainError,
    cell_heights,
    cell_quantiles,
    fill_holes,
    interpolated_ground,
    require_cells,
    stands_on_ground,
    terrain_from_cloud,
)
from monoforce_ros.terrain.overhead import hanging_low, without_overhead
from monoforce_ros.terrain.scatter import horizontal_scatter
from monoforce_ros.terrain.terrain_map import CHANNELS, TerrainDefaults, TerrainMap, polar

__all__ = [
    "CHANNELS",
    "Grid",
    "LidarSettings",
    "TerrainDefaults",
    "TerrainError",
    "TerrainFileError",
    "TerrainMap",
    "accumulate",
    "cell_heights",
    "cell_quantiles",
    "fill_holes",
    "hanging_low",
    "horizontal_scatter",
    "interpolated",
    "interpolated_ground",
    "load_terrain",
    "polar",
    "require_cells",
    "save_terrain",
    "stands_on_ground",
    "terrain_from_cloud",
    "without_overhead",
]
