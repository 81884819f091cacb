"""Predictor: from observation, motion and commands to future poses and contact forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.effects import controls, turned_effects
from monoforce_ros.perception import Observation, TerrainSource, with_clear_start
from monoforce_ros.physics import PhysicsOptions, Rollout, State, rollout
from monoforce_ros.prediction.joint_motion import JointMotion
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap


@dataclass(frozen=True)
class Prediction:
    """A terrain map and the predicted motion on it."""

    motion: MotionState
    """The measured state that the prediction starts from."""
    terrain: TerrainMap
    rollout: Rollout
    """Motion and forces in the terrain frame, a batch of one."""
    joints: JointMotion | None = None
    """Measured joints at the start; None: steering from earlier commands, flippers as in the robot's file."""

    @property
    def stamp(self) -> int:
        """Time of the observation [ns]."""
        return self.motion.stamp

    def positions(self) -> np.ndarray:
        """Predicted positions of the base frame in the odometry frame [m], ``[T + 1, 3]``."""
        return transform_points(self.motion.odometry_from_terrain, self.rollout.position[0].double().numpy())

    def rotations(self) -> np.ndarray:
        """Predicted rotations odometry ← base, ``[T + 1, 3, 3]``."""
        return self.motion.odometry_from_terrain[:3, :3] @ self.rollout.rotation[0].double().numpy()


def start_states(motions: list[MotionState], dtype: torch.dtype = torch.float32) -> State:
    """Physics states of measured motions, each in its own terrain frame."""

    def tensor(values: list[np.ndarray]) -> torch.Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype)

    # Candidates share one motion, whose rotation is computed only once.
    unique = {id(motion): motion for motion in motions}
    by_motion = {key: motion.terrain_from_base[:3, :3] for key, motion in unique.items()}
    rotations = [by_motion[id(motion)] for motion in motions]
    return State(
        position=tensor([np.zeros(3)] * len(motions)),
        rotation=tensor(rotations),
        velocity=tensor([r @ m.linear_velocity for r, m in zip(rotations, motions, strict=True)]),
        angular_velocity=tensor([r @ m.angular_velocity for r, m in zip(rotations, motions, strict=True)]),
    )


class Predictor:
    """Predicts the motion of one robot with one terrain source.

    Args:
        robot: the robot's model.
        source: source of the terrain maps.
        horizon: length of a prediction [s].
        options: options of the physics.
        history: time before the start over which delays and lags of the drives need commands [s].
    """

    def __init__(
        self,
        robot: RobotModel,
        source: TerrainSource,
        *,
        horizon: float = 5.0,
        options: PhysicsOptions | None = None,
        history: float = 2.0,
    ):
        self.robot = robot
        self.source = source
        self.options = options or PhysicsOptions()
        self.steps = max(1, round(horizon / self.options.time_step))
        self.history = round(history / self.options.time_step)

    def warm_up(self) -> None:
        """Compile kernels and load libraries, so that the first prediction is as fast as later ones."""
        still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
        self.roll_out(TerrainMap.flat(Grid.square(2.0, 0.5)), [still], np.zeros((1, self.history + 2, 2)))

    def command_stamps(self, stamp: int) -> np.ndarray:
        """Times [ns] of the commands that a prediction from ``stamp`` needs, ``[history + T]``."""
        steps = np.arange(-self.history, self.steps)
        return stamp + np.rint(steps * self.options.time_step * 1e9).astype(np.int64)

    def predict(
        self,
        observation: Observation,
        motion: MotionState,
        twists: np.ndarray,
        *,
        force_every: int = 1,
        joints: JointMotion | None = None,
    ) -> Prediction:
        """Predict from one observation.

        Args:
            observation: sensor data.
            motion: the robot's state at the same time.
            twists: commanded forward speed [m/s] and yaw rate [rad/s] at ``command_stamps``, ``[history + T, 2]``.
            force_every: interval of the steps at which contact forces are returned.
            joints: measured joints at the same time.
        """
        # Cleared here, too, so that the map that is shown is that of the prediction.
        start = self._at_start(self.robot, joints), start_states([motion])
        terrain = with_clear_start(self.source.terrain(observation, motion), *start)
        rolled = self.roll_out(terrain, [motion], twists[None], force_every=force_every, joints=joints)
        return Prediction(motion, terrain, rolled, joints)

    def roll_out(
        self,
        terrain: TerrainMap,
        motions: list[MotionState],
        twists: np.ndarray,
        *,
        with_forces: bool = True,
        with_contact: bool = False,
        force_every: int = 1,
        joints: JointMotion | None = None,
        flippers: np.ndarray | None = None,
    ) -> Rollout:
        """Roll out motions ``[B]`` under twists ``[B, history + T, 2]`` on one map or a batch of maps.

        ``flippers`` are commanded angles ``[B, T, F]`` [rad] in place of those of ``joints``.
        """
        with torch.no_grad():
            commands = torch.as_tensor(twists, dtype=torch.float32)
            start = start_states(motions)
            return self.differentiable_roll_out(
                terrain, motions, commands, start, self.robot,
                with_forces=with_forces, with_contact=with_contact, force_every=force_every, joints=joints,
                flippers=None if flippers is None else torch.as_tensor(flippers, dtype=torch.float32),
            )  # fmt: skip

    def differentiable_roll_out(
        self,
        terrain: TerrainMap,
        motions: list[MotionState],
        twists: torch.Tensor,
        state: State,
        robot: RobotModel,
        *,
        with_forces: bool = True,
        with_contact: bool = False,
        force_every: int = 1,
        joints: JointMotion | None = None,
        flippers: torch.Tensor | None = None,
    ) -> Rollout:
        """As :meth:`roll_out` but with gradients, for given start states and a given variant of the robot."""
        batch, step = len(twists), self.options.time_step
        start = None
        if joints is not None:
            start = torch.as_tensor(joints.start, dtype=torch.float32).expand(batch, -1)
            if flippers is None:
                flippers = joints.flippers(batch, twists.shape[1] - self.history, step)
        given = controls(robot, twists, step, history=self.history, joint_start=start, flippers=flippers)
        # The terrain frame turns with the robot's heading; effects fixed in the odometry frame are rotated into it.
        heading = torch.tensor([motion.heading for motion in motions], dtype=torch.float32)
        terrain = with_clear_start(terrain, self._at_start(robot, joints), state)
        return rollout(
            terrain, turned_effects(robot, heading), given, state, options=self.options, with_forces=with_forces,
            with_contact=with_contact, force_every=force_every,
        )  # fmt: skip

    @staticmethod
    def _at_start(robot: RobotModel, joints: JointMotion | None) -> RobotModel:
        """The robot with its flippers as measured, where one set of angles holds for all predictions."""
        if joints is None or not robot.flippers or joints.start.ndim != 1:
            return robot
        angles = joints.start[-len(robot.flippers) :]
        return robot.posed(torch.as_tensor(angles)) if np.isfinite(angles).all() else robot
