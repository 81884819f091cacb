"""The terrain sources that users select by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from monoforce_ros.encoder import CheckpointError, fused, load_encoder, packed
from monoforce_ros.perception.encoder_terrain import EncoderTerrain
from monoforce_ros.perception.flat import FlatTerrain
from monoforce_ros.perception.fusion import LidarCameraTerrain
from monoforce_ros.perception.lidar import LidarTerrain
from monoforce_ros.perception.observation import TerrainSource
from monoforce_ros.perception.seen_obstacles import ObstacleTerrain, SeenObstacles
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.perception.trusted_terrain import TrustedTerrain
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainDefaults

SOURCES = ("lidar", "lidar_interpolation", "camera", "lidar_camera", "flat")
"""Names of the terrain sources."""
LIDAR_RETENTION_TIME = 10.0
"""How long the node keeps what the lidar measured before it came too near, by default [s]: a robot that drives slowly
crosses the blind zone of its lidar, 1 to 3 m, in that time."""
CAMERA_SOURCES = ("camera", "lidar_camera")
"""Those that use images."""


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
    retention_time: float = 0.0,
    lidar_retention_time: float = 0.0,
    motion_stereo: bool = False,
    fallback: bool = False,
    warn: Callable[[str], None] = lambda message: None,
) -> TerrainSource:
    """A terrain source by its name, one of :data:`SOURCES`.

    Args:
        kind: its name.
        robot: the robot on the ground.
        grid: cells of the maps; sources with cameras use the encoder's. The source ``lidar`` interpolates on any other
            grid than the encoder's, where the encoder takes no sweeps, and without the shipped encoder's files.
        material: material of ground for which the source does not predict it.
        checkpoint: checkpoint of the encoder; empty for the shipped one.
        device: device of the encoder.
        precision: precision of the encoder, see :func:`monoforce_ros.encoder.fused`.
        threads: CPU threads of the encoder; by default PyTorch's current number.
        fallback: whether sources with an encoder fall back (to level ground, or to the lidar alone) while the encoder
            is worse than level ground; see :class:`monoforce_ros.perception.TrustedTerrain`.
        retention_time: how long terrain seen by cameras is kept after it leaves the images [s]; 0 disables it.
        lidar_retention_time: how long terrain measured by the lidar is kept after it comes so near that the lidar looks
            over it [s]; 0 disables it.
        motion_stereo: whether sources with cameras add what images from several places show to stand on the ground, as
            long as no lidar measures it; see :class:`monoforce_ros.perception.SeenObstacles`.
        warn: called with the reason if the source ``lidar`` only interpolates.

    Raises:
        ValueError: there is no such source or precision.
        CheckpointError: the encoder cannot be loaded, other than the shipped one for the source ``lidar``.
    """
    if kind not in SOURCES:
        raise ValueError(f"terrain source: got {kind!r}, expected one of {SOURCES}")
    if kind == "flat":
        return FlatTerrain(robot, grid or Grid.square(), material)

    def memory(source: TerrainSource) -> TemporalMemory | None:
        """Of what the lidar looks over once it is near."""
        if not lidar_retention_time or "lidar" not in source.sensors:
            return None
        return TemporalMemory(
            source, robot, stiffness=material.stiffness, retention_time=lidar_retention_time, blind_zone_only=True
        )

    def measured(grid: Grid) -> TerrainSource:
        """Heights interpolated between returns, and remembered."""
        source = LidarTerrain(robot, grid, material)
        return memory(source) or source

    if kind == "lidar_interpolation":
        return measured(grid or Grid.square())
    try:
        encoder = load_encoder(checkpoint, None if kind == "lidar" else "camera")
    except CheckpointError as error:
        # What the user named has to be there; without the shipped encoder a sweep still says where the ground is.
        if kind != "lidar" or str(checkpoint):
            raise
        warn(f"terrain source lidar interpolates the point cloud like lidar_interpolation: {error}")
        return measured(grid or Grid.square())
    sensors = tuple(name for name in kind.split("_") if name == "camera" or encoder.config.takes_sweeps)
    own_grid = encoder.config.grid
    if kind == "lidar" and (not sensors or grid not in (None, own_grid)):
        wanted = f"a map of {own_grid.columns * own_grid.resolution:g} m with cells of {own_grid.resolution:g} m"
        reason = f"its encoder makes {wanted} only" if sensors else f"the encoder {checkpoint} takes no sweeps"
        warn(f"terrain source lidar interpolates the point cloud like lidar_interpolation: {reason}")
        return measured(grid or own_grid)
    # Packed weights and half precision save time on the CPU only.
    encoder = packed(fused(encoder, precision)) if device == "cpu" else fused(encoder).to(device)
    own = EncoderTerrain(encoder, robot, sensors, threads=threads, material=material)
    learned: TerrainSource = own
    if retention_time and "camera" in sensors:
        learned = TemporalMemory(learned, robot, stiffness=own.stiffness, retention_time=retention_time)
    obstacles = SeenObstacles(robot, own.stiffness, own_grid) if motion_stereo and "camera" in kind else None
    level, lidar = FlatTerrain(robot, learned.grid, material), LidarTerrain(robot, learned.grid, material)
    if kind == "lidar_camera" and "lidar" not in sensors:
        learned = LidarCameraTerrain(lidar, learned)
    # What the encoder says is remembered already, but counts only as far as it is trusted.
    recall = None if retention_time and "camera" in sensors and not fallback else memory(learned)
    if fallback:
        if kind == "lidar":
            return TrustedTerrain(learned, own, [lidar], expected=1.0, memory=recall)
        if kind == "camera":
            return TrustedTerrain(learned, own, [level], obstacles=obstacles)
        without_images: TerrainSource = lidar
        if "lidar" in sensors:
            # What images say has to be confirmed; what the encoder makes of the sweep is there from the start.
            sweep = EncoderTerrain(encoder, robot, ("lidar",), threads=threads, material=material)
            without_images = TrustedTerrain(sweep, sweep, [lidar], expected=1.0)
        return TrustedTerrain(learned, own, [without_images, level], memory=recall, obstacles=obstacles)
    learned = recall or learned
    return learned if obstacles is None else ObstacleTerrain(learned, obstacles)
