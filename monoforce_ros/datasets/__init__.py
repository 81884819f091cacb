"""Loaders of public datasets, and their conversion to bags."""

from monoforce_ros.datasets.dataset import DatasetError
from monoforce_ros.datasets.drive import DriveRecording, drive_to_bag
from monoforce_ros.datasets.rellis import RellisSequence, read_splits, sequence_to_bag
from monoforce_ros.datasets.rough import RoughScene, robot_file_for, scene_to_bag

__all__ = [
    "DatasetError",
    "DriveRecording",
    "RellisSequence",
    "RoughScene",
    "drive_to_bag",
    "read_splits",
    "robot_file_for",
    "scene_to_bag",
    "sequence_to_bag",
]
