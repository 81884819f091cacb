"""Read and write rosbag files of ROS 2 (sqlite3, mcap) and read those of ROS 1, without a ROS installation."""

from typing import TYPE_CHECKING

from monoforce_ros.bags import builders
from monoforce_ros.bags.camera_choice import CameraChoice, chosen_cameras, image_frames
from monoforce_ros.bags.joint_record import JointRecord
from monoforce_ros.bags.read_options import DETECTED, ReadOptions, add_read_options, read_options
from monoforce_ros.bags.reader import BagError, BagMessage, BagReader
from monoforce_ros.bags.recorded_transforms import FIXED
from monoforce_ros.bags.recording import (
    Frame,
    Recording,
    find_transform,
    nearest_frame,
)
from monoforce_ros.bags.smoothing import SmoothedMotion, smooth
from monoforce_ros.bags.topic_choice import (
    CAMERA_INFO,
    CLOUD,
    COMMANDS,
    IMAGES,
    ODOMETRY,
    camera_info_topics,
    is_rectified,
)
from monoforce_ros.bags.types import type_store
from monoforce_ros.bags.windows import Windows, cut_windows
from monoforce_ros.bags.writer import BagWriter
from monoforce_ros.core import lazy_exports

if TYPE_CHECKING:
    from monoforce_ros.bags.recorded_observation import MAXIMUM_GAP, MAXIMUM_SPREAD, flippers_at, observe
else:  # observations are of perception, which starts torch: players and recorders of bags do without
    __getattr__ = lazy_exports(
        __name__, {"recorded_observation": ("MAXIMUM_GAP", "MAXIMUM_SPREAD", "flippers_at", "observe")}
    )

__all__ = [
    "CAMERA_INFO",
    "CLOUD",
    "COMMANDS",
    "DETECTED",
    "FIXED",
    "IMAGES",
    "MAXIMUM_GAP",
    "MAXIMUM_SPREAD",
    "ODOMETRY",
    "BagError",
    "BagMessage",
    "BagReader",
    "BagWriter",
    "CameraChoice",
    "Frame",
    "JointRecord",
    "ReadOptions",
    "Recording",
    "SmoothedMotion",
    "Windows",
    "add_read_options",
    "builders",
    "camera_info_topics",
    "chosen_cameras",
    "cut_windows",
    "find_transform",
    "flippers_at",
    "image_frames",
    "is_rectified",
    "nearest_frame",
    "observe",
    "read_options",
    "smooth",
    "type_store",
]
