"""EncoderTerrain: terrain that a trained encoder predicts from images, a lidar sweep, or both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.encoder import CameraView, Encoder, EncoderConfig
from monoforce_ros.perception.fusion import material_by_compliance
from monoforce_ros.perception.ground_alignment import align_to_ground, standing
from monoforce_ros.perception.lidar import usable_returns
from monoforce_ros.perception.observation import Observation
from monoforce_ros.perception.trace import DrivenGround
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, LidarSettings, TerrainDefaults, TerrainMap, hanging_low, require_cells


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


class EncoderTerrain:
    """Terrain predicted by a trained encoder from images, a lidar sweep, or both (paper III-A).

    The ground that the robot drives over is an input, too; odometry must therefore come in order.

    Args:
        encoder: the encoder.
        robot: the robot on the ground.
        sensors: sensors used, of ``camera`` and ``lidar``; of two sensors either may be absent from an observation.
        threads: CPU threads of the encoder; see :func:`encoder_threads`.
        material: material of rigid ground, of which neither shape nor look says much (docs/training.md); images tell
            that of what is soft, its friction relative to the ground for which the encoder was made. By default it is
            predicted everywhere.

    Raises:
        ValueError: the encoder does not take one of the sensors.
    """

    def __init__(
        self,
        encoder: Encoder,
        robot: RobotModel,
        sensors: tuple[str, ...] = ("camera",),
        *,
        threads: int | None = None,
        material: TerrainDefaults | None = None,
    ):
        config = encoder.config
        unused = [name for name in sensors if name not in config.sensor.split("_")]
        if unused or not sensors:
            raise ValueError(f"terrain from {' and '.join(sensors) or 'no sensor'}: the encoder takes {config.sensor}")
        self.encoder, self.robot, self.sensors = encoder, robot, sensors
        self._threads, self._material = threads, material
        self.stiffness = config.stiffness if material is None else material.stiffness
        """Of the ground that carries the robot [N/m³]."""
        self._driven = DrivenGround(robot, self.stiffness)
        self.start_error = 0.0
        """Median difference between the last map and the ground under the wheels, before they were aligned [m]."""
        self.used: tuple[str, ...] = ()
        """Sensors of which the last map was made: a sweep with too few points is left out beside images."""

    @property
    def grid(self) -> Grid:
        """The encoder's grid."""
        return self.encoder.config.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Predicted map; raises ``ValueError`` if all sensors, a calibration or a camera pose are missing.

        Without images it raises ``TerrainError`` if too few points lie on the map: an encoder would interpolate between
        them. Beside images such a sweep is left out.
        """
        views = _views(observation, motion) if "camera" in self.sensors else []
        cloud = observation.cloud if "lidar" in self.sensors else None
        if not views and cloud is None:
            wanted = {"camera": "an image", "lidar": "a point cloud"}
            names = " or ".join(wanted[name] for name in self.sensors)
            raise ValueError(f"the terrain encoder needs {names}, and the observation has none")
        posed, support = standing(self.robot, observation.flipper_angles, motion, self.stiffness)
        sweep = None
        if cloud is not None:
            sweep = usable_returns(cloud, posed, motion, support, self.grid)
            cells = _measured_cells(sweep, float(support[:, 2].mean()), self.encoder.config)
            if not views:
                require_cells(cells, len(sweep), self.grid)
            elif cells < LidarSettings().minimum_cells:
                sweep = None
        had = {"camera": bool(views), "lidar": sweep is not None}
        self.used = tuple(name for name in self.sensors if had[name])
        trace = self._driven.update(motion, observation.track)
        with encoder_threads(self._threads):
            found = self.encoder.terrain(views, support, sweep=sweep, trace=trace)
        self.start_error = _error_under(found, support)
        if sweep is not None and self.robot.headroom > LidarSettings.headroom:
            found = _with_low_overhead(found, sweep)
        aligned = align_to_ground(found, support)
        if self._material is None:
            return aligned
        rigid = aligned.with_material(self._material)
        if not views:
            return rigid
        usual = self.encoder.config.friction
        friction = aligned.friction * (self._material.friction / usual) if usual > 0.0 else rigid.friction
        return material_by_compliance(rigid, replace(aligned, friction=friction))


def _with_low_overhead(terrain: TerrainMap, sweep: np.ndarray) -> TerrainMap:
    """The map, with what hangs too low for a robot that is taller than those for which the encoder was trained.

    Args:
        terrain: predicted map.
        sweep: returns ``[n, 3]`` in its frame, without those that the robot passes under [m].
    """
    limits = LidarSettings()
    heights, low = hanging_low(sweep, terrain.grid, limits.headroom, lowest=limits.lowest, highest=limits.highest)
    if not low.any():
        return terrain
    hangs, raised = torch.from_numpy(low), torch.from_numpy(heights).to(terrain.height)
    height, surface = (torch.where(hangs, raised, values) for values in (terrain.height, terrain.geometric_height))
    return replace(terrain, height=height, geometric_height=surface)


def _measured_cells(sweep: np.ndarray, ground: float, config: EncoderConfig) -> int:
    """Number of cells with points ``[n, 3]`` between the heights that the encoder takes."""
    rows, columns, inside = config.grid.cells(sweep[:, :2])
    inside &= (sweep[:, 2] - ground > config.lowest) & (sweep[:, 2] - ground < config.highest)
    hit = np.zeros((config.grid.rows, config.grid.columns), bool)
    hit[rows[inside], columns[inside]] = True
    return int(hit.sum())


def _error_under(terrain: TerrainMap, support: np.ndarray) -> float:
    rows, columns, inside = terrain.grid.cells(support[:, :2])
    if not inside.any():
        return 0.0
    return float(np.median(np.abs(terrain.height.numpy()[rows[inside], columns[inside]] - support[inside, 2])))


def _views(observation: Observation, motion: MotionState) -> list[CameraView]:
    views = []
    for name, image in observation.images.items():
        if name not in observation.cameras or name not in observation.base_from_cameras:
            raise ValueError(f"camera {name}: its calibration or its pose on the robot is missing")
        pose = motion.terrain_from_base @ observation.base_from_cameras[name]
        views.append(CameraView(image, observation.cameras[name], pose))
    return views
