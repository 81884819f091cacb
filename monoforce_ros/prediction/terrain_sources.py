"""Terrain sources: a sensor's observation → TerrainMap in the terrain frame at the observation's time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Protocol

import cv2
import numpy as np
import torch

from monoforce_ros.camera import CameraModel
from monoforce_ros.encoder import CameraView, LidarEncoder, TerrainEncoder, fused, load_encoder
from monoforce_ros.motion import MotionState, transform_points
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, terrain_from_cloud

_LAID_FROM, _LAID_TO = 0.15, 0.7
"""Distances from the wheels up to which a map is shifted to where the robot stands, and beyond which not [m]."""

_ALLOWED = 0.03
"""How far ground may reach above the lowest point of a wheel or track within a cell [m]."""

_GIVES_FROM, _GIVES_WHOLLY, _UNSURE = 0.02, 0.06, 0.25
"""Decrease below which a surface that a lidar measured is taken as firm, and from which on as giving way [m]; how much
higher than the encoder says such a surface may be."""


@dataclass(frozen=True)
class Observation:
    """What the sensors saw at one time."""

    stamp: int
    """[ns]."""
    cloud: np.ndarray | None = None
    """Lidar returns ``[n, 3]`` [m] in the base frame."""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    """RGB pixels ``[height, width, 3]`` of each camera, by any name."""
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    base_from_cameras: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Pose ``[4, 4]`` of each camera in the base frame."""


SOURCES = ("lidar", "camera", "lidar_camera", "flat")
"""Terrain sources that users choose from by name."""


class TerrainSource(Protocol):
    """Makes a map of the ground around the robot."""

    sensors: ClassVar[tuple[str, ...]]
    """What an observation must hold: ``lidar``, ``camera``, both or nothing."""
    grid: Grid
    """Where the maps' cells lie."""

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map in the terrain frame (origin at the robot, x along its heading, z up)."""


def support_points(robot: RobotModel, motion: MotionState, stiffness: float) -> np.ndarray:
    """Where the ground must be under the wheels of a robot that stands or drives on it, ``[m, 3]`` in terrain axes."""
    lowest = robot.points[robot.point_tangents[:, 0] < -0.97].numpy()
    points = transform_points(motion.terrain_from_base, lowest.astype(np.float64))
    points[:, 2] += rest_depth(robot, stiffness)
    return points


def laid_under(terrain: TerrainMap, support: np.ndarray) -> TerrainMap:
    """A predicted map that meets the ground under the robot's wheels, which is known better than any image tells.

    Heights are shifted to where those that carry meet the points ``[m, 3]`` on which the robot stands, less so with the
    distance from them. What stands above the ground is shifted along: its height is what vegetation holds the robot by.
    A robot that starts below a predicted surface would be thrown off it.
    """
    grid = terrain.grid
    rows, columns, inside = grid.cells(support[:, :2])
    if not inside.any():
        return terrain
    points = support[inside]
    short = points[:, 2] - terrain.height.numpy()[rows[inside], columns[inside]]
    # Nothing moves beyond this window; most of the map need not be looked at.
    (left, bottom), (right, top) = points[:, :2].min(axis=0) - _LAID_TO, points[:, :2].max(axis=0) + _LAID_TO
    across = slice(*np.searchsorted(grid.x, (left, right)))
    up = slice(*np.searchsorted(grid.y, (bottom, top)))
    x, y = np.meshgrid(grid.x[across], grid.y[up])
    away = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1])
    nearness = 1.0 / (away + 0.05) ** 2
    shift = (nearness * short).sum(axis=-1) / nearness.sum(axis=-1)
    share = np.clip((_LAID_TO - away.min(axis=-1)) / (_LAID_TO - _LAID_FROM), 0.0, 1.0)
    height = terrain.height.clone()
    moved = torch.from_numpy((shift * share).astype(np.float32))
    height[up, across] += moved
    visible = terrain.geometric_height.clone()
    visible[up, across] += moved
    return replace(terrain, height=height, geometric_height=visible)


def clear_of(terrain: TerrainMap, robot: RobotModel, motion: MotionState) -> TerrainMap:
    """A map of which nothing reaches into the robot that stands on it.

    No sensor sees the ground below a robot; what is filled in there from a wall nearby would push it from the start.
    Cells below it are lowered to its lower side; so are those next to it of which nothing was measured.
    """
    grid, pose = terrain.grid, motion.terrain_from_base
    (rear, right), (front, left) = (bound.cpu().double().numpy()[:2] for bound in robot.bounds)
    hull = robot.points[robot.point_drives < 0]
    belly = float(hull[:, 2].min()) if len(hull) else 0.0
    if abs(np.linalg.det(pose[:2, :2])) < 0.1:  # it lies on its side
        return terrain
    # Where each cell's vertical meets the plane of the hull's lower side, in the robot's axes.
    cells = np.stack(np.meshgrid(grid.x, grid.y), axis=-1) - pose[:2, 2] * belly
    along, aside = np.moveaxis(cells @ np.linalg.inv(pose[:2, :2]).T, -1, 0)
    inside = (along > rear) & (along < front) & (aside > right) & (aside < left)
    limit = np.where(inside, pose[2, 0] * along + pose[2, 1] * aside + pose[2, 2] * belly, np.inf)
    # Wheels and tracks reach lower; between their points and the cells' centres the ground may slope.
    points = transform_points(pose, robot.points.cpu().double().numpy())
    rows, columns, on_grid = grid.cells(points[:, :2])
    np.minimum.at(limit, (rows[on_grid], columns[on_grid]), points[on_grid, 2] + _ALLOWED)
    beside = cv2.erode(limit.astype(np.float32), np.ones((3, 3), np.uint8), borderValue=np.inf)
    limit = torch.from_numpy(np.where(terrain.observed.numpy(), limit, beside)).to(terrain.height)
    if not bool((terrain.height > limit).any()):
        return terrain
    return replace(terrain, height=torch.minimum(terrain.height, limit))


def lowered(swept: TerrainMap, seen: TerrainMap) -> TerrainMap:
    """A lidar's surfaces, lowered to where an encoder says that the ground carries where it says that they give way.

    Args:
        swept: from a lidar.
        seen: from an encoder, on the same grid.
    """
    decrease = (seen.geometric_height - seen.height).clamp_min(0.0)
    gives = ((decrease - _GIVES_FROM) / (_GIVES_WHOLLY - _GIVES_FROM)).clamp(0.0, 1.0)
    # A surface far above what the encoder explains is another one, which it has not seen.
    above = (swept.height - seen.height).clamp_min(0.0)
    height = swept.height - gives * torch.minimum(above, decrease + _UNSURE)
    return replace(
        seen, height=height, geometric_height=height + gives * decrease, observed=swept.observed | seen.observed
    )


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
        found = terrain_from_cloud(
            transform_points(motion.terrain_from_base, cloud),
            self.grid,
            settings=self.settings,
            material=self.material,
            support=support_points(self.robot, motion, self.material.stiffness),
        )
        return clear_of(found, self.robot, motion)


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
        return clear_of(laid_under(found, support), self.robot, motion)


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
        return clear_of(laid_under(found, support), self.robot, motion)


@dataclass(frozen=True)
class LidarCameraTerrain:
    """Surfaces where a lidar hit them, lowered by how far the encoder says that they give way (H_d); on one grid.

    A lidar knows where a wall is and takes grass for one; an encoder knows grass, and heights less well.
    """

    lidar: LidarTerrain
    camera: CameraTerrain
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
        return lowered(self.lidar.terrain(observation, motion), self.camera.terrain(observation, motion))


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
    # What is gained by folding and by half precision is gained on the CPU.
    encoder = fused(encoder, precision) if device == "cpu" else fused(encoder).to(device)
    camera = CameraTerrain(encoder, robot, threads)
    return camera if kind == "camera" else LidarCameraTerrain(LidarTerrain(robot, camera.grid, material), camera)
