"""Reading and writing rosbag files: ROS 2 (sqlite3, mcap) and ROS 1, without a ROS installation."""

from monoforce_ros.bags.reader import BagError, BagReader
from monoforce_ros.bags.recording import Recording
from monoforce_ros.bags.samples import Sample, synchronise
from monoforce_ros.bags.smoothing import SmoothedMotion, smooth
from monoforce_ros.bags.windows import Windows, cut_windows
from monoforce_ros.bags.writer import BagWriter

__all__ = [
    "BagError",
    "BagReader",
    "BagWriter",
    "Recording",
    "Sample",
    "SmoothedMotion",
    "Windows",
    "cut_windows",
    "smooth",
    "synchronise",
]
