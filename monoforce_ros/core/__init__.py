"""TODO."""

from monoforce_ros.core.camera import CameraModel
from monoforce_ros.core.files import write_text
from monoforce_ros.core.geometry import homogeneous, quaternions, transform_points
from monoforce_ros.core.shared_files import share_directory
from monoforce_ros.core.tracks import (
    NANOSECOND,
    AngularVelocityTrack,
    CommandTrack,
    MotionState,
    MotionTrack,
    StaleDataError,
    WheelTrack,
)

__all__ = [
    "NANOSECOND",
    "AngularVelocityTrack",
    "CameraModel",
    "CommandTrack",
    "MotionState",
    "MotionTrack",
    "StaleDataError",
    "WheelTrack",
    "homogeneous",
    "quaternions",
    "share_directory",
    "transform_points",
    "write_text",
]
