"""Synthetic worlds: a simulated robot drives over hills, rocks and soft grass, and its sensors fill a bag."""

from typing import TYPE_CHECKING

from monoforce_ros.core import lazy_exports

if TYPE_CHECKING:
    from monoforce_ros.synthetic.course import CourseSettings
    from monoforce_ros.synthetic.live import LiveSettings, LiveWorld
    from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
    from monoforce_ros.synthetic.terrain_shape import GROUNDS, TerrainSettings
else:
    __getattr__ = lazy_exports(
        __name__,
        {
            "course": ("CourseSettings",),
            "live": (
                "LiveSettings",
                "LiveWorld",
            ),
            "sensors": (
                "CameraSettings",
                "LidarSettings",
            ),
            "terrain_shape": (
                "GROUNDS",
                "TerrainSettings",
            ),
        },
    )

__all__ = [
    "GROUNDS",
    "CameraSettings",
    "CourseSettings",
    "LidarSettings",
    "LiveSettings",
    "LiveWorld",
    "TerrainSettings",
]
