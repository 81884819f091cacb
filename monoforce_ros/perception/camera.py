"""CameraTerrain: terrain that a trained encoder predicts from images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import torch

from monoforce_ros.core import MotionState
from monoforce_ros.encoder import CameraView, TerrainEncoder
from monoforce_ros.perception.ground_alignment import align_to_ground, support_points
from monoforce_ros.perception.observation import Observation
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap


@contextmanager
def encoder_threads(count: int | None) -> Iterator[None]:
    """Run PyTorch on ``count`` CPU threads within the context, and on as many as before afterwards.

    The encoder gains from several threads, while the physics' many small operations are fastest on one. PyTorch's
    number of threads is a setting of the whole process: only one thread, the one that makes predictions, may use this
    context. ``None`` leaves the number unchanged.
    """
    if not count:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class CameraTerrain:
    """Terrain predicted from images by a trained encoder (paper III-A)."""

    encoder: TerrainEncoder
    robot: RobotModel
    threads: int | None = None
    """CPU threads of the encoder; see :func:`encoder_threads`."""
    sensors: ClassVar[tuple[str, ...]] = ("camera",)

    @property
    def grid(self) -> Grid:
        """The encoder's grid."""
        return self.encoder.config.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Predicted map; raises ``ValueError`` if an image, calibration or camera pose is missing."""
        views = []
        for name, image in observation.images.items():
            if name not in observation.cameras or name not in observation.base_from_cameras:
                raise ValueError(f"camera {name}: its calibration or its pose on the robot is missing")
            pose = motion.terrain_from_base @ observation.base_from_cameras[name]
            views.append(CameraView(image, observation.cameras[name], pose))
        if not views:
            raise ValueError("the camera terrain source needs at least one image, and the observation has none")
        support = support_points(self.robot, motion, self.encoder.config.stiffness)
        with encoder_threads(self.threads):
            found = self.encoder.terrain(views, support)
        return align_to_ground(found, support)
