"""Other people's datasets as bags and as the same samples as ours."""

from monoforce_ros.datasets.dataset import DatasetError
from monoforce_ros.datasets.drive import DriveRecording, drive_to_bag
from monoforce_ros.datasets.rellis import RellisSequence, read_splits, sequence_to_bag
from monoforce_ros.datasets.rough import RoughScene, scene_to_bag

__all__ = [
    "DatasetError",
    "DriveRecording",
    "RellisSequence",
    "RoughScene",
    "drive_to_bag",
    "read_splits",
    "scene_to_bag",
    "sequence_to_bag",
]
