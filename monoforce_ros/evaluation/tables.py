"""Tables: errors of terrain sources over whole recordings, as in the paper's Tables I to III (IV-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student_t

from monoforce_ros.bags import Recording, chosen_cameras
from monoforce_ros.encoder import fused, load_encoder, packed
from monoforce_ros.evaluation.metrics import Poses, position_errors, rotation_errors
from monoforce_ros.evaluation.recording_evaluation import (
    CONSTANT_VELOCITY,
    FLAT_PHYSICS,
    PHYSICS,
    RecordingEvaluation,
    evaluate_recording,
)
from monoforce_ros.perception import EncoderTerrain, TerrainSource, choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults

HORIZON = 5.0
"""Length of a window [s]."""
STRIDE = 1.0
"""Time between the starts of windows [s]."""
MINIMUM_POSES = 5
"""Number of compared poses on the map, without the start, that a window needs."""
_RESAMPLES = 4000
_HALF_MAP = 6.4
"""Half the edge length of the encoder's map [m]."""
_SENSORS = {"images": ("camera",), "point cloud": ("lidar",), "images, point cloud": ("camera", "lidar")}
"""Of an encoder, by the input of a system."""
DISTANCES = (0.0, 1.0, 2.5, _HALF_MAP)
"""Limits of the distances from the start by which errors are listed [m]."""


@dataclass(frozen=True)
class System:
    """A terrain source of the comparison, and its names."""

    key: str
    title: str
    input: str
    checkpoint: Path | None = None
    with_lidar: bool = False
    """Combine the lidar's heights with the compliance that an encoder of images predicts, instead of its heights."""


@dataclass(frozen=True)
class SequenceErrors:
    """Mean errors over the windows of one recording."""

    sequence: str
    position: float
    """Δx [m] (equation 5)."""
    rotation: float
    """ΔR [deg] (equation 6)."""
    windows: int
    worst: int = 0
    """Start of the window with the largest position error [ns]; 0 without any."""
    worst_position: float = float("nan")
    """Its error [m]."""
    by_distance: dict[str, float] = field(default_factory=dict)
    """Mean position error [m] of poses by how far the robot has come from the start, see :data:`DISTANCES`."""
    stamps: tuple[int, ...] = ()
    """Start of each window [ns], the same for all systems."""
    positions: tuple[float, ...] = ()
    """Δx of each window [m]; NaN where the prediction diverged, which the means leave out."""
    rotations: tuple[float, ...] = ()
    """ΔR of each window [deg]."""


@dataclass(frozen=True)
class Mean:
    """A mean over recordings, or a ratio of two means, with its 95 % confidence interval."""

    value: float
    low: float
    high: float


LIDAR = System("lidar", "lidar interpolation [19]", "point cloud")
FLAT = System("flat", "level ground", "none")
CONSTANT = System("constant", "constant velocity", "odometry")


def evaluate_sequence(
    bag: Path,
    robot: RobotModel,
    systems: Sequence[System],
    sources: Mapping[str, TerrainSource] | None = None,
    *,
    stride: float = STRIDE,
) -> dict[str, SequenceErrors]:
    """Errors of each system on one recording, over the same windows.

    Windows of all systems start at the same times, and end where the measured robot leaves the map.

    Args:
        bag: the recording.
        robot: its robot.
        systems: what to compare.
        sources: terrain sources of systems that have neither a checkpoint nor a name of their own, by key.
        stride: time between the starts of windows [s].

    Raises:
        BagError, CheckpointError, EvaluationError: the bag or a checkpoint cannot be used.
    """
    recording = Recording.open(bag, robot=robot).in_base_frame(robot.base_frame)
    evaluations: dict[str, RecordingEvaluation] = {}
    for system in systems:
        if system.key in (FLAT.key, CONSTANT.key):
            continue
        source = (sources or {}).get(system.key) or terrain_source(system, robot)
        topics = chosen_cameras(recording, robot).topics if "camera" in source.sensors else ()
        evaluations[system.key] = evaluate_recording(
            recording, Predictor(robot, source, horizon=HORIZON), image_topics=topics,
            horizons=(HORIZON,), stride=stride, quiet=True, minimum_duration=1.0, baselines=not evaluations,
        )  # fmt: skip
    common = set.intersection(*(set(e.stamps.tolist()) for e in evaluations.values()))
    first = next(iter(evaluations.values()))
    errors = {}
    for system in systems:
        evaluation = evaluations.get(system.key, first)
        method = {FLAT.key: FLAT_PHYSICS, CONSTANT.key: CONSTANT_VELOCITY}.get(system.key, PHYSICS)
        chosen = np.isin(evaluation.stamps, sorted(common))
        errors[system.key] = _sequence(bag.name, evaluation, method, chosen)
    return errors


def terrain_source(system: System, robot: RobotModel) -> TerrainSource:
    """The terrain source of a system."""
    if system.checkpoint is None:
        return choose_terrain_source("lidar_interpolation", robot)
    if system.with_lidar:
        return choose_terrain_source("lidar_camera", robot, checkpoint=system.checkpoint)
    encoder = packed(fused(load_encoder(system.checkpoint)))
    sensors = _SENSORS[system.input]
    # As the node does: shape says little about the material of rigid ground.
    return EncoderTerrain(encoder, robot, sensors, material=TerrainDefaults() if "lidar" in sensors else None)


def _sequence(name: str, evaluation: RecordingEvaluation, method: str, chosen: np.ndarray) -> SequenceErrors:
    measured = Poses(evaluation.measured.positions[chosen], evaluation.measured.rotations[chosen])
    predicted = evaluation.predicted[method]
    predicted = Poses(predicted.positions[chosen], predicted.rotations[chosen])
    usable = np.logical_and.accumulate(_on_map(measured), axis=1)
    position, rotation = position_errors(predicted, measured), rotation_errors(predicted, measured)
    usable[:, 0] = False
    counted = usable.sum(axis=1) >= MINIMUM_POSES

    if not counted.any():
        return SequenceErrors(name, float("nan"), float("nan"), 0)

    def of_windows(errors: np.ndarray) -> np.ndarray:
        return np.where(usable[counted], errors[counted], 0.0).sum(axis=1) / usable[counted].sum(axis=1)

    away = np.linalg.norm(measured.positions[..., :2] - measured.positions[:, :1, :2], axis=-1)
    by_distance = {}
    for low, high in pairwise(DISTANCES):
        chosen_poses = usable & counted[:, None] & (away >= low) & (away < high)
        values = position[chosen_poses & np.isfinite(position)]
        by_distance[f"{low:g} to {high:g} m"] = float(values.mean()) if len(values) else np.nan
    moved, turned = of_windows(position), of_windows(rotation)
    finite = np.isfinite(moved) & np.isfinite(turned)
    if not finite.any():
        return SequenceErrors(name, float("nan"), float("nan"), 0)
    worst = int(np.where(finite, moved, -1.0).argmax())
    stamps = evaluation.stamps[chosen][counted]
    return SequenceErrors(
        name, float(moved[finite].mean()), float(turned[finite].mean()), int(finite.sum()),
        worst=int(stamps[worst]), worst_position=float(moved[worst]), by_distance=by_distance,
        stamps=tuple(stamps.tolist()), positions=tuple(moved.tolist()), rotations=tuple(turned.tolist()),
    )  # fmt: skip


def _on_map(measured: Poses) -> np.ndarray:
    """Whether the measured robot is on the map at its window's start, ``[W, T]``."""
    heading = np.arctan2(measured.rotations[:, 0, 1, 0], measured.rotations[:, 0, 0, 0])
    offset = measured.positions[..., :2] - measured.positions[:, :1, :2]
    cosine, sine = np.cos(heading)[:, None], np.sin(heading)[:, None]
    along = cosine * offset[..., 0] + sine * offset[..., 1]
    across = cosine * offset[..., 1] - sine * offset[..., 0]
    return (np.abs(along) < _HALF_MAP) & (np.abs(across) < _HALF_MAP)


def mean_over(values: ArrayLike) -> Mean:
    """Mean with its interval over recordings and training seeds.

    Recordings are resampled: they are independent, windows of one are not. Training seeds are too few for that: the
    spread of their means, with the quantile of Student's t distribution, widens the interval.

    Args:
        values: by recording ``[n]``, or by recording and training seed ``[n, seeds]``. Recordings with a value that is
            not finite are left out.
    """
    rows = _by_recording(values)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return Mean(np.nan, np.nan, np.nan)
    return _widened(float(rows.mean()), _resampled_means(rows), [rows])


def ratio_over(values: ArrayLike, others: ArrayLike) -> Mean:
    """Ratio of two systems' means over the same recordings, with an interval by paired resampling.

    A draw has the same recordings for both systems. Training seeds of both widen the interval as in :func:`mean_over`.

    Args:
        values: as of :func:`mean_over`.
        others: of the other system, for the same recordings.
    """
    first, second = _by_recording(values), _by_recording(others)
    usable = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    first, second = first[usable], second[usable]
    if not len(first):
        return Mean(np.nan, np.nan, np.nan)
    resampled = _resampled_means(first) / _resampled_means(second)
    return _widened(float(first.mean() / second.mean()), resampled, [first, second])


def _widened(value: float, resampled: np.ndarray, systems: Sequence[np.ndarray]) -> Mean:
    """95 % interval from resampled recordings and from the means ``[n, seeds]`` of each system's training seeds."""
    low, high = (float(q) for q in np.quantile(resampled, (0.025, 0.975)))
    trained = [rows for rows in systems if rows.shape[1] > 1]
    if not trained or not value > 0.0:
        return Mean(value, low, high)
    # Of logarithms: errors differ by factors.
    variances = np.array([np.log(rows.mean(axis=0)).var(ddof=1) / rows.shape[1] for rows in trained])
    if not variances.any():
        return Mean(value, low, high)
    # Welch and Satterthwaite: seeds of one system may differ far more than those of the other.
    freedom = variances.sum() ** 2 / sum(v**2 / (rows.shape[1] - 1) for v, rows in zip(variances, trained, strict=True))
    by_seed = float(student_t.ppf(0.975, freedom) * np.sqrt(variances.sum()))
    down, up = np.log(value / low), np.log(high / value)
    return Mean(value, value * float(np.exp(-np.hypot(down, by_seed))), value * float(np.exp(np.hypot(up, by_seed))))


def _by_recording(values: ArrayLike) -> np.ndarray:
    """``[n, seeds]``."""
    array = np.asarray(values, float)
    return array[:, None] if array.ndim == 1 else array


def _resampled_means(rows: np.ndarray) -> np.ndarray:
    """Means over training seeds and resampled recordings. Every call draws the same recordings of as many."""
    recordings = np.random.default_rng(0).integers(0, len(rows), (_RESAMPLES, len(rows)))
    return rows.mean(axis=1)[recordings].mean(axis=1)
