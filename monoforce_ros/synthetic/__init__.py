"""Synthetic worlds: a simulated robot drives over hills, rocks and soft grass, and its sensor data fill a bag.

Exports are imported on first use: MuJoCo is loaded only by what needs it.
"""

from typing import TYPE_CHECKING

from monoforce_ros.core import lazy_exports

if TYPE_CHECKING:
    from monoforce_ros.synthetic.course import WALL_THICKNESS, CourseSettings
    from monoforce_ros.synthetic.graphics import DrawingError
    from monoforce_ros.synthetic.hidden import draw_hidden, parse_hidden
    from monoforce_ros.synthetic.live import LiveSettings, LiveWorld
    from monoforce_ros.synthetic.odometry import OdometrySettings
    from monoforce_ros.synthetic.random_streams import random_stream
    from monoforce_ros.synthetic.recording import RecordingSettings, record
    from monoforce_ros.synthetic.scenery import Scenery, build_scenery
    from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
    from monoforce_ros.synthetic.simulation import Simulation
    from monoforce_ros.synthetic.snapshots import Snapshot, WorldSnapshots, take_snapshots
    from monoforce_ros.synthetic.terrain_shape import GROUNDS, TerrainSettings
    from monoforce_ros.synthetic.varied.settings import STYLES, WorldSettings
    from monoforce_ros.synthetic.varied.wall_ahead import AHEAD_KINDS, WallAhead, draw_wall_ahead
    from monoforce_ros.synthetic.varied.world import VariedWorld, draw_world
    from monoforce_ros.synthetic.vehicle import Vehicle
    from monoforce_ros.synthetic.world import TIME_STEP, build_model
else:
    __getattr__ = lazy_exports(
        __name__,
        {
            "course": ("WALL_THICKNESS", "CourseSettings"),
            "graphics": ("DrawingError",),
            "hidden": ("draw_hidden", "parse_hidden"),
            "live": ("LiveSettings", "LiveWorld"),
            "odometry": ("OdometrySettings",),
            "random_streams": ("random_stream",),
            "recording": ("RecordingSettings", "record"),
            "scenery": ("Scenery", "build_scenery"),
            "sensors": ("CameraSettings", "LidarSettings"),
            "simulation": ("Simulation",),
            "snapshots": ("Snapshot", "WorldSnapshots", "take_snapshots"),
            "terrain_shape": ("GROUNDS", "TerrainSettings"),
            "varied.settings": ("STYLES", "WorldSettings"),
            "varied.wall_ahead": ("AHEAD_KINDS", "WallAhead", "draw_wall_ahead"),
            "varied.world": ("VariedWorld", "draw_world"),
            "vehicle": ("Vehicle",),
            "world": ("TIME_STEP", "build_model"),
        },
    )

__all__ = [
    "AHEAD_KINDS",
    "GROUNDS",
    "STYLES",
    "TIME_STEP",
    "WALL_THICKNESS",
    "CameraSettings",
    "CourseSettings",
    "DrawingError",
    "LidarSettings",
    "LiveSettings",
    "LiveWorld",
    "OdometrySettings",
    "RecordingSettings",
    "Scenery",
    "Simulation",
    "Snapshot",
    "TerrainSettings",
    "VariedWorld",
    "Vehicle",
    "WallAhead",
    "WorldSettings",
    "WorldSnapshots",
    "build_model",
    "build_scenery",
    "draw_hidden",
    "draw_wall_ahead",
    "draw_world",
    "parse_hidden",
    "random_stream",
    "record",
    "take_snapshots",
]
