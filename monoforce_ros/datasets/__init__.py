"""Other people's data as the same samples and bags that the rest of the package uses."""

from monoforce_ros.datasets.rough import RoughScene, scene_to_bag

__all__ = ["RoughScene", "scene_to_bag"]
