"""RecordingSamples: what a recorded drive teaches, cut once and kept in a file: images, maps seen and felt, motion."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from monoforce_ros.bags import BagError, Recording, cut_windows, smooth
from monoforce_ros.core import (
    CameraModel,
    CommandTrack,
    MotionTrack,
    StaleDataError,
    atomic_path,
    nearest_stamp,
    transform_points,
)
from monoforce_ros.effects import corrected_commands, corrected_motion
from monoforce_ros.encoder import EncoderConfig, network_image
from monoforce_ros.perception import support_points
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainError
from monoforce_ros.training.terrain_fit import FitSettings, fit_terrain, trajectory_frame, trajectory_grid
from monoforce_ros.training.visible import visible_terrain

_VERSION = 1
_LENGTH, _STRIDE = 10.0, 5.0
"""Of the trajectories that terrain is fitted to [s] (paper IV-A), and between their starts."""
_SEEN_BEFORE, _SEEN_AFTER = 2.0, 2.0
_MATCH = 100_000_000
"""Images of several cameras belong together if they are no further apart [ns]."""
_SWEEP_MATCH = 150_000_000
CHUNK = 1.0
"""Length of the pieces of motion for the trajectory loss [s]."""
MAXIMUM_BYTES = 20_000_000_000


class SamplesError(ValueError):
    """A drive that teaches nothing, or a file of samples that cannot be used; the message says why."""


@dataclass(frozen=True)
class SampleSettings:
    """How a drive is cut."""

    period: float = 0.5
    """Between the images that become samples [s]."""
    chunk_period: float = 0.5
    """Between the starts of pieces of motion [s]."""
    iterations: int = 40
    """Of each terrain fit."""

    def __post_init__(self):
        for name, low, high in (("period", 0.02, 60.0), ("chunk_period", 0.1, 10.0), ("iterations", 0, 10_000)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"samples {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")


@dataclass(frozen=True)
class Segment:
    """Maps of what was seen and felt along a trajectory of ten seconds."""

    grid: Grid
    odometry_from_map: np.ndarray
    geometric: np.ndarray
    """H_g* ``[rows, columns]`` [m]."""
    observed: np.ndarray
    supporting: np.ndarray
    """H_t* [m]."""
    felt: np.ndarray


@dataclass(frozen=True)
class Chunks:
    """Pieces of motion of one second in the odometry frame."""

    stamps: np.ndarray
    """``[W]`` [ns]."""
    times: np.ndarray
    """``[K]`` [s]."""
    positions: np.ndarray
    """``[W, K, 3]``."""
    rotations: np.ndarray
    """``[W, K, 3, 3]``."""
    velocities: np.ndarray
    """At the start, in base axes ``[W, 3]``."""
    angular_velocities: np.ndarray
    twists: np.ndarray
    """``[W, history + T, 2]``."""
    history: int


@dataclass(frozen=True)
class RecordingSamples:
    """The samples of one drive."""

    name: str
    cameras: tuple[CameraModel, ...]
    images: torch.Tensor
    """RGB uint8 ``[N, cameras, height, width, 3]`` in the network's size."""
    stamps: np.ndarray
    odometry_from_base: np.ndarray
    """``[N, 4, 4]``."""
    odometry_from_cameras: np.ndarray
    """At each image's own time, ``[N, cameras, 4, 4]``."""
    support: np.ndarray
    """Points under the wheels in the odometry frame ``[N, m, 3]``."""
    sweeps: np.ndarray
    """Points of the lidar sweep nearest to each image in the odometry frame, one after another ``[p, 3]``."""
    sweep_ends: np.ndarray
    """Where each sample's points end in ``sweeps`` ``[N]``."""
    segment_of: np.ndarray
    segments: tuple[Segment, ...]
    chunks: Chunks

    def __len__(self) -> int:
        return len(self.stamps)

    def sweep(self, index: int) -> np.ndarray:
        """Points ``[n, 3]`` of a sample's sweep in the odometry frame; none where there was no lidar."""
        start = self.sweep_ends[index - 1] if index else 0
        return self.sweeps[start : self.sweep_ends[index]]


def cut_recording(
    bag: Path,
    robot: RobotModel,
    config: EncoderConfig,
    folder: Path,
    *,
    settings: SampleSettings = SampleSettings(),
    image_topics: Sequence[str] = (),
) -> Path:
    """Cut a bag into a file of samples, unless that has been done with the same bag, robot and settings.

    Raises:
        SamplesError: the drive has no images with calibration, no commands, or is too short.
        BagError: the bag cannot be read.
    """
    fingerprint = _fingerprint(bag, robot, config, settings, image_topics)
    file = folder / f"{bag.name.removesuffix('.bag')}-{fingerprint[:8]}.safetensors"
    if file.is_file():
        return file
    tensors, description = _cut(bag, robot, config, settings, image_topics)
    with atomic_path(file) as unfinished:
        save_file(tensors, str(unfinished), metadata={"samples": json.dumps(description)})
    return file


def read_samples(file: Path) -> RecordingSamples:
    """Read a file of samples.

    Raises:
        SamplesError: it is damaged, too large or of another version.
    """
    if file.stat().st_size > MAXIMUM_BYTES:
        raise SamplesError(f"{file}: {file.stat().st_size} bytes, at most {MAXIMUM_BYTES}")
    try:
        with safe_open(str(file), framework="pt") as content:
            description = json.loads((content.metadata() or {}).get("samples", "{}"))
            if description.get("version") != _VERSION:
                raise SamplesError(f"{file}: not samples of version {_VERSION}; delete it, it is made again")
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118  (not a dict)
        values = {name: tensor.numpy() for name, tensor in tensors.items()}
        segments = tuple(
            Segment(
                Grid(**{**entry, "origin": tuple(entry["origin"])}),
                *(
                    values[f"segment{i}.{name}"]
                    for name in ("odometry_from_map", "geometric", "observed", "supporting", "felt")
                ),
            )
            for i, entry in enumerate(description["grids"])
        )
        chunks = {name.partition(".")[2]: value for name, value in values.items() if name.startswith("chunks.")}
        return RecordingSamples(
            name=description["name"],
            cameras=tuple(
                CameraModel(
                    entry["width"], entry["height"], np.array(entry["matrix"]), np.array(entry["distortion"]),
                    entry["distortion_model"],
                )
                for entry in description["cameras"]
            ),
            images=tensors["images"],
            segments=segments,
            chunks=Chunks(**chunks, history=description["history"]),
            **{
                name: values[name]
                for name in (
                    "stamps", "odometry_from_base", "odometry_from_cameras", "support", "sweeps", "sweep_ends",
                    "segment_of",
                )
            },
        )  # fmt: skip
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        if isinstance(error, SamplesError):
            raise
        raise SamplesError(f"{file}: damaged ({error}); delete it, it is made again") from error


def _cut(
    bag: Path,
    robot: RobotModel,
    config: EncoderConfig,
    settings: SampleSettings,
    image_topics: Sequence[str],
) -> tuple[dict[str, torch.Tensor], dict]:
    recording = Recording.open(bag)
    topics = tuple(image_topics) or tuple(topic for topic in recording.images if topic in recording.cameras)
    unknown = [topic for topic in topics if topic not in recording.images or topic not in recording.cameras]
    if unknown or not topics:
        raise SamplesError(
            f"{bag}: no images with a CameraInfo beside them on {unknown or 'any topic'}; images are on "
            f"{sorted(recording.images)}, calibrations of {sorted(recording.cameras)}"
        )
    if not len(recording.commands):
        raise SamplesError(f"{bag}: no commands (Twist or TwistStamped): the physics needs them")
    motion = smooth(corrected_motion(recording.motion, robot.effects)).motion
    commands = corrected_commands(recording.commands, robot.effects)
    segments = _segments(recording, motion, commands, robot, settings)
    samples = _read_images(recording, motion, robot, config, settings, topics, [start for start, _ in segments])
    windows = cut_windows(motion, commands, length=CHUNK, stride=settings.chunk_period)
    tensors = {
        **samples,
        "chunks.stamps": np.array([state.stamp for state in windows.starts]),
        "chunks.times": windows.times,
        "chunks.positions": windows.positions,
        "chunks.rotations": windows.rotations,
        "chunks.velocities": windows.velocities[:, 0],
        "chunks.angular_velocities": windows.angular_velocities[:, 0],
        "chunks.twists": windows.twists.astype(np.float32),
    }
    for i, (_, segment) in enumerate(segments):
        for name in ("odometry_from_map", "geometric", "observed", "supporting", "felt"):
            tensors[f"segment{i}.{name}"] = getattr(segment, name)
    description = {
        "version": _VERSION,
        "name": bag.name,
        "history": windows.history,
        "grids": [asdict(segment.grid) for _, segment in segments],
        "cameras": [
            {
                "width": camera.width, "height": camera.height, "matrix": camera.matrix.tolist(),
                "distortion": camera.distortion.tolist(), "distortion_model": camera.distortion_model,
            }
            for camera in (recording.cameras[topic] for topic in topics)
        ],
    }  # fmt: skip
    return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in tensors.items()}, description


def _segments(
    recording: Recording,
    motion: MotionTrack,
    commands: CommandTrack,
    robot: RobotModel,
    settings: SampleSettings,
) -> list[tuple[int, Segment]]:
    """Maps along the drive, with the start of each [ns]."""
    # The maps reach as far as any sample's own map can.
    fitting = FitSettings(margin=7.5, iterations=settings.iterations)
    first, last = int(motion.stamps[0]), int(motion.stamps[-1])
    starts = range(first, max(first + 1, last - round(1e9 * _LENGTH) + 1), round(1e9 * _STRIDE))
    segments, why = [], ""
    for start in starts:
        try:
            grid, pose = trajectory_grid(motion, start, _LENGTH, fitting), trajectory_frame(motion, start)
            visible = None
            if recording.clouds:
                seen = start - round(1e9 * _SEEN_BEFORE), start + round(1e9 * (_LENGTH + _SEEN_AFTER))
                visible = visible_terrain(recording, motion, robot, grid, pose, start=seen[0], stop=seen[1])
            fit = fit_terrain(motion, commands, robot, start=start, length=_LENGTH, visible=visible, settings=fitting)
        except (TerrainError, ValueError) as error:
            why = str(error)
            continue
        terrain = fit.terrain
        observed = visible.observed.numpy() if visible is not None else np.zeros_like(fit.felt)
        segments.append(
            (
                start,
                Segment(
                    grid, pose, terrain.geometric_height.numpy().astype(np.float32), observed,
                    terrain.height.numpy().astype(np.float32), fit.felt,
                ),
            )
        )  # fmt: skip
    if not segments:
        raise SamplesError(f"{recording.path}: no terrain could be fitted: {why}")
    return segments


def _read_images(
    recording: Recording,
    motion: MotionTrack,
    robot: RobotModel,
    config: EncoderConfig,
    settings: SampleSettings,
    topics: Sequence[str],
    starts: list[int],
) -> dict[str, np.ndarray]:
    """Images, poses and points under the wheels of every sample."""
    end = min(int(motion.stamps[-1]) - round(1e9 * CHUNK), starts[-1] + round(1e9 * _LENGTH))
    chosen = []
    for frame in recording.images[topics[0]]:
        late_enough = not chosen or frame.stamp - chosen[-1].stamp >= settings.period * 1e9 - 1e6
        if starts[0] <= frame.stamp <= end and late_enough:
            chosen.append(frame)
    matched = []
    for frame in chosen:
        others = [min(recording.images[topic], key=lambda e, at=frame.stamp: abs(e.stamp - at)) for topic in topics[1:]]
        if all(abs(other.stamp - frame.stamp) <= _MATCH for other in others):
            matched.append((frame, *others))
    pixels = [
        {f.stamp: network_image(p, config) for f, p in recording.images_of([row[i] for row in matched])}
        for i in range(len(topics))
    ]
    mounted = [
        recording.sensor_pose(recording.cameras[topic].frame_id, robot.base_frame, robot.sensors) for topic in topics
    ]
    rows: dict[str, list] = {name: [] for name in (
        "images", "stamps", "odometry_from_base", "odometry_from_cameras", "support", "segment_of"
    )}  # fmt: skip
    for frames in matched:
        if any(frame.stamp not in pixels[i] for i, frame in enumerate(frames)):
            continue
        try:
            states = [motion.at(frame.stamp, maximum_gap=0.3) for frame in frames]
        except StaleDataError:
            continue
        state = states[0]
        under = support_points(robot, state, config.stiffness)
        placed = state.odometry_from_terrain
        rows["images"].append(np.stack([pixels[i][frame.stamp] for i, frame in enumerate(frames)]))
        rows["stamps"].append(state.stamp)
        rows["odometry_from_base"].append(state.odometry_from_base)
        rows["odometry_from_cameras"].append(
            np.stack([s.odometry_from_base @ pose for s, pose in zip(states, mounted, strict=True)])
        )
        rows["support"].append(under @ placed[:3, :3].T + placed[:3, 3])
        rows["segment_of"].append(max(i for i, start in enumerate(starts) if start <= state.stamp))
    if not rows["stamps"]:
        raise SamplesError(f"{recording.path}: no image lies within the odometry, with one second of motion after it")
    arrays = {name: np.array(values) for name, values in rows.items()}
    sweeps = _sweeps_near(recording, motion, robot, arrays["stamps"])
    joined = np.concatenate(sweeps) if sweeps else np.zeros((0, 3))
    return {
        **arrays,
        "sweeps": joined.astype(np.float32),
        "sweep_ends": np.cumsum([len(points) for points in sweeps], dtype=np.int64),
    }


def _sweeps_near(recording: Recording, motion: MotionTrack, robot: RobotModel, stamps: np.ndarray) -> list[np.ndarray]:
    """Sweep nearest to each stamp, as :attr:`RecordingSamples.sweeps` keeps them."""
    clouds = np.array([frame.stamp for frame in recording.clouds], np.int64)
    nearest: dict[int, list[int]] = {}
    for index, stamp in enumerate(stamps):
        match = nearest_stamp(clouds, int(stamp), limit=_SWEEP_MATCH * 1e-9)
        if match is not None:
            nearest.setdefault(int(clouds[match]), []).append(index)
    found = [np.zeros((0, 3))] * len(stamps)
    first, last = (min(nearest), max(nearest)) if nearest else (0, -1)
    for frame, points, frame_id in recording.clouds_between(first, last):
        if frame.stamp not in nearest:
            continue
        try:
            state = motion.at(frame.stamp, maximum_gap=0.3)
        except StaleDataError:
            continue
        pose = recording.sensor_pose(frame_id, robot.base_frame, robot.sensors)
        points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
        points = transform_points(state.odometry_from_base, points[~robot.covers(points)])
        for index in nearest[frame.stamp]:
            found[index] = points
    return found


def _fingerprint(
    bag: Path, robot: RobotModel, config: EncoderConfig, settings: SampleSettings, image_topics: Sequence[str]
) -> str:
    """Of everything that decides what the samples are."""
    files = sorted(p for p in bag.rglob("*") if p.is_file()) if bag.is_dir() else [bag]
    if not bag.exists():
        raise BagError(f"{bag} does not exist")
    content = [_VERSION, [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files], robot.name]
    shape = hashlib.sha256(robot.points.numpy().tobytes()).hexdigest()
    content += [shape, robot.mass, robot.effects, asdict(settings), list(image_topics)]
    content += [config.image_width, config.image_height]
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()
