"""Reading and writing rosbag files: ROS 2 (sqlite3, mcap) and ROS 1, without a ROS installation."""

from monoforce_ros.bags import builders
from monoforce_ros.bags.reader import BagError, BagMessage, BagReader
from monoforce_ros.bags.recording import CAMERA_INFO, CLOUD, COMMANDS, IMAGES, ODOMETRY, Recording, camera_info_topic
from monoforce_ros.bags.samples import Sample, nearest_frame, synchronise
from monoforce_ros.bags.smoothing import SmoothedMotion, smooth
from monoforce_ros.bags.types import type_store
from monoforce_ros.bags.windows import Windows, cut_windows
from monoforce_ros.bags.writer import BagWriter

__all__ = [
    "CAMERA_INFO",
    "CLOUD",
    "COMMANDS",
    "IMAGES",
    "ODOMETRY",
    "BagError",
    "BagMessage",
    "BagReader",
    "BagWriter",
    "Recording",
    "Sample",
    "SmoothedMotion",
    "Windows",
    "builders",
    "camera_info_topic",
    "cut_windows",
    "nearest_frame",
    "smooth",
    "synchronise",
    "type_store",
]
