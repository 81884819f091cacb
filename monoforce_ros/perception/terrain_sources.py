"""Terrain sources: a sensor's observation → TerrainMap in the terrain frame at the observation's time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.encoder import CameraView, LidarEncoder, TerrainEncoder, fused, load_encoder, packed
from monoforce_ros.perception.ground_alignment import aligned_to_ground, clear_of, support_points
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, terrain_from_cloud

_GIVES_FROM, _GIVES_WHOLLY, _UNSURE = 0.02, 0.06, 0.25
"""Decrease below which a surface that a lidar measured is taken as firm, and from which on as giving way [m]; how much
higher than the encoder says such a surface may be."""


SOURCES = ("lidar", "camera", "lidar_camera", "flat")
"""Terrain sources that users choose from by name."""


def lowered(swept: TerrainMap, seen: TerrainMap) -> TerrainMap:
    """A lidar's surfaces, lowered to where an encoder says that the ground carries where it says that they give way.

    So far goes the encoder's word on the material, too: what it has learnt of it is what explains drives on all ground
    together, and drives on firm ground are predicted better with what a user says of that.

    Args:
        swept: from a lidar.
        seen: from an encoder, on the same grid.
    """
    decrease = (seen.geometric_height - seen.height).clamp_min(0.0)
    gives = ((decrease - _GIVES_FROM) / (_GIVES_WHOLLY - _GIVES_FROM)).clamp(0.0, 1.0)
    # A surface far above what the encoder explains is another one, which it has not seen.
    above = (swept.height - seen.height).clamp_min(0.0)
    height = swept.height - gives * torch.minimum(above, decrease + _UNSURE)
    material = {
        name: torch.lerp(getattr(swept, name), getattr(seen, name), gives)
        for name in ("stiffness", "damping", "friction")
    }
    observed = swept.observed | seen.observed
    return replace(seen, height=height, geometric_height=height + gives * decrease, observed=observed, **material)


@dataclass(frozen=True)
class FlatTerrain:
    """Level ground at the height of the wheels; the terrain source that needs no sensor."""

    robot: RobotModel
    grid: Grid
    material: TerrainDefaults
    sensors: ClassVar[tuple[str, ...]] = ()

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Level map; see :class:`TerrainSource`."""
        height = float(support_points(self.robot, motion, self.material.stiffness)[:, 2].mean())
        return TerrainMap.flat(self.grid, height=height, material=self.material)


@dataclass(frozen=True)
class LidarTerrain:
    """Heights interpolated from a lidar cloud (the paper's baseline [19])."""

    robot: RobotModel
    grid: Grid
    material: TerrainDefaults
    settings: LidarSettings = field(default_factory=LidarSettings)
    sensors: ClassVar[tuple[str, ...]] = ("lidar",)

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Interpolated map; raises ``TerrainError`` where the cloud does not suffice."""
        if observation.cloud is None:
            raise ValueError("the lidar terrain source needs a point cloud, and the observation has none")
        cloud = observation.cloud[~self.robot.covers(observation.cloud)].astype(np.float64)
        return terrain_from_cloud(
            transform_points(motion.terrain_from_base, cloud),
            self.grid,
            settings=self.settings,
            material=self.material,
            support=support_points(self.robot, motion, self.material.stiffness),
        )


@dataclass(frozen=True)
class LidarNetworkTerrain:
    """Heights that a trained network completes from one sweep (the paper's baseline [22])."""

    encoder: LidarEncoder
    robot: RobotModel
    sensors: ClassVar[tuple[str, ...]] = ("lidar",)

    @property
    def grid(self) -> Grid:
        """The encoder's."""
        return self.encoder.config.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Completed map; see :class:`TerrainSource`."""
        if observation.cloud is None:
            raise ValueError("the lidar network needs a point cloud, and the observation has none")
        cloud = observation.cloud[~self.robot.covers(observation.cloud)].astype(np.float64)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        support = support_points(self.robot, motion, self.encoder.config.stiffness)
        found = self.encoder.terrain(transform_points(motion.terrain_from_base, cloud), support)
        return aligned_to_ground(found, support)


@dataclass(frozen=True)
class CameraTerrain:
    """Terrain predicted from images by a trained encoder (paper III-A)."""

    encoder: TerrainEncoder
    robot: RobotModel
    threads: int | None = None
    """For the encoder alone: the physics' many small operations are fastest on one."""
    sensors: ClassVar[tuple[str, ...]] = ("camera",)

    @property
    def grid(self) -> Grid:
        """The encoder's."""
        return self.encoder.config.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Predicted map; raises ``ValueError`` where an image, calibration or camera pose is missing."""
        views = []
        for name, image in observation.images.items():
            if name not in observation.cameras or name not in observation.base_from_cameras:
                raise ValueError(f"camera {name}: its calibration or its pose on the robot is missing")
            pose = motion.terrain_from_base @ observation.base_from_cameras[name]
            views.append(CameraView(image, observation.cameras[name], pose))
        if not views:
            raise ValueError("the camera terrain source needs at least one image, and the observation has none")
        support = support_points(self.robot, motion, self.encoder.config.stiffness)
        before = torch.get_num_threads()
        torch.set_num_threads(self.threads or before)
        try:
            found = self.encoder.terrain(views, support)
        finally:
            torch.set_num_threads(before)
        return aligned_to_ground(found, support)


@dataclass(frozen=True)
class LidarCameraTerrain:
    """Surfaces where a lidar hit them, lowered by how far the encoder says that they give way (H_d); on one grid.

    A lidar knows where a wall is and takes grass for one; an encoder knows grass, and heights less well.
    """

    lidar: LidarTerrain
    camera: CameraTerrain | TemporalMemory
    sensors: ClassVar[tuple[str, ...]] = ("lidar", "camera")

    @property
    def grid(self) -> Grid:
        """The encoder's."""
        return self.camera.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map of both, or of the one that there is; raises ``ValueError`` where neither suffices."""
        if observation.cloud is None:
            return self.camera.terrain(observation, motion)
        if not observation.images:
            return self.lidar.terrain(observation, motion)
        found = lowered(self.lidar.terrain(observation, motion), self.camera.terrain(observation, motion))
        # What is high still is firm. (A lidar alone takes grass for that, and would see the robot walled in by it.)
        return clear_of(found, self.lidar.robot, motion)


def choose_terrain_source(
    kind: str,
    robot: RobotModel,
    *,
    grid: Grid | None = None,
    material: TerrainDefaults = TerrainDefaults(),  # noqa: B008  (frozen)
    checkpoint: str | Path = "",
    device: str = "cpu",
    precision: str = "float32",
    threads: int | None = None,
    memory: float = 0.0,
) -> TerrainSource:
    """A terrain source by its name, one of :data:`SOURCES`.

    Args:
        kind: its name.
        robot: that stands on the ground.
        grid: of the maps; with an encoder, its own.
        material: of ground of which the source does not predict it.
        checkpoint: of the encoder; empty for the shipped one.
        device: on which the encoder runs.
        precision: of the encoder, see :func:`monoforce_ros.encoder.fused`.
        threads: that the encoder may use on the CPU; by default as many as PyTorch is set to.
        memory: for so long what cameras saw is remembered where they see nothing now [s]; 0 for not at all.

    Raises:
        ValueError: there is no such source or precision.
        CheckpointError: the encoder cannot be loaded.
    """
    if kind not in SOURCES:
        raise ValueError(f"terrain source: got {kind!r}, expected one of {SOURCES}")
    grid = grid or Grid.square()
    if kind == "flat":
        return FlatTerrain(robot, grid, material)
    if kind == "lidar":
        return LidarTerrain(robot, grid, material)
    encoder = load_encoder(checkpoint, "camera")
    # What is gained by packing and by half precision is gained on the CPU.
    encoder = packed(fused(encoder, precision)) if device == "cpu" else fused(encoder).to(device)
    camera: CameraTerrain | TemporalMemory = CameraTerrain(encoder, robot, threads)
    if memory:
        camera = TemporalMemory(camera, robot, stiffness=encoder.config.stiffness, seconds=memory)
    return camera if kind == "camera" else LidarCameraTerrain(LidarTerrain(robot, camera.grid, material), camera)
