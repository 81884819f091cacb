"""Samples of ROUGH scenes: calibrated images of one moment, with the map of one lidar cloud as the target."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.datasets import DatasetError, RoughScene
from monoforce_ros.encoder import EncoderConfig, network_image
from monoforce_ros.perception import LidarTerrain, Observation, support_points, traced_ground
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainDefaults
from monoforce_ros.training.recording_samples import RecordingSamples, Segment
from monoforce_ros.training.world_samples import no_chunks

_TRACE_STEP = 0.1
"""Distance between poses of the path that was driven before the image [m]."""


def scene_samples(folder: Path, robot: RobotModel, config: EncoderConfig) -> RecordingSamples:
    """The one sample of a scene.

    Raises:
        DatasetError: the scene has no images, no cloud, or no pose at its time.
    """
    scene = RoughScene.open(folder)
    if not len(scene.cloud_stamps):
        raise DatasetError(f"{folder}: no cloud")
    stamp = int(scene.cloud_stamps[0])
    images = scene.images(stamp)
    if not images:
        raise DatasetError(f"{folder}: no images")
    # A robot that rests at the start of its poses rested there when the cloud was taken, shortly before.
    lead = (int(scene.pose_stamps[0]) - stamp) * 1e-9
    pose = scene.pose(int(scene.pose_stamps[0]) if 0.0 < lead < 10.0 and scene.stands_at_start() else stamp)
    motion = MotionState(stamp, pose[:3, 3], pose[:3, :3], np.zeros(3), np.zeros(3))
    cloud = transform_points(scene.base_from_lidar, scene.cloud(stamp))
    cloud = cloud[np.isfinite(cloud).all(axis=1) & (scene.cloud(stamp) != 0.0).any(axis=1)]
    grid = Grid.square(config.map_size + 4.0, config.resolution)
    found = LidarTerrain(robot, grid, TerrainDefaults()).terrain(Observation(stamp, cloud=cloud), motion)
    placed = motion.odometry_from_terrain
    heights = found.geometric_height.numpy().astype(np.float32)
    names = sorted(images)
    unplaced = [name for name in names if name not in scene.base_from_sensors]
    if unplaced:
        raise DatasetError(f"{folder}: calibration/transformations.yaml has no pose of {', '.join(unplaced)}")
    poses = np.stack([pose @ scene.base_from_sensors[name] for name in names])
    support = support_points(robot, motion, config.stiffness)
    trace = traced_ground(robot, scene.map_from_base[scene.pose_stamps <= stamp], _TRACE_STEP)
    sweep = transform_points(pose, cloud[~robot.covers(cloud)])
    return RecordingSamples(
        name=folder.name,
        cameras=tuple(scene.cameras[name] for name in names),
        images=torch.from_numpy(np.stack([network_image(images[name], config) for name in names])[None]),
        stamps=np.array([stamp]),
        odometry_from_base=pose[None],
        odometry_from_cameras=poses[None],
        support=transform_points(placed, support)[None],
        sweeps=sweep.astype(np.float32),
        sweep_ends=np.array([len(sweep)]),
        traces=trace.astype(np.float32),
        trace_ends=np.array([len(trace)]),
        segment_of=np.zeros(1, np.int64),
        segments=(
            Segment(
                grid, placed, heights, found.observed.numpy(), heights, np.zeros(heights.shape, bool),
                np.full(heights.shape, np.nan, np.float32),
            ),
        ),
        chunks=no_chunks(),
    )  # fmt: skip
