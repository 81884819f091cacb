"""MuJoCo's system identification: a robot's MuJoCo model, all parameters free, fitted to windows of a recording.

The model follows from a robot file and the effects in it. ``mujoco.sysid`` (``benchmarks/requirements.txt``) changes
masses, contacts, servos, drags, gravity, the pose sensor's site and the commands' dead time and lag until rollouts from
measured start states meet the measured motion; it ends where steps no longer help or time is up.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from io import StringIO
from typing import Any

import numpy as np
from mujoco_robot import FREE, TIME_STEP, MujocoModel, Nominal
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from monoforce_ros.core import wrap_angle
from monoforce_ros.discrepancy.evidence import EvidenceWindows, sample_motion
from monoforce_ros.discrepancy.gap import relative_motion
from monoforce_ros.robots import RobotModel
from monoforce_ros.synthetic.graphics import mujoco

# Parts of mujoco that it does not import by itself.
sysid: Any = import_module("mujoco.sysid")
mujoco_rollout: Any = import_module("mujoco.rollout")

_HISTORY = 3.0
"""Commands before a window, for dead time and lag [s]."""
_PERTURBATIONS = (0.1, 0.03)
"""Of finite differences, coarse ones first: all parameters are of the order of 1, and rollouts that slip and stick are
not smooth. With 0.003 the optimiser stops within a tenth of the way to a friction of a tenth."""
_PRIOR = 1.0
"""Standard deviation of each parameter about its start, in its own unit (``FREE``): it decides what data do not."""
_WORST = 1e3
"""Largest residual in units of its scale: a model that tips over says no more than that it is wrong."""


class WindowRollouts:
    """Rollouts of windows of a recording with a robot's MuJoCo model, and their residuals.

    Args:
        nominal: what the robot file says.
        data: the windows.
        scale: of residuals ``[K, 3]`` [m, m, rad].
    """

    def __init__(self, nominal: Nominal, data: EvidenceWindows, scale: np.ndarray):
        self._nominal, self._data, self._scale = nominal, data, scale
        self.model = MujocoModel(nominal, data.terrain)
        self._steps = round(data.horizon / TIME_STEP)
        self._index = np.rint(data.samples / TIME_STEP).astype(int) - 1
        self._measured = relative_motion(data.motion, data)[..., :3]
        positions, rotations, linear, angular = sample_motion(data.motion, data.starts)
        if data.terrain is not None:
            assert data.odometry_from_terrain is not None
            pose = np.linalg.inv(data.odometry_from_terrain)
            positions = positions @ pose[:3, :3].T + pose[:3, 3]
            rotations = pose[:3, :3] @ rotations
        self._xy = positions[:, :2]
        self._yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        self._linear, self._angular = linear, angular
        steps = np.arange(-round((_HISTORY + 1.0) / TIME_STEP), self._steps + round(0.5 / TIME_STEP) + 1)
        stamps = data.starts[:, None] + np.rint(steps * TIME_STEP * 1e9).astype(np.int64)
        self._commands = data.commands.sample(stamps)[..., :2]

    def wheel_targets(self, values: Mapping[str, float]) -> np.ndarray:
        """Commanded speeds of the sides at the start of a window and after each step, ``[W, T + 1, 2]`` [m/s]."""
        nominal, robot = self._nominal, self._nominal.robot
        first = round((_HISTORY + 1.0) / TIME_STEP)
        late = round((nominal.dead_time + values["dead_time"]) / TIME_STEP)
        late = int(np.clip(late, -round(0.5 / TIME_STEP), round(1.0 / TIME_STEP)))
        begin = first - round(_HISTORY / TIME_STEP)
        twists = self._commands[:, begin - late : first + self._steps + 1 - late]
        highest = math.exp(values["speed_limit"])
        forward = twists[..., 0]
        turning = twists[..., 1].clip(-robot.maximum_yaw_rate, robot.maximum_yaw_rate) * math.exp(
            values["command_turn"]
        )
        half = float(robot.drive_offsets.abs().max()) / nominal.turn
        sides = np.stack([forward - half * turning, forward + half * turning], axis=-1) * nominal.gain
        limit = highest * min(robot.maximum_speed, float(np.abs(sides).max()) + 1e-3)
        sides = sides.clip(-limit, limit)
        lag = max(nominal.lag + values["lag"], 1e-3)
        keep = math.exp(-TIME_STEP / lag)
        sides, _ = lfilter([1.0 - keep], [1.0, -keep], sides, axis=1, zi=keep * sides[:, :1])
        gains = np.exp([values["command_left"], values["command_right"]])
        return (sides * gains)[:, round(_HISTORY / TIME_STEP) :]

    def start_states(self, model: mujoco.MjModel, values: Mapping[str, float], speeds: np.ndarray) -> np.ndarray:
        """States of the whole physics at the windows' starts ``[W, S]``.

        Args:
            model: compiled with these parameters.
            values: the parameters.
            speeds: of the sides ``[W, 2]`` [m/s].
        """
        count = len(self._nominal.wheels)
        site = np.array([values["site_x"], values["site_y"], 0.0])
        yaw = self._yaw - values["site_yaw"]
        height, attitude = self.model.ground_under(self._xy, yaw)
        # The measured pose is the site's.
        xy = self._xy - (attitude @ site)[:, :2]
        height = height if self._data.terrain is None else self.model.ground_under(xy, yaw)[0]
        inwards = Rotation.from_euler("z", values["site_yaw"]).as_matrix()
        angular = self._angular @ inwards.T
        linear = self._linear @ inwards.T - np.cross(angular, site)
        # Upright on its ground: a measured rise or roll is that of the noise, or of the ground, which the model has.
        linear[:, 2], angular[:, :2] = 0.0, 0.0
        place = np.c_[xy, height] + attitude[:, :, 2] * self.model.resting_height(model)
        radius = float(model.geom("tyre_0").size[0])
        wheels = np.repeat(speeds / radius, count // 2, axis=1)
        quaternions = Rotation.from_matrix(attitude).as_quat(scalar_first=True)
        positions = np.c_[place, quaternions, np.zeros((len(xy), count))]
        velocities = np.c_[np.einsum("wij,wj->wi", attitude, linear), angular, wheels]
        return np.c_[np.zeros(len(xy)), positions, velocities]

    def motions(self, states: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        """Predicted motion of the site since each window's start, as measured ``[W, K, 3]`` [m, m, rad].

        Args:
            states: of the physics at the samples and at the start, ``[W, 1 + K, S]``.
            values: the parameters.
        """
        site = np.array([values["site_x"], values["site_y"], 0.0])
        quaternions = states[..., 4:8].reshape(-1, 4)
        broken = ~np.isfinite(quaternions).all(axis=1) | (np.abs(quaternions).sum(axis=1) < 0.5)
        quaternions[broken] = (1.0, 0.0, 0.0, 0.0)
        rotations = Rotation.from_quat(quaternions, scalar_first=True).as_matrix().reshape(*states.shape[:2], 3, 3)
        places = states[..., 1:4] + rotations @ site
        yaw = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0]) + values["site_yaw"]
        moved = (places[:, 1:] - places[:, :1])[..., :2]
        cos, sin = np.cos(yaw[:, :1]), np.sin(yaw[:, :1])
        along, across = cos * moved[..., 0] + sin * moved[..., 1], cos * moved[..., 1] - sin * moved[..., 0]
        return np.stack([along, across, wrap_angle(yaw[:, 1:] - yaw[:, :1])], axis=-1)

    def residuals(self, columns: Sequence[Mapping[str, float]]) -> np.ndarray:
        """Predicted minus measured for each set of parameters, ``[P, W, K, 3]`` [m, m, rad]."""
        models, starts, controls = [], [], []
        count = len(self._nominal.wheels)
        for values in columns:
            model = self.model.compiled(values)
            targets = self.wheel_targets(values)
            models += [model] * len(targets)
            starts.append(self.start_states(model, values, targets[:, 0]))
            radius = float(model.geom("tyre_0").size[0])
            controls.append(np.repeat(targets[:, 1:] / radius, count // 2, axis=2))
        begin = np.concatenate(starts)
        states, _ = mujoco_rollout.rollout(models, mujoco.MjData(models[0]), begin, np.concatenate(controls))
        sampled = np.concatenate([begin[:, None], np.asarray(states)[:, self._index]], axis=1)
        parts = sampled.reshape(len(columns), len(self._xy), *sampled.shape[1:])
        found = np.stack([self.motions(part, values) for part, values in zip(parts, columns, strict=True)])
        return np.nan_to_num(found - self._measured, nan=1e3, posinf=1e3, neginf=-1e3)

    def loss_terms(self, columns: Sequence[Mapping[str, float]]) -> np.ndarray:
        """Residuals in units of their scale with a robust loss (pseudo-Huber), ``[W K 3, P]``: their squares add up."""
        sizes = (self.residuals(columns) / self._scale).clip(-_WORST, _WORST).reshape(len(columns), -1).T
        return np.sign(sizes) * np.sqrt(2.0 * (np.sqrt(1.0 + sizes**2) - 1.0))


class _TimeIsUpError(Exception):
    """The budget is spent; the best parameters are known."""


@dataclass(frozen=True)
class Identified:
    """Parameters of a robot's MuJoCo model.

    Attributes:
        values: by the names of :data:`FREE`.
        steps: iterations of the optimiser.
        seconds: of a processor that it took [s].
        converged: whether it ended by itself.
    """

    values: Mapping[str, float]
    steps: int
    seconds: float
    converged: bool


def identify(robot: RobotModel, data: EvidenceWindows, scale: np.ndarray, seconds: float) -> Identified:
    """Fit all parameters to windows with ``mujoco.sysid``.

    Args:
        robot: nominal, with the effects of its file.
        data: the windows.
        scale: of residuals ``[K, 3]`` [m, m, rad].
        seconds: of a processor after which no further step begins [s].
    """
    rollouts = WindowRollouts(Nominal.of(robot), data, scale)
    began = time.process_time()
    found = sysid.ParameterDict(
        {name: sysid.Parameter(name, entry.start, entry.low, entry.high) for name, entry in FREE.items()}
    )
    start = found.as_vector()
    best: dict[str, Any] = {"x": start, "steps": 0}

    def named(vector: np.ndarray) -> dict[str, float]:
        return dict(zip(FREE, (float(value) for value in vector), strict=True))

    def residual(x: np.ndarray, parameters: sysid.ParameterDict) -> tuple[list[np.ndarray], list, list]:
        columns = x.reshape(len(start), -1)
        terms = rollouts.loss_terms([named(column) for column in columns.T])
        prior = (columns - start[:, None]) / _PRIOR
        joined = np.concatenate([terms, prior])
        return [joined if x.ndim > 1 else joined[:, 0]], [], []

    def after_step(trace: list) -> None:
        entry = trace[-1]
        # A step is accepted only if it reduces the objective; the last entry has none.
        best["x"] = (entry.candidate if entry.step is None else entry.candidate + entry.step).ravel()
        best["steps"] += 1
        if time.process_time() - began > seconds:
            raise _TimeIsUpError

    converged = True
    try:
        for perturbation in _PERTURBATIONS:
            found.update_from_vector(best["x"])
            sysid.optimize(
                found, residual, verbose=False, eps=perturbation, max_iters=50, iter_callback=after_step, xtol=1e-2,
                output=StringIO(),
            )  # fmt: skip
    except _TimeIsUpError:
        converged = False
    return Identified(named(best["x"]), best["steps"], time.process_time() - began, converged)


def held_out_errors(
    robot: RobotModel, train: EvidenceWindows, test: EvidenceWindows, scale: np.ndarray, seconds: float
) -> np.ndarray:
    """Predicted minus measured at the last sample of windows to which nothing was fitted, ``[W, 3]`` [m, m, rad].

    Args:
        robot: nominal, with the effects of its file.
        train: windows to fit.
        test: windows to predict.
        scale: of residuals ``[K, 3]`` [m, m, rad].
        seconds: of a processor for the fit [s].
    """
    found = identify(robot, train, scale, seconds)
    last = replace(test, samples=test.samples[-1:])
    return WindowRollouts(Nominal.of(robot), last, scale[-1:]).residuals([found.values])[0, :, -1]
