"""Hypothesis: a robot with effects, and how far its predictions are from what a drive shows.

Windows start at fixed recorded times. A hypothesis predicts the motion in each from its measured start state and the
recorded commands; what a measurement effect does to the record is undone first. Many hypotheses are rolled out at
once: derivatives by differences cost one rollout of a larger batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, MotionTrack, WheelTrack, wrap_angle
from monoforce_ros.effects import CATALOGUE, corrected_commands, corrected_motion, drive_speeds
from monoforce_ros.physics import PhysicsOptions, State, TerrainLookup, rest_depth, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

Effects = tuple[tuple[str, Mapping[str, float]], ...]
COMPONENTS = ("along", "across", "heading")
"""Of a residual: position in the axes of the window's start [m], heading [rad]."""
HISTORY = 2.0
"""Commands before a window that delays and lags may reach back to [s]."""
_MARGIN = 1.3
"""Kept free at both ends of a stretch, so that a shifted clock still finds data [s]."""
_SHORT = 12.0
"""Stretches shorter than this start with what they were recorded for, such as a step of the command [s]."""
_LARGEST_BATCH = 1024
_LEVEL_REACH, _HILLY_REACH = 0.1, 0.3
"""Height over the lowest point of a robot up to which it may touch the ground [m]."""


@dataclass(frozen=True)
class Evidence:
    """A recorded drive on its ground."""

    smoothed: SmoothedMotion
    commands: CommandTrack
    terrain: TerrainMap | None = None
    """One map in its own frame, or None for level ground."""
    odometry_from_terrain: np.ndarray | None = None
    """Pose ``[4, 4]`` of the map."""
    halves: tuple[TerrainMap, TerrainMap] | None = None
    """Maps that each half of the sweeps gives alone."""
    turning: AngularVelocityTrack | None = None
    """What an IMU shows."""
    wheels: WheelTrack | None = None
    """Measured wheel speeds."""

    def cut(self, starts: np.ndarray, samples: np.ndarray) -> EvidenceWindows:
        """Windows from ``starts`` [ns] to the last of ``samples`` [s]."""
        return EvidenceWindows(
            self.smoothed.motion,
            self.commands,
            starts,
            float(samples[-1]),
            samples,
            self.terrain,
            self.odometry_from_terrain,
        )


@dataclass(frozen=True)
class EvidenceWindows:
    """What a hypothesis is held against."""

    motion: MotionTrack
    """Smoothed."""
    commands: CommandTrack
    starts: np.ndarray
    """Start of each window in recorded time, ``[W]`` int64 [ns]."""
    horizon: float
    """Length of a window [s]."""
    samples: np.ndarray
    """Times in a window at which residuals are taken [s], ``[K]``."""
    terrain: TerrainMap | None = None
    """One map in its own frame, or None for level ground."""
    odometry_from_terrain: np.ndarray | None = None


def window_starts(motion: MotionTrack, stretches: Sequence[slice], horizon: float, stride: float) -> np.ndarray:
    """Starts of windows that lie within stretches of odometry without a gap, ``[W]`` [ns]."""
    starts = []
    for stretch in stretches:
        first, last = int(motion.stamps[stretch.start]), int(motion.stamps[stretch.stop - 1])
        # Poses come late rather than early: the end of a short stretch is kept free, its start is not.
        lead = _MARGIN if last - first > round(_SHORT * 1e9) else 0.1
        low, high = first + round(lead * 1e9), last - round((horizon + _MARGIN) * 1e9)
        starts.extend(range(low, high + 1, round(stride * 1e9)))
    return np.array(starts, np.int64)


def subsampled(starts: np.ndarray, block: float, most: int) -> np.ndarray:
    """At most about ``most`` of the windows of a long drive: pairs of blocks [s], evenly over all of it."""
    if len(starts) <= most:
        return starts
    pairs = (starts - starts[0]) // round(2 * block * 1e9)
    numbers = np.unique(pairs)
    kept = numbers[:: -(-len(starts) // most)]
    return starts[np.isin(pairs, kept)]


def sample_motion(motion: MotionTrack, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, rotation matrices, and velocities in base axes at stamps ``[...]`` within the track."""
    shape = stamps.shape
    origin = int(motion.stamps[0])
    times = (motion.stamps - origin) * 1e-9
    at = np.clip((stamps.ravel() - origin) * 1e-9, times[0], times[-1])

    def blend(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(at, times, values[:, axis]) for axis in range(3)], axis=1).reshape(*shape, 3)

    rotations = Slerp(times, Rotation.from_quat(motion.quaternions))(at).as_matrix().reshape(*shape, 3, 3)
    return blend(motion.positions), rotations, blend(motion.linear_velocities), blend(motion.angular_velocities)


def corrected_evidence(drive: Evidence, effects: Effects) -> Evidence:
    """The drive without what a robot's file says of its sensors and clocks."""
    motion, commands = correct_measurements(drive.smoothed.motion, drive.commands, effects)
    return replace(drive, smoothed=replace(drive.smoothed, motion=motion), commands=commands)


def correct_measurements(
    motion: MotionTrack, commands: CommandTrack, effects: Effects
) -> tuple[MotionTrack, CommandTrack]:
    """The record without what measurement effects did to it: each is its own inverse with the opposite sign."""
    return corrected_motion(motion, effects), corrected_commands(commands, effects)


class Predictions:
    """Rolls out hypotheses over the windows of a drive.

    Args:
        robot: with the effects of its file.
        data: the drive.
    """

    def __init__(self, robot: RobotModel, data: EvidenceWindows):
        self.data = data
        self.options = PhysicsOptions()
        if data.terrain is None:
            self._terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
        else:
            self._terrain = data.terrain
        self._depth = rest_depth(robot, float(self._terrain.stiffness.median()))
        # The upper halves of the wheels and most of the hull meet no ground: left out, rollouts are twice as fast.
        reach = _LEVEL_REACH if data.terrain is None else _HILLY_REACH
        self.robot = robot.with_points(robot.points[:, 2] < reach - robot.ground_clearance)
        self._prepared: dict = {}
        self._index = np.rint(data.samples / self.options.time_step).astype(int)

    def residuals(self, hypotheses: Sequence[Effects]) -> np.ndarray:
        """Predicted minus measured, ``[H, W, K, 3 (COMPONENTS)]``, under the robot's own effects and each of these."""
        results: list[np.ndarray | None] = [None] * len(hypotheses)
        # Hypotheses that differ in how the record is read have other windows; the rest share one batch.
        groups: dict[tuple, list[int]] = {}
        for number, effects in enumerate(hypotheses):
            key = tuple(
                (name, tuple(sorted(parameters.items())))
                for name, parameters in effects
                if CATALOGUE[name].stage == "measurement"
            )
            names = tuple(name for name, _ in effects)
            groups.setdefault((key, names), []).append(number)
        count = max(1, _LARGEST_BATCH // max(1, len(self.data.starts)))
        for (key, _), numbers in groups.items():
            windows = self._windows(key)
            for first in range(0, len(numbers), count):
                part = numbers[first : first + count]
                for number, result in zip(part, self._roll_out(windows, [hypotheses[n] for n in part]), strict=True):
                    results[number] = result
        return np.stack(results)

    def _windows(self, key: tuple) -> dict:
        if key not in self._prepared:
            if len(self._prepared) > 40:
                self._prepared.clear()
            motion, commands = correct_measurements(
                self.data.motion, self.data.commands, tuple((name, dict(values)) for name, values in key)
            )
            self._prepared[key] = self._prepare(motion, commands)
        return self._prepared[key]

    def _prepare(self, motion: MotionTrack, commands: CommandTrack) -> dict:
        data = self.data
        stamps = data.starts[:, None] + np.rint(np.r_[0.0, data.samples] * 1e9).astype(np.int64)
        positions, rotations, linear, angular = sample_motion(motion, stamps)
        headings = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])
        turn = Rotation.from_euler("z", headings[:, 0, None]).as_matrix()
        moved = np.einsum("wji,wkj->wki", turn, positions[:, 1:] - positions[:, :1])
        turned = wrap_angle(headings[:, 1:] - headings[:, :1])
        steps = np.arange(-round(HISTORY / self.options.time_step), self._index[-1] + 1)
        asked = data.starts[:, None] + np.rint(steps * self.options.time_step * 1e9).astype(np.int64)
        if data.terrain is None:
            # On level ground every window starts at the origin, as high as its own wheels ask for.
            frame_rotation = rotations[:, 0]
            lowest = np.einsum("wij,nj->wni", frame_rotation, self._underside())[..., 2].mean(axis=1)
            place = np.stack([0 * lowest, 0 * lowest, -lowest - self._depth], axis=1)
        else:
            pose = np.linalg.inv(data.odometry_from_terrain)
            frame_rotation = pose[:3, :3] @ rotations[:, 0]
            place = positions[:, 0] @ pose[:3, :3].T + pose[:3, 3]
            place[:, 2] += self._settling(place, frame_rotation)
        heading = np.arctan2(frame_rotation[:, 1, 0], frame_rotation[:, 0, 0])
        into = Rotation.from_euler("z", heading[:, None]).as_matrix()

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)

        return {
            "moved": moved,
            "turned": turned,
            "into": into,
            "place": place,
            "twists": tensor(commands.sample(asked)),
            "history": round(HISTORY / self.options.time_step),
            "position": tensor(place),
            "rotation": tensor(frame_rotation),
            "velocity": tensor(np.einsum("wij,wj->wi", frame_rotation, linear[:, 0])),
            "angular": tensor(np.einsum("wij,wj->wi", frame_rotation, angular[:, 0])),
        }

    def _settling(self, place: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """By how much robots at ``place`` ``[W, 3]`` are to be raised to stand on the map, ``[W]`` [m].

        A map and a localisation agree about heights within centimetres; a start that deep in the ground is a jump.
        """
        underside = self._underside()
        points = place[:, None] + np.einsum("wij,nj->wni", rotation, underside)
        at = torch.as_tensor(points[..., :2], dtype=torch.float32).transpose(1, 2)
        ground = TerrainLookup(self._terrain, "bilinear", len(points))(at).height.double().numpy()
        gap = points[..., 2] - ground
        # The lower half carries: on rough ground some wheels hang in the air.
        return -np.sort(gap, axis=1)[:, : max(1, gap.shape[1] // 2)].mean(axis=1) - self._depth

    def _underside(self) -> np.ndarray:
        robot = self.robot
        return robot.points[robot.point_tangents[:, 0] < -0.97].double().numpy()

    def _roll_out(self, windows: dict, hypotheses: list[Effects]) -> list[np.ndarray]:
        count, width = len(hypotheses), len(self.data.starts)
        robot = replace(self.robot, effects=self._joined(hypotheses, width))
        with torch.no_grad():
            speeds = drive_speeds(
                robot,
                windows["twists"].repeat(count, 1, 1),
                self.options.time_step,
                history=windows["history"],
            )
            state = State(
                windows["position"].repeat(count, 1),
                windows["rotation"].repeat(count, 1, 1),
                windows["velocity"].repeat(count, 1),
                windows["angular"].repeat(count, 1),
            )
            result = rollout(self._terrain, robot, speeds, state, options=self.options, with_forces=False)
        positions = result.position[:, self._index].double().numpy().reshape(count, width, -1, 3)
        rotations = result.rotation[:, self._index].double().numpy().reshape(count, width, -1, 3, 3)
        start = windows["into"]
        away = np.einsum("wji,hwkj->hwki", start, positions - windows["place"][None, :, None])
        forward = np.einsum("wji,hwkj->hwki", start, rotations[..., :, 0])
        heading = np.arctan2(forward[..., 1], forward[..., 0])
        error = np.stack(
            [
                away[..., 0] - windows["moved"][..., 0],
                away[..., 1] - windows["moved"][..., 1],
                wrap_angle(heading - windows["turned"]),
            ],
            axis=-1,
        )
        return list(error)

    def _joined(self, hypotheses: list[Effects], width: int) -> tuple:
        """The robot's effects with each parameter as a batch: ``width`` trajectories of every hypothesis."""
        names = [name for name, _ in hypotheses[0] if CATALOGUE[name].stage != "measurement"]
        joined = dict(self.robot.effects)
        for name in names:
            values = [dict(effects)[name] for effects in hypotheses]
            joined[name] = {
                key: torch.tensor([float(v[key]) for v in values], dtype=torch.float32).repeat_interleave(width)
                for key in values[0]
            }
        return tuple(joined.items())
