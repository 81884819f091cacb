"""Sample extraction: a bag with images, odometry, commands and lidar → the samples of a recording."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import (
    DETECTED,
    BagError,
    Frame,
    ReadOptions,
    Recording,
    chosen_cameras,
    cut_windows,
    image_frames,
    smooth,
)
from monoforce_ros.core import NANOSECOND, CommandTrack, MotionTrack, StaleDataError, nearest_stamp, transform_points
from monoforce_ros.effects import corrected_commands, corrected_motion
from monoforce_ros.encoder import EncoderConfig, network_image
from monoforce_ros.perception import support_points, traced_ground
from monoforce_ros.robots import RobotModel, robot_digest
from monoforce_ros.terrain import TerrainError
from monoforce_ros.training.recording_samples import (
    CHUNK,
    SAMPLES_VERSION,
    Chunks,
    RecordingSamples,
    SamplesError,
    Segment,
    save_samples,
)
from monoforce_ros.training.terrain_fit import FitSettings, fit_terrain, trajectory_frame, trajectory_grid
from monoforce_ros.training.visible import visible_terrain

_EXTRACTION = 2
"""Version of what is extracted: files of samples of an earlier one are not used."""
_LENGTH, _STRIDE = 10.0, 5.0
"""Length of the trajectories to which terrain is fitted (paper IV-A), and interval between their starts [s]."""
_SWEEPS_BEFORE, _SWEEPS_AFTER = 2.0, 2.0
"""Sweeps this long before and after a trajectory belong to its map too [s]."""
TARGET_REACH = _LENGTH + _SWEEPS_AFTER
"""How long after the first sample of a segment its target may have been measured [s], at most."""
_MATCH = 0.1
"""Largest difference between stamps of images that belong to one sample [s]."""
_SLOWER = 1.5
"""Median interval of the samples, relative to the wanted one, from which on they are slower: one that is no multiple of
the images' interval alternates between two."""
_JITTER = 1_000_000
"""By how much an image may come before its sample is due [ns]."""
_POSE_GAP = 0.3
"""Largest time between sensor data and the nearest odometry [s]."""
_TRACE_STEP, _TRACE_POSES = 0.1, 3000
"""Distance between poses of the path driven before a sample [m], and the largest number of poses looked at."""
_SWEEP_MATCH = 0.15
"""Largest difference between the stamps of a sample and its lidar sweep [s]."""


@dataclass(frozen=True)
class SampleSettings:
    """How samples are extracted from a recording."""

    period: float = 0.5
    """Mean interval between samples [s]; at least that of the images."""
    chunk_period: float = 0.5
    """Interval between the starts of chunks of motion [s]."""
    iterations: int = 0
    """Steps of each terrain fit; without any, H_t* is the surface traced by the wheels. With the noise of a real
    localisation fitted heights predict the drive no better (benchmarks/terrain_fit.py)."""
    reading: ReadOptions = DETECTED
    """Topics and frames of the recordings, where they do not say themselves."""

    def __post_init__(self):
        for name, low, high in (("period", 0.02, 60.0), ("chunk_period", 0.1, 10.0), ("iterations", 0, 10_000)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"samples {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")


def extract_samples(
    bag: Path,
    robot: RobotModel,
    config: EncoderConfig,
    folder: Path,
    *,
    settings: SampleSettings = SampleSettings(),
    image_topics: Sequence[str] = (),
) -> Path:
    """Extract a bag's samples into a file, unless there is one for the same bag, robot and settings; return its path.

    Encoders of sweeps alone have samples at sweeps, whether or not there are images.

    Raises:
        SamplesError: the recording has no calibrated images, no commands, or is too short.
        BagError: the bag cannot be read.
    """
    fingerprint = _fingerprint(bag, robot, config, settings, image_topics)
    file = folder / f"{bag.name.removesuffix('.bag')}-{fingerprint[:8]}.safetensors"
    if not config.takes_images:
        # Encoders of cameras cannot use these.
        file = file.with_name(f"{file.stem}-sweeps{file.suffix}")
    if not file.is_file():
        save_samples(_samples(bag, robot, config, settings, image_topics), file)
    return file


def _samples(
    bag: Path,
    robot: RobotModel,
    config: EncoderConfig,
    settings: SampleSettings,
    image_topics: Sequence[str],
) -> RecordingSamples:
    recording = settings.reading.open(bag, robot)
    robot = settings.reading.robot_in_bag(robot)
    topics = _camera_topics(recording, robot, image_topics) if config.takes_images else ()
    if not topics and not recording.clouds:
        raise SamplesError(f"{bag}: no clouds and no usable images")
    if not len(recording.commands):
        raise SamplesError(f"{bag}: no commands (Twist or TwistStamped), which the physics needs")
    smoothed = smooth(corrected_motion(recording.motion, robot.effects))
    motion = smoothed.motion
    commands = corrected_commands(recording.commands, robot.effects)
    spans = [(int(motion.stamps[part][0]), int(motion.stamps[part][-1])) for part in smoothed.stretches]
    segments = _segments(recording, motion, commands, robot, settings, spans)
    places = [(start, end) for start, end, _ in segments]
    arrays = _read_images(recording, motion, robot, config, settings, topics, places, spans)
    windows = cut_windows(motion, commands, length=CHUNK, stride=settings.chunk_period, stretches=smoothed.stretches)
    chunks = Chunks(
        stamps=np.array([state.stamp for state in windows.starts]),
        times=windows.times,
        positions=windows.positions,
        rotations=windows.rotations,
        velocities=windows.velocities[:, 0],
        angular_velocities=windows.angular_velocities[:, 0],
        twists=windows.twists.astype(np.float32),
        history=windows.history,
    )
    return RecordingSamples(
        name=bag.name,
        cameras=tuple(recording.cameras[topic] for topic in topics),
        images=torch.from_numpy(arrays.pop("images")),
        segments=tuple(segment for _, _, segment in segments),
        chunks=chunks,
        file=None,
        **arrays,
    )


def _camera_topics(recording: Recording, robot: RobotModel, image_topics: Sequence[str]) -> tuple[str, ...]:
    """Image topics of the cameras that can be used; others are named on standard error.

    Raises:
        SamplesError: there is none, or one of ``image_topics`` is absent or without a
            CameraInfo.
    """
    unknown = [topic for topic in image_topics if topic not in recording.images or topic not in recording.cameras]
    if unknown or not recording.cameras:
        raise SamplesError(
            f"{recording.path}: no images with a CameraInfo on {unknown or 'any topic'}; images are on "
            f"{sorted(recording.images)}, CameraInfo is available for {sorted(recording.cameras)}"
        )
    # Images without a CameraInfo, such as overlays for debugging, are none of a camera.
    choice = chosen_cameras(recording, robot, tuple(image_topics) or tuple(recording.cameras))
    if not choice.topics:
        reasons = "; ".join(f"{topic}: {reason}" for topic, reason in choice.left_out.items())
        raise SamplesError(f"{recording.path}: no usable image: {reasons}")
    for remark in choice.remarks:
        print(f"{recording.path}: {remark}; --images chooses topics", file=sys.stderr)
    return choice.topics


def _segments(
    recording: Recording,
    motion: MotionTrack,
    commands: CommandTrack,
    robot: RobotModel,
    settings: SampleSettings,
    spans: Sequence[tuple[int, int]],
) -> list[tuple[int, int, Segment]]:
    """Segments along the recording, with the start of each and the end of the samples that may lie in it [ns].

    None spans a jump of the localisation, after which all lies elsewhere: ``spans`` are the stretches between [ns].
    """
    # The margin covers the map of any sample on the trajectory.
    fitting = FitSettings(margin=7.5, iterations=settings.iterations)
    starts = [
        (start, first, last)
        for first, last in spans
        for start in range(first, max(first + 1, last - round(1e9 * _LENGTH) + 1), round(1e9 * _STRIDE))
    ]
    segments: list[tuple[int, int, Segment]] = []
    reason = ""
    for start, first, last in starts:
        try:
            grid, pose = trajectory_grid(motion, start, _LENGTH, fitting), trajectory_frame(motion, start)
            visible = None
            if recording.clouds:
                first_sweep = max(start - round(1e9 * _SWEEPS_BEFORE), first)
                last_sweep = min(start + round(1e9 * (_LENGTH + _SWEEPS_AFTER)), last)
                visible = visible_terrain(recording, motion, robot, grid, pose, start=first_sweep, stop=last_sweep)
            fit = fit_terrain(motion, commands, robot, start=start, length=_LENGTH, visible=visible, settings=fitting)
        except (TerrainError, ValueError) as error:
            reason = str(error)
            continue
        terrain = fit.terrain
        observed = visible.observed.numpy() if visible is not None else np.zeros_like(fit.contact_mask)
        segments.append(
            (
                start,
                last,
                Segment(
                    grid, pose, terrain.geometric_height.numpy().astype(np.float32), observed,
                    terrain.height.numpy().astype(np.float32), fit.contact_mask,
                    np.full(fit.contact_mask.shape, np.nan, np.float32),
                ),
            )
        )  # fmt: skip
    if not segments:
        raise SamplesError(f"{recording.path}: no terrain could be fitted: {reason}")
    return segments


def _read_images(
    recording: Recording,
    motion: MotionTrack,
    robot: RobotModel,
    config: EncoderConfig,
    settings: SampleSettings,
    topics: Sequence[str],
    places: Sequence[tuple[int, int]],
    spans: Sequence[tuple[int, int]],
) -> dict[str, np.ndarray]:
    """Images, poses, contact points of the wheels and sweeps of every sample.

    A sample has the images of the cameras that have one near its stamp; a camera may begin late, die early or be slow.
    ``places`` are starts of the segments and ends of what may lie in them, ``spans`` those of the stretches between
    jumps of the localisation [ns].
    """
    starts = [start for start, _ in places]
    end = min(int(motion.stamps[-1]) - round(1e9 * CHUNK), starts[-1] + round(1e9 * _LENGTH))
    period = round(1e9 * settings.period)
    matched: list[tuple[int, dict[int, Frame]]] = []
    due = starts[0]
    stamps = [np.array([frame.stamp for frame in recording.images[topic]], np.int64) for topic in topics]
    for frame in image_frames(recording, topics, _MATCH) if topics else recording.clouds:
        if not (starts[0] <= frame.stamp <= end and frame.stamp >= due - _JITTER):
            continue
        # A period that is no multiple of the images' interval holds on average.
        due = (due if frame.stamp - due < period else frame.stamp) + period
        nearest = {i: nearest_stamp(times, frame.stamp, limit=_MATCH) for i, times in enumerate(stamps)}
        found = {i: recording.images[topics[i]][place] for i, place in nearest.items() if place is not None}
        matched.append((frame.stamp, found))
    views = [
        _views(recording, motion, robot, config, topic, [found[i] for _, found in matched if i in found])
        for i, topic in enumerate(topics)
    ]
    blank = np.zeros((config.image_height, config.image_width, 3), np.uint8), np.full((4, 4), np.nan)
    rows: dict[str, list] = {name: [] for name in (
        "images", "stamps", "odometry_from_base", "odometry_from_cameras", "support", "segment_of"
    )}  # fmt: skip
    for stamp, found in matched:
        seen = {i: views[i][frame.stamp] for i, frame in found.items() if frame.stamp in views[i]}
        segment = max((i for i, start in enumerate(starts) if start <= stamp), default=-1)
        if (topics and not seen) or segment < 0 or stamp > places[segment][1]:
            continue
        try:
            state = motion.at(stamp, maximum_gap=_POSE_GAP)
        except StaleDataError:
            continue
        under = support_points(robot, state, config.stiffness)
        placed = state.odometry_from_terrain
        each = [seen.get(i, blank) for i in range(len(topics))]
        rows["images"].append(np.array([pixels for pixels, _ in each], np.uint8).reshape(-1, *blank[0].shape))
        rows["stamps"].append(stamp)
        rows["odometry_from_base"].append(state.odometry_from_base)
        rows["odometry_from_cameras"].append(np.array([pose for _, pose in each]).reshape(-1, 4, 4))
        rows["support"].append(under @ placed[:3, :3].T + placed[:3, 3])
        rows["segment_of"].append(segment)
    if not rows["stamps"]:
        raise SamplesError(
            f"{recording.path}: no {'image' if topics else 'cloud'} is within the odometry and followed by one second "
            "of motion"
        )
    arrays = {name: np.array(values) for name, values in rows.items()}
    _report_missing(recording, topics, arrays)
    interval = float(np.median(np.diff(arrays["stamps"]))) * NANOSECOND if len(arrays["stamps"]) > 1 else 0.0
    if interval > _SLOWER * settings.period:
        print(
            f"{recording.path}: a sample every {interval:.2g} s instead of {settings.period:.2g} s: "
            f"{'images' if topics else 'clouds'} come no more often",
            file=sys.stderr,
        )
    sweeps = _sweeps_near(recording, motion, robot, arrays["stamps"])
    joined = np.concatenate(sweeps) if sweeps else np.zeros((0, 3))
    begins = [max((first for first, _ in spans if first <= stamp), default=0) for stamp in arrays["stamps"].tolist()]
    traces = [_trace(motion, robot, int(stamp), first) for stamp, first in zip(arrays["stamps"], begins, strict=True)]
    return {
        **arrays,
        "traces": np.concatenate(traces).astype(np.float32),
        "trace_ends": np.cumsum([len(points) for points in traces], dtype=np.int64),
        "sweeps": joined.astype(np.float32),
        "sweep_ends": np.cumsum([len(points) for points in sweeps], dtype=np.int64),
    }


def _views(
    recording: Recording,
    motion: MotionTrack,
    robot: RobotModel,
    config: EncoderConfig,
    topic: str,
    frames: Sequence[Frame],
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Image at the network's size and pose ``[4, 4]`` of the camera in the odometry frame, by stamp [ns]; of images of
    the camera's size, with a pose."""
    camera = recording.cameras[topic]
    found = {}
    for frame, image in recording.images_of(frames):
        try:
            camera.check_image(image)
            mounted = recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors, frame.stamp)
            pose = motion.at(frame.stamp, maximum_gap=_POSE_GAP).odometry_from_base @ mounted
        except ValueError:
            continue
        found[frame.stamp] = network_image(image, config), pose
    return found


def _report_missing(recording: Recording, topics: Sequence[str], arrays: dict[str, np.ndarray]) -> None:
    """Name cameras without an image for some samples."""
    shown = np.isfinite(arrays["odometry_from_cameras"]).all(axis=(2, 3))
    start, stamps = int(arrays["stamps"][0]), arrays["stamps"]
    for topic, has in zip(topics, shown.T, strict=True):
        if has.all():
            continue
        times = (
            [f"{float(stamps[i] - start) * NANOSECOND:.1f}" for i in np.flatnonzero(has)[[0, -1]]] if has.any() else []
        )
        between = f", from {' to '.join(times)} s after the first" if times else ""
        print(
            f"{recording.path}: {topic} has usable images for {has.sum()} of {len(has)} samples{between}; the others "
            "are of the remaining cameras",
            file=sys.stderr,
        )


def _trace(motion: MotionTrack, robot: RobotModel, stamp: int, since: int = 0) -> np.ndarray:
    """Ground that the robot drove over before a time, from ``since`` on ``[k, 3]``, in the odometry frame [m]."""
    before = (motion.stamps <= stamp) & (motion.stamps >= since)
    # One pose in ten centimetres is needed, and odometry may be far denser.
    recent = np.flatnonzero(before)[-_TRACE_POSES:]
    poses = np.tile(np.eye(4), (len(recent), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(motion.quaternions[recent]).as_matrix()
    poses[:, :3, 3] = motion.positions[recent]
    return traced_ground(robot, poses, _TRACE_STEP)


def _sweeps_near(recording: Recording, motion: MotionTrack, robot: RobotModel, stamps: np.ndarray) -> list[np.ndarray]:
    """Sweep nearest to each stamp, in the odometry frame, empty if there is none."""
    clouds = np.array([frame.stamp for frame in recording.clouds], np.int64)
    nearest: dict[int, list[int]] = {}
    for index, stamp in enumerate(stamps):
        match = nearest_stamp(clouds, int(stamp), limit=_SWEEP_MATCH)
        if match is not None:
            nearest.setdefault(int(clouds[match]), []).append(index)
    found = [np.zeros((0, 3))] * len(stamps)
    first, last = (min(nearest), max(nearest)) if nearest else (0, -1)
    for frame, points, frame_id in recording.clouds_between(first, last):
        if frame.stamp not in nearest:
            continue
        try:
            state = motion.at(frame.stamp, maximum_gap=_POSE_GAP)
        except StaleDataError:
            continue
        pose = recording.sensor_pose(frame_id, robot.base_frame, robot.sensors, frame.stamp)
        points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
        points = transform_points(state.odometry_from_base, points[~robot.covers(points)])
        for index in nearest[frame.stamp]:
            found[index] = points
    return found


def _fingerprint(
    bag: Path, robot: RobotModel, config: EncoderConfig, settings: SampleSettings, image_topics: Sequence[str]
) -> str:
    """Hash of everything that determines the samples."""
    files = sorted(p for p in bag.rglob("*") if p.is_file()) if bag.is_dir() else [bag]
    if not bag.exists():
        raise BagError(f"{bag} does not exist")
    content = [
        SAMPLES_VERSION,
        _EXTRACTION,
        [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files],
        robot.name,
    ]
    content += [robot_digest(robot), asdict(settings), list(image_topics)]
    content += [config.image_width, config.image_height, config.stiffness]
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()
