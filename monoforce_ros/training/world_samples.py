"""Samples of randomised worlds: images from many places, with the simulator's surfaces as targets.

They pretrain an encoder. What a robot's own recordings cannot give (the surfaces where it never drove, the ground below
grass it never touched, friction) is known in a simulated world.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.encoder import EncoderConfig, network_image
from monoforce_ros.perception import support_points
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import WorldSettings, WorldSnapshots, take_snapshots
from monoforce_ros.terrain import Grid
from monoforce_ros.training.recording_samples import (
    SAMPLES_VERSION,
    Chunks,
    RecordingSamples,
    SamplesError,
    Segment,
    save_samples,
)

FIRST_WORLD = 420_000
"""First seed of the worlds for training; docs/protocol.md lists the seeds of each purpose."""
REPLAY_WORLD = 428_000
"""First seed of the worlds that an adaptation trains on alongside: none that the shipped encoder was trained on. Of
those it knows the obstacles by heart, so that they keep none of what it sees elsewhere (docs/training.md)."""
HELD_OUT_WORLD, CHOOSING_WORLD, JUDGED_WORLD = 430_000, 434_000, 438_000
"""First seeds of the worlds that validate a training, choose how much of an adaptation is kept, and judge the latter.

They differ: the shipped encoder was chosen on the first as the best, and is better there than elsewhere."""
PLACES = 16
"""Places of each world: the drawing of a world takes as long as seven images."""
WORLD_STYLES = ("varied", "site")
"""Rough country alone teaches little of walls: on level ground their feet tell how far away they are."""
_HISTORY = 1


def world_samples(
    seed: int, config: EncoderConfig, folder: Path, *, places: int = PLACES, settings: WorldSettings | None = None
) -> Path:
    """Write the samples of a randomised world, unless there is a file of the same seed and settings; return its path.

    Settings are those of :func:`world_settings` by default.

    Raises:
        SamplesError: the robot cannot stand anywhere in this world.
        DrawingError: no graphics library can render images.
    """
    settings = settings or world_settings(seed)
    file = world_file(seed, config, folder, places=places, settings=settings)
    if not file.is_file():
        save_samples(_samples(take_snapshots(settings, seed, places), f"world {seed}", config), file)
    return file


def world_file(seed: int, config: EncoderConfig, folder: Path, *, places: int, settings: WorldSettings) -> Path:
    """File of a world's samples."""
    content = [SAMPLES_VERSION, places, asdict(settings), config.image_width, config.image_height]
    digest = hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()[:8]
    return folder / f"world-{seed}-{digest}.safetensors"


def world_settings(seed: int, styles: Sequence[str] = WORLD_STYLES) -> WorldSettings:
    """Settings of a world for training; styles alternate with the seed."""
    return WorldSettings.of_style(styles[seed % len(styles)])


def _samples(world: WorldSnapshots, name: str, config: EncoderConfig) -> RecordingSamples:
    if not world.snapshots:
        raise SamplesError(f"{name}: no place at which the robot {world.robot} can stand")
    robot = load_robot(world.robot)
    poses = np.stack([snapshot.world_from_base for snapshot in world.snapshots])
    states = [_at_rest(pose) for pose in poses]
    support = []
    for state in states:
        placed = state.odometry_from_terrain
        support.append(support_points(robot, state, config.stiffness) @ placed[:3, :3].T + placed[:3, 3])
    sweeps = [snapshot.sweep for snapshot in world.snapshots]
    traces = [snapshot.trace for snapshot in world.snapshots]
    images = [np.stack([network_image(image, config) for image in snapshot.images]) for snapshot in world.snapshots]
    return RecordingSamples(
        name=name,
        cameras=world.cameras,
        images=torch.from_numpy(np.stack(images)),
        stamps=np.arange(len(poses), dtype=np.int64),
        odometry_from_base=poses,
        odometry_from_cameras=poses[:, None] @ world.base_from_cameras[None],
        support=np.array(support),
        sweeps=np.concatenate(sweeps).astype(np.float32),
        sweep_ends=np.cumsum([len(points) for points in sweeps], dtype=np.int64),
        traces=np.concatenate(traces).astype(np.float32),
        trace_ends=np.cumsum([len(points) for points in traces], dtype=np.int64),
        segment_of=np.zeros(len(poses), np.int64),
        segments=(_segment(world.labels),),
        chunks=no_chunks(),
    )


def _at_rest(pose: np.ndarray) -> MotionState:
    return MotionState(0, pose[:3, 3], pose[:3, :3], np.zeros(3), np.zeros(3))


def _segment(labels: dict[str, np.ndarray]) -> Segment:
    support = labels["support_height"]
    rows, columns = support.shape
    origin = (float(labels["origin"][0]), float(labels["origin"][1]))
    everywhere = np.ones(support.shape, bool)
    return Segment(
        grid=Grid(rows=rows, columns=columns, resolution=float(labels["resolution"]), origin=origin),
        odometry_from_map=np.eye(4),
        geometric=labels["visible_height"],
        observed=everywhere,
        supporting=support,
        contact_mask=everywhere.copy(),
        friction=labels["friction"],
    )


def no_chunks() -> Chunks:
    """No motion: the robot stands."""
    return Chunks(
        stamps=np.zeros(0, np.int64),
        times=np.zeros(1),
        positions=np.zeros((0, 1, 3)),
        rotations=np.zeros((0, 1, 3, 3)),
        velocities=np.zeros((0, 3)),
        angular_velocities=np.zeros((0, 3)),
        twists=np.zeros((0, _HISTORY + 1, 2), np.float32),
        history=_HISTORY,
    )
