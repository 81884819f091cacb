"""Hypothesis: a robot with assumed effects, and the residuals of its predictions on a recording.

Windows start at fixed recorded times. A hypothesis predicts the motion in each from its measured start state and the
recorded commands; the recording is first corrected for the hypothesis' measurement effects. Many hypotheses are rolled
out at once: finite-difference derivatives cost one rollout of a larger batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack, MotionTrack, transform_points, wrap_angle
from monoforce_ros.discrepancy.attitude import Lean, lean_of, vertical
from monoforce_ros.discrepancy.evidence import (
    ATTITUDE,
    MOTION,
    RATE_TIME,
    Evidence,
    EvidenceWindows,
    Place,
    rate_means,
    rate_stamps,
    sample_motion,
)
from monoforce_ros.discrepancy.local_rollout import (
    Driven,
    Effects,
    GroundPart,
    local_rollout,
    moves_rigidly,
    outside_values,
)
from monoforce_ros.effects import CATALOGUE, applied_setup, controls, corrected_commands, corrected_motion
from monoforce_ros.physics import PhysicsOptions, State, TerrainLookup, rest_depth, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

HISTORY = 4.0
"""Length of the commands before a window, for delays, lags and the integral part of drives [s]."""
_LARGEST_BATCH = 1024
"""Trajectories that are rolled out together: it bounds the memory, and changes no result."""
_LEAN = slice(len(MOTION), len(MOTION) + 2)
"""Roll and pitch among the components of a residual."""
_LEVEL_REACH, _HILLY_REACH = 0.1, 0.3
"""Height above a robot's lowest point up to which contact points are kept [m]."""


def residuals_by_part(
    robot: RobotModel, data: EvidenceWindows, parts: np.ndarray, effects: Sequence[Effects]
) -> np.ndarray:
    """Predicted minus measured, ``[W, K, C]``, each window with the effects of its part.

    Args:
        robot: robot with the effects of its file.
        data: the windows.
        parts: number of the part of each, ``[W]``.
        effects: by part.
    """
    return Predictions(robot, data).residuals_by_part(parts, effects)


def values_key(effects: Effects) -> tuple[tuple[object, ...], ...]:
    """Names, parameters and values of effects as a key."""
    return tuple((name, *values.items()) for name, values in effects)


def own_values(robot: RobotModel, name: str) -> dict[str, float]:
    """Values of an effect in the robot's file; none of sensors and clocks, for which the recording was corrected."""
    values = {} if CATALOGUE[name].stage == "measurement" else dict(robot.effects).get(name, {})
    return {key: float(value) for key, value in values.items()}


def corrected_evidence(evidence: Evidence, robot: RobotModel) -> Evidence:
    """The evidence corrected for the sensor and clock errors in a robot's file.

    The motion comes from poses: what the gyro measures beside them does not change it.
    """
    effects = tuple(
        (name, {key: float(value) for key, value in values.items()})
        for name, values in robot.effects
        if CATALOGUE[name].gyro_measures != "bias"
    )
    motion, commands = correct_measurements(evidence.smoothed.motion, evidence.commands, effects)
    return replace(evidence, smoothed=replace(evidence.smoothed, motion=motion), commands=commands)


def correct_measurements(
    motion: MotionTrack, commands: CommandTrack, effects: Effects
) -> tuple[MotionTrack, CommandTrack]:
    """Motion and commands corrected for measurement effects: each is its own inverse with the opposite sign."""
    return corrected_motion(motion, effects), corrected_commands(commands, effects)


_LEVEL = Lean(np.zeros(2), np.zeros(2), np.zeros(2))
"""Of a robot that stands upright on a level plane."""
_MeasurementKey = tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
"""Measurement effects with their parameters, hashable."""


def _measurements(effects: Effects) -> _MeasurementKey:
    return tuple(
        (name, tuple(sorted(parameters.items())))
        for name, parameters in effects
        if CATALOGUE[name].stage == "measurement"
    )


def _median_lean(residuals: np.ndarray) -> np.ndarray:
    """Median of roll and pitch among residuals ``[..., W, K, C]`` over windows and times, ``[..., 1, 1, 2]``."""
    lean = residuals[..., _LEAN]
    diverged = np.isnan(lean).all(axis=(-3, -2), keepdims=True)
    return np.nanmedian(np.where(diverged, 0.0, lean), axis=(-3, -2), keepdims=True)


@dataclass(frozen=True)
class _Prepared:
    """Measured motion and start states of all windows under one set of measurement effects."""

    moved: np.ndarray
    """Measured displacement, ``[W, K, 3]`` [m]."""
    turned: np.ndarray
    """Measured change of heading, ``[W, K]`` [rad]."""
    leaned: np.ndarray
    """Measured vertical in the base frame, that of level ground's plane or of the map, ``[W, K, 2]``."""
    risen: np.ndarray
    """Measured change of height above that plane, or on the map, ``[W, K]`` [m]."""
    rates: np.ndarray
    """Measured roll and pitch rates [rad/s], and climb rate [m/s], ``[W, K, 3]``; see :data:`COMPONENTS`."""
    origins: np.ndarray
    """Start positions in the odometry frame, ``[W, 3]`` [m]."""
    to_terrain: np.ndarray
    """Rotation from the odometry frame, ``[3, 3]``."""
    frames: np.ndarray
    """Rotation of the start headings, ``[W, 1, 3, 3]``."""
    places: np.ndarray
    """Start positions on the terrain, ``[W, 3]`` [m]."""
    twists: torch.Tensor
    """Commands with their history, ``[W, HISTORY + T, 2]``."""
    history: int
    """Steps of it."""
    position: torch.Tensor
    rotation: torch.Tensor
    velocity: torch.Tensor
    angular_velocity: torch.Tensor
    joint_start: torch.Tensor | None
    """Measured angles of the joints, ``[W, J]`` [rad], NaN where unknown."""
    flippers: torch.Tensor | None
    """Commanded angles of the flippers, ``[W, T, F]`` [rad], NaN where unknown."""


class Predictions:
    """Rolls out hypotheses over the windows of a recording.

    Args:
        robot: robot with the effects of its file.
        data: the windows.
    """

    def __init__(self, robot: RobotModel, data: EvidenceWindows):
        self.options = PhysicsOptions()
        if data.terrain is None:
            self._terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
        else:
            self._terrain = data.terrain
        self._stiffness = float(self._terrain.stiffness.median())
        self._depth = rest_depth(robot, self._stiffness)
        # Contact points that never touch the ground are left out, which makes rollouts twice as fast.
        reach = _LEVEL_REACH if data.terrain is None else _HILLY_REACH
        touching = robot.points[:, 2] < reach - robot.ground_clearance
        self._moves_flippers = bool(robot.flippers) and data.joints is not None
        if self._moves_flippers and robot.point_flippers is not None:
            touching = touching | (robot.point_flippers >= 0)
        self.robot = robot.with_points(touching)
        self._index = np.rint(data.samples / self.options.time_step).astype(int)
        self._usual_lean: np.ndarray | None = None
        self._set_windows(data)

    @cached_property
    def _own_lean(self) -> np.ndarray | None:
        """What the robot always leans beyond its own prediction, ``[1, 1, 2]``; None without attitude."""
        if self._usual_lean is not None or not self.data.with_attitude:
            return self._usual_lean
        return _median_lean(self._raw([()])[0])

    def _set_windows(self, data: EvidenceWindows) -> None:
        self.data = data
        self._part = self._ground_part()
        self._prepared: dict[_MeasurementKey, _Prepared] = {}
        # Of the windows, since the recording's start [s].
        middles = (data.starts - data.motion.stamps[0]) * 1e-9 + 0.5 * data.horizon
        self._middles = torch.as_tensor(np.maximum(middles, 0.0), dtype=torch.float32)

    def on(self, place: Place | None, chosen: np.ndarray) -> Predictions:
        """Predictions of some windows ``[W]`` bool with effects that act on a part of the ground.

        What the robot always leans is that of all windows.
        """
        result = self._restricted(place, chosen)
        result._usual_lean = self._own_lean
        return result

    def _restricted(self, place: Place | None, chosen: np.ndarray) -> Predictions:
        result = copy(self)
        result._set_windows(replace(self.data, starts=self.data.starts[chosen], place=place))
        return result

    @cached_property
    def _recorded_lean(self) -> Lean:
        return lean_of(self.data.motion)

    def _lean(self, motion: MotionTrack) -> Lean:
        """The lean of a motion; predictions of other windows share that of the recorded one."""
        return self._recorded_lean if motion is self.data.motion else lean_of(motion)

    def residuals(self, hypotheses: Sequence[Effects]) -> np.ndarray:
        """Predicted minus measured, ``[H, W, K, C]``, with the robot's own effects and each hypothesis."""
        return self._without_lean(self._raw(hypotheses))

    def residuals_by_part(self, parts: np.ndarray, effects: Sequence[Effects]) -> np.ndarray:
        """Predicted minus measured, ``[W, K, C]``, each window with the effects of its part; see the function."""
        numbers = np.unique(parts)
        used = [effects[number] for number in numbers]
        # Formulas of parts may have other terms.
        kinds = {(_measurements(entry), tuple((name, *values) for name, values in entry)) for entry in used}
        if self._part is None and len(kinds) == 1:
            # One batch, in which every window has values of its own.
            windows = self._windows(_measurements(used[0]))
            (found,) = self._roll_out(windows, [effects[part] for part in parts], each=1)
            return self._without_lean(found)
        residuals = np.zeros((len(parts), len(self.data.samples), len(self.data.components)))
        alike: dict[tuple[object, ...], list[int]] = {}
        for number in numbers:
            alike.setdefault(values_key(effects[number]), []).append(int(number))
        for same in alike.values():
            here = np.isin(parts, same)
            residuals[here] = self._restricted(self.data.place, here)._raw([effects[same[0]]])[0]
        return self._without_lean(residuals)

    def _without_lean(self, residuals: np.ndarray) -> np.ndarray:
        """Residuals ``[..., W, K, C]`` without what the robot always leans.

        It may be the sensor's mounting, or its accelerometer's bias.
        """
        if not self.data.with_attitude:
            return residuals
        usual = _median_lean(residuals) if self._usual_lean is None else self._usual_lean
        lean = residuals[..., _LEAN] - usual
        return np.concatenate([residuals[..., : _LEAN.start], lean, residuals[..., _LEAN.stop :]], axis=-1)

    def _raw(self, hypotheses: Sequence[Effects]) -> np.ndarray:
        """Predicted minus measured, ``[H, W, K, C]``, the usual lean included."""
        results: dict[int, np.ndarray] = {}
        # Other measurement effects mean other windows; hypotheses that share them share a batch.
        groups: dict[tuple[_MeasurementKey, tuple[str, ...]], list[int]] = {}
        for number, effects in enumerate(hypotheses):
            names = tuple(name for name, _ in effects)
            groups.setdefault((_measurements(effects), names), []).append(number)
        width = len(self.data.starts)
        count = max(1, _LARGEST_BATCH // max(1, width))
        for (key, _), numbers in groups.items():
            windows = self._windows(key)
            for first in range(0, len(numbers), count):
                part = numbers[first : first + count]
                found = self._roll_out(windows, [hypotheses[n] for n in part], each=width)
                results.update(zip(part, found, strict=True))
        return np.stack([results[number] for number in range(len(hypotheses))])

    def _windows(self, key: _MeasurementKey) -> _Prepared:
        if key not in self._prepared:
            if len(self._prepared) > 40:
                self._prepared.clear()
            motion, commands = correct_measurements(
                self.data.motion, self.data.commands, tuple((name, dict(values)) for name, values in key)
            )
            self._prepared[key] = self._prepare(motion, commands)
        return self._prepared[key]

    def _prepare(self, motion: MotionTrack, commands: CommandTrack) -> _Prepared:
        data = self.data
        stamps = data.starts[:, None] + np.rint(np.r_[0.0, data.samples] * 1e9).astype(np.int64)
        positions, rotations, linear, angular = sample_motion(motion, stamps)
        # Level ground is the plane of the recording, whichever way the localisation's z axis points.
        lean = self._lean(motion) if data.terrain is None else _LEVEL
        turned_level = lean.onto_plane
        origins = positions[:, 0]
        positions, rotations = positions @ turned_level.T, turned_level @ rotations
        headings = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])
        turn = Rotation.from_euler("z", headings[:, 0, None]).as_matrix()
        moved = np.einsum("wji,wkj->wki", turn, positions[:, 1:] - positions[:, :1])
        turned = wrap_angle(headings[:, 1:] - headings[:, :1])
        upright = np.eye(3)
        steps = np.arange(-round(HISTORY / self.options.time_step), self._index[-1] + 1)
        command_stamps = data.starts[:, None] + np.rint(steps * self.options.time_step * 1e9).astype(np.int64)
        if data.terrain is None:
            # On level ground every window starts at the origin, with the wheels on the ground.
            leaned, risen = vertical(rotations[:, 1:]), moved[..., 2]
            up, to_terrain = np.array([0.0, 0.0, 1.0]), turned_level
            frame_rotation = measured_rotation = rotations[:, 0]
            if self._moves_flippers:
                lowest = self._lowest(np.einsum("wij,wnj->wni", frame_rotation, self._posed())[..., 2]).mean(axis=1)
            else:
                # In truth the robot does not tumble from a tilted sensor's attitude to its own in each window.
                # Flippers, however, lift it for good.
                frame_rotation = measured_rotation @ lean.upright
                upright = lean.upright
                lowest = np.einsum("wij,nj->wni", frame_rotation, self._underside())[..., 2].mean(axis=1)
            place = np.stack([0 * lowest, 0 * lowest, -lowest - self._depth], axis=1)
            if self._part is not None:
                place[:, :2] = positions[:, 0, :2]
        else:
            if data.odometry_from_terrain is None:
                raise ValueError("a terrain map needs its pose: odometry_from_terrain is None")
            pose = np.linalg.inv(data.odometry_from_terrain)
            leaned = vertical(pose[:3, :3] @ rotations[:, 1:])
            risen = (positions[:, 1:] - positions[:, :1]) @ pose[2, :3]
            up, to_terrain = pose[2, :3], pose[:3, :3]
            frame_rotation = measured_rotation = pose[:3, :3] @ rotations[:, 0]
            place = positions[:, 0] @ pose[:3, :3].T + pose[:3, 3]
            place[:, 2] += self._settling(place, frame_rotation)
        rates = np.zeros((*risen.shape, 3))
        if len(data.components) > len(ATTITUDE):
            _, turned_to, moving, turning = sample_motion(motion, rate_stamps(data))
            climbing = np.einsum("i,wtij,wtj->wt", up, turned_level @ turned_to, moving)
            rates = rate_means(
                np.concatenate([(turning @ upright)[..., :2], climbing[..., None]], axis=-1), data.samples
            )
        heading = np.arctan2(frame_rotation[:, 1, 0], frame_rotation[:, 0, 0])
        frames = Rotation.from_euler("z", heading[:, None]).as_matrix()

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)

        measured = None if data.joints is None else data.joints.start(data.starts)
        history = round(HISTORY / self.options.time_step)
        program = None if data.joints is None else data.joints.flipper_angles(command_stamps[:, history:])
        return _Prepared(
            moved=moved,
            turned=turned,
            leaned=leaned,
            risen=risen,
            rates=rates,
            origins=origins,
            to_terrain=to_terrain,
            frames=frames,
            places=place,
            twists=tensor(commands.sample(command_stamps)),
            history=history,
            position=tensor(place),
            rotation=tensor(frame_rotation),
            velocity=tensor(np.einsum("wij,wj->wi", measured_rotation, linear[:, 0])),
            angular_velocity=tensor(np.einsum("wij,wj->wi", measured_rotation, angular[:, 0])),
            joint_start=None if measured is None else tensor(measured),
            flippers=None if program is None else tensor(program),
        )

    def _settling(self, place: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Vertical shift that puts robots at ``place`` ``[W, 3]`` onto the map, ``[W]`` [m].

        Map and localisation agree on heights only within centimetres; a start that deep in the ground would jump.
        """
        if self._moves_flippers:
            points = place[:, None] + np.einsum("wij,wnj->wni", rotation, self._posed())
        else:
            points = place[:, None] + np.einsum("wij,nj->wni", rotation, self._underside())
        at = torch.as_tensor(points[..., :2], dtype=torch.float32).transpose(1, 2)
        ground = TerrainLookup(self._terrain, "bilinear", len(points))(at).height.double().numpy()
        gap = points[..., 2] - ground
        if self._moves_flippers:
            return -self._lowest(gap).mean(axis=1) - self._depth
        # The lower half of the points carries the robot: on rough ground some wheels hang in the air.
        return -np.sort(gap, axis=1)[:, : max(1, gap.shape[1] // 2)].mean(axis=1) - self._depth

    def _posed(self) -> np.ndarray:
        """Points of the robot with its flippers at the measured angles of each window's start, ``[W, n, 3]`` [m]."""
        robot, joints = self.robot, self.data.joints
        assert joints is not None
        assert robot.flipper_angles is not None
        at_rest = robot.flipper_angles.double().cpu().numpy()
        measured = joints.start(self.data.starts)
        angles = np.tile(at_rest, (len(self.data.starts), 1))
        if measured is not None:
            found = measured[:, -len(at_rest) :]
            angles = np.where(np.isfinite(found), found, angles)
        driven = robot.point_drives >= 0
        return np.stack([robot.posed(torch.from_numpy(row)).points[driven].double().numpy() for row in angles])

    @staticmethod
    def _lowest(heights: np.ndarray) -> np.ndarray:
        """The lowest of heights ``[W, n]``: some of them carry the robot, whatever its flippers do."""
        return np.sort(heights, axis=1)[:, : max(4, heights.shape[1] // 20)]

    def _underside(self) -> np.ndarray:
        return self.robot.underside.double().numpy()

    def _roll_out(self, windows: _Prepared, hypotheses: list[Effects], each: int) -> list[np.ndarray]:
        """Residuals ``[W, K, C]`` for all windows in turn, each hypothesis for as many of them as ``each`` says."""
        if self._part is None:
            return self._residuals_on(self._terrain, windows, hypotheses, hypotheses, each)
        # Hypotheses that change the ground alike share a map.
        results: dict[int, np.ndarray] = {}
        shared: dict[tuple[tuple[object, ...], ...], list[int]] = {}
        split = [self._part.with_effects(effects, self._usual(effects)) for effects in hypotheses]
        for number, (effects, (_, others)) in enumerate(zip(hypotheses, split, strict=True)):
            left = dict(others)
            ground = tuple(entry for entry in effects if entry[0] not in left)
            shared.setdefault(values_key(ground), []).append(number)
        for numbers in shared.values():
            whole = [hypotheses[number] for number in numbers]
            on_robot = [split[number][1] for number in numbers]
            found = self._residuals_on(split[numbers[0]][0], windows, whole, on_robot, each)
            results.update(zip(numbers, found, strict=True))
        return [results[number] for number in range(len(hypotheses))]

    def _residuals_on(
        self, terrain: TerrainMap, windows: _Prepared, hypotheses: list[Effects], on_robot: list[Effects], each: int
    ) -> list[np.ndarray]:
        """Residuals ``[W, K, C]`` on a map, for all windows in turn.

        Args:
            terrain: map with those effects that are properties of the ground.
            windows: the windows.
            hypotheses: with all their effects.
            on_robot: with the others alone.
            each: windows of each hypothesis.
        """
        width = len(self.data.starts)
        count = len(hypotheses) * each // width
        with torch.no_grad():
            sunk = np.repeat(self._sunk(hypotheses), each).reshape(count, width)
            if self._part is not None:
                sunk = np.where(self._on_place(windows, torch.zeros(width, 3)), sunk, self._own_sinking)
            position = windows.position.repeat(count, 1)
            state = State(
                position - torch.from_numpy(sunk.ravel()).to(position)[:, None] * position.new_tensor([0.0, 0.0, 1.0]),
                windows.rotation.repeat(count, 1, 1),
                windows.velocity.repeat(count, 1),
                windows.angular_velocity.repeat(count, 1),
            )
            here = self._driven(windows, on_robot, each)
            if self._part is not None and any(on_robot):
                elsewhere = self._driven(windows, [self._elsewhere(effects) for effects in on_robot], each)

                def on_part(reached: torch.Tensor) -> torch.Tensor:
                    return torch.from_numpy(self._on_place(windows, reached - position))

                result = local_rollout(terrain, here, elsewhere, state, on_part, self.options)
            else:
                result = rollout(terrain, here.robot, here.controls, state, options=self.options, with_forces=False)
        positions = result.position[:, self._index].double().numpy().reshape(count, width, -1, 3)
        rotations = result.rotation[:, self._index].double().numpy().reshape(count, width, -1, 3, 3)
        displacement = np.einsum("wji,hwkj->hwki", windows.frames, positions - windows.places[None, :, None])
        forward = np.einsum("wji,hwkj->hwki", windows.frames, rotations[..., :, 0])
        heading = np.arctan2(forward[..., 1], forward[..., 0])
        errors = [
            displacement[..., 0] - windows.moved[..., 0],
            displacement[..., 1] - windows.moved[..., 1],
            wrap_angle(heading - windows.turned),
        ]
        if self.data.with_attitude:
            lean = vertical(rotations) - windows.leaned
            risen = displacement[..., 2] + sunk[..., None]
            errors += [lean[..., 1], -lean[..., 0], risen - windows.risen]
        if len(self.data.components) > len(ATTITUDE):
            every = round(RATE_TIME / self.options.time_step)
            part = slice(every, int(self._index[-1]) + 1, every)
            turning = torch.einsum("bkji,bkj->bki", result.rotation[:, part], result.angular_velocity[:, part])
            rates = torch.cat([turning[..., :2], result.velocity[:, part, 2:]], dim=-1).double().numpy()
            means = rate_means(rates, self.data.samples).reshape(count, width, -1, 3) - windows.rates
            errors += [means[..., axis] for axis in range(3)]
        return list(np.stack(errors, axis=-1))

    def _driven(self, windows: _Prepared, hypotheses: list[Effects], each: int) -> Driven:
        """The robot with each hypothesis in some windows, and its controls."""
        count = len(hypotheses) * each // len(self.data.starts)
        robot = replace(self.robot, effects=self._joined(hypotheses, each))
        given = controls(
            robot,
            windows.twists.repeat(count, 1, 1),
            self.options.time_step,
            history=windows.history,
            joint_start=None if windows.joint_start is None else windows.joint_start.repeat(count, 1),
            flippers=None if windows.flippers is None else windows.flippers.repeat(count, 1, 1),
        )
        return Driven(robot, given)

    def _ground_part(self) -> GroundPart | None:
        """The part of the ground on which hypotheses act; None: everywhere, or in the whole of each window."""
        data = self.data
        if data.place is None or not moves_rigidly(self.robot):
            return None
        from_terrain = np.eye(4) if data.odometry_from_terrain is None else data.odometry_from_terrain
        if data.terrain is None:
            from_terrain[:3, :3] = self._lean(data.motion).onto_plane.T
        place, to_terrain = data.place, np.linalg.inv(from_terrain)
        usual = transform_points(to_terrain, data.motion.positions.mean(axis=0, keepdims=True))[0, 2]

        def holds(points: np.ndarray) -> np.ndarray:
            in_odometry = transform_points(from_terrain, np.c_[points, np.full(len(points), usual)])
            return place.holds(in_odometry[:, :2], data)

        corners = np.zeros((2, 2)) if place.bounds is None else np.array(place.bounds)
        low, high = transform_points(to_terrain, np.c_[corners, np.full(2, data.motion.positions[:, 2].mean())])[:, :2]
        return GroundPart.of(data.terrain, (low, high), holds)

    def _usual(self, effects: Effects) -> Callable[[str], Mapping[str, float]]:
        """Values of effects where they do not act."""
        return dict(self._elsewhere(effects)).__getitem__

    def _elsewhere(self, effects: Effects) -> Effects:
        """A hypothesis off the part of the ground."""
        return tuple(
            (name, values)
            if CATALOGUE[name].everywhere
            else (name, outside_values(name, values, own_values(self.robot, name)))
            for name, values in effects
        )

    def _on_place(self, windows: _Prepared, moved: torch.Tensor) -> np.ndarray:
        """Whether windows that moved by ``[H W, 3]`` since their start are on the place of the data, ``[H W]`` bool."""
        assert self.data.place is not None
        travelled = moved.double().numpy().reshape(-1, len(self.data.starts), 3) @ windows.to_terrain
        return self.data.place.holds((windows.origins + travelled)[..., :2].reshape(-1, 2), self.data)

    def _sunk(self, hypotheses: list[Effects]) -> np.ndarray:
        """How much deeper than the plain robot each hypothesis rests in its ground, ``[H]`` [m].

        A robot that starts above its place of rest drops into it, and pitches and slips as no measured one does.
        """
        count = len(hypotheses)
        if all(CATALOGUE[name].stage in ("measurement", "command") for name, _ in hypotheses[0]):
            # Neither weighs on the ground nor changes it.
            return np.full(count, self._own_sinking)
        return self._sinking(hypotheses)

    @cached_property
    def _own_sinking(self) -> float:
        """Of the robot with its own effects."""
        return float(self._sinking([()])[0])

    def _sinking(self, hypotheses: list[Effects]) -> np.ndarray:
        setup = applied_setup(self._terrain, replace(self.robot, effects=self._joined(hypotheses, 1)))
        count = len(hypotheses)
        softness, mass = (
            np.broadcast_to(values.double().cpu().numpy().reshape(-1), count)
            for values in (setup.softness, setup.robot.mass)
        )
        return rest_depth(self.robot, self._stiffness / softness, mass=mass) - self._depth

    def _joined(
        self, hypotheses: list[Effects], width: int
    ) -> tuple[tuple[str, Mapping[str, float | torch.Tensor]], ...]:
        """The robot's effects with each parameter as a batch: ``width`` trajectories for every hypothesis."""
        names = [name for name, _ in hypotheses[0] if CATALOGUE[name].stage != "measurement"]
        joined = dict(self.robot.effects)
        for name in names:
            values = [dict(effects)[name] for effects in hypotheses]
            joined[name] = {
                key: torch.tensor([float(v[key]) for v in values], dtype=torch.float32).repeat_interleave(width)
                for key in values[0]
            }
        for name, parameters in joined.items():
            if clock := CATALOGUE[name].clock:
                copies = max(1, len(hypotheses) * width // len(self._middles))
                joined[name] = {**parameters, clock: self._middles.repeat(copies)}
        return tuple(joined.items())
