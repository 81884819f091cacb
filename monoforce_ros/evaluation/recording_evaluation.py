"""RecordingEvaluation: predictions along a recording compared with the measured motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import MAXIMUM_GAP, MAXIMUM_SPREAD, Recording, flippers_at, image_frames, observe, smooth
from monoforce_ros.core import MotionState, StaleDataError, transform_points
from monoforce_ros.effects import corrected_commands, corrected_motion
from monoforce_ros.evaluation.metrics import Poses, Summary, position_errors, rotation_errors, summarise
from monoforce_ros.evaluation.twist_check import with_usable_twists
from monoforce_ros.messages import MessageError
from monoforce_ros.perception import FlatTerrain, Observation, TrustedTerrain
from monoforce_ros.physics import IdentityCache
from monoforce_ros.prediction import JointMotion, Prediction, Predictor
from monoforce_ros.reporting import progress
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults, TerrainMap

SAMPLE_TIME = 0.1
"""Time between the poses that are compared [s]."""
PHYSICS, FLAT_PHYSICS, CONSTANT_VELOCITY = "physics", "physics, flat ground", "constant velocity, flat ground"
"""Names of the methods in reports: the prediction, and two baselines."""
CONFIRMED_PHYSICS = "physics, confirmed terrain"
"""The prediction on an encoder's terrain as far as the ground has confirmed it, as ``predictor`` publishes it."""
BATCH = 16
"""Number of windows that are rolled out together."""


class EvaluationError(ValueError):
    """The recording cannot be evaluated; the message lists missing data."""


@dataclass(frozen=True)
class RecordingEvaluation:
    """Predicted and measured trajectories of the windows of a recording, in the odometry frame."""

    times: np.ndarray
    """Time since the start of a window [s], ``[T]``."""
    stamps: np.ndarray
    """Start of each window [ns], ``[W]``."""
    measured: Poses
    """``[W, T]``; NaN after the end of the odometry and in its gaps."""
    predicted: dict[str, Poses]
    """``[W, T]`` of each method."""
    inside: np.ndarray
    """Whether the measured and the predicted pose are both on the predicted map, ``[W, T]``."""
    horizons: tuple[float, ...]
    """Times at which errors are summarised [s]."""
    remarks: tuple[str, ...] = ()
    """Faults of the recording, and windows that were skipped."""

    def errors(self, method: str) -> tuple[np.ndarray, np.ndarray]:
        """Position [m] and rotation errors [deg] of a method, each ``[W, T]``."""
        return (
            position_errors(self.predicted[method], self.measured),
            rotation_errors(self.predicted[method], self.measured),
        )

    def summary(self, method: str) -> dict[float, tuple[Summary, Summary]]:
        """Δx and ΔR of a method at each horizon, over the windows that stay on the map until then."""
        position, rotation = self.errors(method)
        result = {}
        for horizon in self.horizons:
            index = round(horizon / SAMPLE_TIME)
            result[horizon] = (
                summarise(position, self.inside, index),
                summarise(rotation, self.inside, index),
            )
        return result


def evaluate_recording(
    recording: Recording,
    predictor: Predictor,
    *,
    image_topics: Sequence[str] = (),
    horizons: Sequence[float] = (1.0, 2.0, 5.0),
    stride: float = 0.4,
    minimum_duration: float | None = None,
    baselines: bool = True,
    quiet: bool = False,
) -> RecordingEvaluation:
    """Predict from many times of a recording and compare with the motion measured afterwards.

    A window starts at each cloud or image (for flat terrain, at each odometry message), at least ``stride`` apart, and
    uses the commands recorded during it.

    Args:
        recording: the recording.
        predictor: robot, terrain source and horizon; the horizon must be at least the largest of ``horizons``. With a
            source that falls back, the encoder's own terrain and the confirmed one are compared side by side.
        image_topics: cameras of a camera terrain source; windows start at images of the first one, and at those of
            others where it has none.
        horizons: times at which errors are summarised [s].
        stride: smallest time between the starts of windows [s].
        minimum_duration: odometry required after the start of a window [s]; by default the smallest horizon.
        baselines: also roll out on level ground.
        quiet: show no progress bar.

    Raises:
        EvaluationError: sensor data or commands are missing, or no window has enough odometry after it.
    """
    recording, fault = _prepared(recording, predictor.robot)
    sensors = predictor.source.sensors
    stamps = _window_stamps(recording, sensors, image_topics, stride, minimum_duration or min(horizons))
    count = round(max(horizons) / SAMPLE_TIME) + 1
    times = np.arange(count) * SAMPLE_TIME
    remarks: list[str] = [fault] if fault else []
    motions: list[MotionState] = []
    terrains: list[TerrainMap] = []
    collected: dict[str, list[Poses]] = {
        PHYSICS: [], CONFIRMED_PHYSICS: [], FLAT_PHYSICS: [], CONSTANT_VELOCITY: []
    }  # fmt: skip
    inside: list[np.ndarray] = []
    flat = FlatTerrain(predictor.robot, predictor.source.grid, TerrainDefaults())

    def roll_out_batch(batch: list[MotionState], maps: dict[str, list[TerrainMap]]) -> None:
        twists = np.stack([recording.commands.sample(predictor.command_stamps(m.stamp)) for m in batch])
        joints = recorded_joints(recording, predictor, [m.stamp for m in batch])
        compared = {method: batch_maps for method, batch_maps in maps.items() if batch_maps}
        if sensors and baselines:
            compared[FLAT_PHYSICS] = [
                flat.terrain(Observation(0, flipper_angles=flippers_at(recording, m.stamp)), m) for m in batch
            ]
        for method, batch_maps in compared.items():
            result = predictor.roll_out(TerrainMap.stack(batch_maps), batch, twists, joints=joints)
            index = np.rint(times / predictor.options.time_step).astype(int)
            for row, motion in enumerate(batch):
                transform = motion.odometry_from_terrain
                positions = result.position[row].double().numpy()[index]
                rotations = result.rotation[row].double().numpy()[index]
                collected[method].append(Poses(transform_points(transform, positions), transform[:3, :3] @ rotations))
                if method == PHYSICS:
                    inside.append(result.inside[row].numpy()[index])

    pending: list[MotionState] = []
    pending_maps: dict[str, list[TerrainMap]] = {PHYSICS: [], CONFIRMED_PHYSICS: []}
    for stamp in progress(stamps, label="predicting", unit="window", quiet=quiet):
        try:
            motion = recording.motion.at(int(stamp), maximum_gap=MAXIMUM_GAP)
            observation = observe(recording, predictor.robot, int(stamp), sensors, image_topics)
            found = predictor.source.terrain(observation, motion)
        except (StaleDataError, MessageError, ValueError) as error:
            remarks.append(f"window at {(stamp - recording.motion.stamps[0]) * 1e-9:.1f} s skipped: {error}")
            continue
        if isinstance(predictor.source, TrustedTerrain) and predictor.source.predicted is not None:
            pending_maps[CONFIRMED_PHYSICS].append(found)
            found = predictor.source.predicted
        pending.append(motion)
        pending_maps[PHYSICS].append(found)
        terrains.append(found)
        motions.append(motion)
        if len(pending) == BATCH:
            roll_out_batch(pending, pending_maps)
            pending, pending_maps = [], {PHYSICS: [], CONFIRMED_PHYSICS: []}
    if pending:
        roll_out_batch(pending, pending_maps)
    if not motions:
        raise EvaluationError(
            f"{recording.path}: every prediction failed: {remarks[0] if remarks else 'no sensor data'}"
        )
    measured = measured_poses(recording, motions, times)
    collected[CONSTANT_VELOCITY] = [constant_velocity(motion, times) for motion in motions]
    on_map = np.array(inside) & np.array(
        [
            _on_map(terrain, motion, positions)
            for terrain, motion, positions in zip(terrains, motions, measured.positions, strict=True)
        ]
    )
    return RecordingEvaluation(
        times=times,
        stamps=np.array([motion.stamp for motion in motions]),
        measured=measured,
        predicted={
            method: Poses(np.stack([p.positions for p in poses]), np.stack([p.rotations for p in poses]))
            for method, poses in collected.items()
            if poses
        },
        inside=on_map,
        horizons=tuple(horizons),
        remarks=(*recording.warnings, *remarks),
    )


def predict_at(recording: Recording, predictor: Predictor, stamp: int, image_topics: Sequence[str] = ()) -> Prediction:
    """A prediction with contact forces from the data at ``stamp`` [ns], under the commands recorded after it."""
    recording, _ = _prepared(recording, predictor.robot)
    return predictor.predict(
        observe(recording, predictor.robot, stamp, predictor.source.sensors, image_topics),
        recording.motion.at(stamp, maximum_gap=MAXIMUM_GAP),
        recording.commands.sample(predictor.command_stamps(stamp)),
        joints=recorded_joints(recording, predictor, [stamp]),
    )


def recorded_joints(recording: Recording, predictor: Predictor, stamps: Sequence[int]) -> JointMotion | None:
    """Measured joints at the starts ``[B]`` [ns] of predictions, and how the flippers were then moved.

    None where the bag has neither measured angles nor commands of the robot's joints.
    """
    if recording.joints is None:
        return None
    starts = np.array(stamps, np.int64)
    measured = recording.joints.start(starts)
    if measured is None:
        measured = np.full((len(starts), len(predictor.robot.joints)), np.nan)
    after = np.stack([predictor.command_stamps(int(stamp))[predictor.history :] for stamp in starts])
    return JointMotion.recorded(measured, recording.joints.flipper_angles(after))


_PREPARED: IdentityCache[tuple[Recording, str]] = IdentityCache(1)
"""The last recording: pictures of single predictions follow its evaluation, and smoothing its poses takes time."""


def _prepared(recording: Recording, robot: RobotModel) -> tuple[Recording, str]:
    """The corrected recording with usable velocities, and what was wrong with its own."""

    def prepared() -> tuple[Recording, str]:
        corrected = corrected_recording(recording, robot)
        motion, fault = with_usable_twists(corrected.motion, smooth(corrected.motion).motion)
        return replace(corrected, motion=motion), fault

    return _PREPARED.get((recording, robot), prepared)


def corrected_recording(recording: Recording, robot: RobotModel) -> Recording:
    """The recording corrected for the measurement effects (clocks, sensors) in the robot's file."""
    return replace(
        recording,
        motion=corrected_motion(recording.motion, robot.effects),
        commands=corrected_commands(recording.commands, robot.effects),
    )


def measured_poses(recording: Recording, motions: list[MotionState], times: np.ndarray) -> Poses:
    """Measured poses ``[W, T]`` after each motion; NaN after the end of the odometry and in its gaps."""
    stamps = np.array([m.stamp for m in motions])[:, None] + np.rint(times * 1e9).astype(np.int64)
    positions = np.full((*stamps.shape, 3), np.nan)
    rotations = np.full((*stamps.shape, 3, 3), np.nan)
    last = recording.motion.stamps[-1]
    for index in np.ndindex(stamps.shape):
        if stamps[index] <= last:
            try:
                state = recording.motion.at(int(stamps[index]), maximum_gap=MAXIMUM_GAP)
            except StaleDataError:
                continue
            positions[index], rotations[index] = state.position, state.rotation
    return Poses(positions, rotations)


def constant_velocity(motion: MotionState, times: np.ndarray) -> Poses:
    """Baseline: the horizontal velocity and yaw rate of the start are held, as are its height, roll and pitch."""
    (speed, sideways), rate = motion.linear_velocity[:2], motion.angular_velocity[2]
    angles = rate * times
    # ∫ cos(ωt) and ∫ sin(ωt) without dividing by ω, so that ω = 0 is no special case.
    cosine = times * np.sinc(angles / np.pi)
    sine = times * np.sin(angles / 2) * np.sinc(angles / 2 / np.pi)
    along, across = speed * cosine - sideways * sine, speed * sine + sideways * cosine
    heading = motion.heading
    positions = motion.position + np.stack(
        [
            np.cos(heading) * along - np.sin(heading) * across,
            np.sin(heading) * along + np.cos(heading) * across,
            np.zeros_like(along),
        ],
        axis=-1,
    )
    return Poses(positions, Rotation.from_euler("z", angles[:, None]).as_matrix() @ motion.rotation)


def _window_stamps(
    recording: Recording, sensors: Sequence[str], image_topics: Sequence[str], stride: float, minimum_duration: float
) -> np.ndarray:
    if not sensors:
        candidates = recording.motion.stamps
    elif "camera" in sensors and image_topics:
        unknown = [topic for topic in image_topics if topic not in recording.images]
        if unknown:
            raise EvaluationError(f"{recording.path}: no images on {unknown}; there are {sorted(recording.images)}")
        frames = image_frames(recording, image_topics, MAXIMUM_SPREAD)
        candidates = np.array([frame.stamp for frame in frames], np.int64)
    else:
        clouds = () if "camera" in sensors else recording.clouds
        candidates = np.array([frame.stamp for frame in clouds], np.int64)
    if not len(candidates):
        missing = "images" if "camera" in sensors else "point clouds"
        raise EvaluationError(
            f"{recording.path}: no {missing} to predict from; `--terrain flat` needs only odometry and commands"
        )
    if not len(recording.commands):
        raise EvaluationError(f"{recording.path}: no commands (Twist or TwistStamped), which predictions need")
    frame_stamps = candidates.tolist()
    end = recording.motion.stamps[-1] - int(minimum_duration * 1e9)
    candidates = candidates[(candidates >= recording.motion.stamps[0]) & (candidates <= end)]
    chosen: list[int] = []
    for stamp in candidates:
        if not chosen or stamp - chosen[-1] >= stride * 1e9 - 1e6:
            chosen.append(int(stamp))
    if not chosen:
        first, last = (int(recording.motion.stamps[i]) * 1e-9 for i in (0, -1))
        times = f"{min(frame_stamps) * 1e-9:.1f} to {max(frame_stamps) * 1e-9:.1f} s"
        raise EvaluationError(
            f"{recording.path}: no sensor data with {minimum_duration:g} s of odometry after it: the data are of "
            f"{times}, the odometry of {first:.1f} to {last:.1f} s; evaluate --check says more"
        )
    return np.array(chosen, np.int64)


def _on_map(terrain: TerrainMap, motion: MotionState, positions: np.ndarray) -> np.ndarray:
    local = transform_points(np.linalg.inv(motion.odometry_from_terrain), positions)
    _, _, inside = terrain.grid.cells(np.nan_to_num(local[:, :2], nan=np.inf))
    return inside
