"""Shared by every package: cameras, rotations, tracks of motion and commands, time alignment, files."""

from monoforce_ros.core.alignment import DelayCorrelation, Delayed, largest_spread, nearest_stamp
from monoforce_ros.core.camera import CameraModel
from monoforce_ros.core.command_line import OptionParser, most_similar, nearest
from monoforce_ros.core.files import atomic_path, unfinished_path, without_nan, write_bytes, write_text
from monoforce_ros.core.frames import FrameError, RobotFrames, TransformTree
from monoforce_ros.core.geometry import (
    homogeneous,
    pose_matrix,
    quaternions,
    small_rotation,
    transform_points,
    wrap_angle,
)
from monoforce_ros.core.joint_track import JointTrack
from monoforce_ros.core.lazy import lazy_exports
from monoforce_ros.core.regimes import FAST_SHARE, motion_regimes
from monoforce_ros.core.shared_files import share_directory
from monoforce_ros.core.statistics import huber
from monoforce_ros.core.tracks import (
    LARGEST_COMMAND,
    NANOSECOND,
    AngularVelocityTrack,
    CommandTrack,
    EffortTrack,
    MotionState,
    MotionTrack,
    StaleDataError,
    WheelTrack,
)
from monoforce_ros.core.transform_history import PoseHistory, PoseTrack, TransformHistory
from monoforce_ros.core.warp_start import start_warp

__all__ = [
    "FAST_SHARE",
    "LARGEST_COMMAND",
    "NANOSECOND",
    "AngularVelocityTrack",
    "CameraModel",
    "CommandTrack",
    "DelayCorrelation",
    "Delayed",
    "EffortTrack",
    "FrameError",
    "JointTrack",
    "MotionState",
    "MotionTrack",
    "OptionParser",
    "PoseHistory",
    "PoseTrack",
    "RobotFrames",
    "StaleDataError",
    "TransformHistory",
    "TransformTree",
    "WheelTrack",
    "atomic_path",
    "homogeneous",
    "huber",
    "largest_spread",
    "lazy_exports",
    "most_similar",
    "motion_regimes",
    "nearest",
    "nearest_stamp",
    "pose_matrix",
    "quaternions",
    "share_directory",
    "small_rotation",
    "start_warp",
    "transform_points",
    "unfinished_path",
    "without_nan",
    "wrap_angle",
    "write_bytes",
    "write_text",
]
