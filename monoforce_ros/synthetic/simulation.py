"""Simulation: steps a robot through a world and says where it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic import vehicle, world
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.vehicle import Vehicle

_SETTLING_TIME = 1.5
_LARGEST_TILT = math.radians(55.0)
_EDGE_MARGIN = 1.5


@dataclass(frozen=True)
class BaseState:
    """Where the base frame is and how it moves.

    Attributes:
        position: ``[3]`` in the odom frame [m].
        quaternion: ``[4]`` x, y, z, w; odom ← base.
        linear_velocity: ``[3]`` of the base frame's origin, in the base frame [m/s].
        angular_velocity: ``[3]`` in the base frame [rad/s].
    """

    position: np.ndarray
    quaternion: np.ndarray
    linear_velocity: np.ndarray
    angular_velocity: np.ndarray

    @property
    def rotation(self) -> np.ndarray:
        """``[3, 3]``, odom ← base."""
        return Rotation.from_quat(self.quaternion).as_matrix()

    @property
    def heading(self) -> float:
        """Direction of the x axis in the horizontal plane [rad]."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])


class Simulation:
    """A robot that stands in a world, settled, and is driven by wheel speeds.

    The odom frame is the world frame, shifted to where the base frame comes to rest before the drive: its z axis points
    against gravity, and the robot starts at its origin with a heading of 0.

    Attributes:
        model, data: MuJoCo's.
        odom_origin: ``[3]`` position of the odom frame's origin in the world [m].
        steps: of ``world.TIME_STEP`` since the robot came to rest.
    """

    def __init__(self, model: mujoco.MjModel, scenery: Scenery, robot: Vehicle):
        self.model, self.data = model, mujoco.MjData(model)
        self._scenery, self._robot = scenery, robot
        self._base = model.body(vehicle.BODY).id
        self._bodies = [model.body(wheel.joint).id for wheel in robot.wheels]
        self._radii = np.array([wheel.radius for wheel in robot.wheels])
        joints = [model.joint(wheel.joint) for wheel in robot.wheels]
        self._wheel_positions = [joint.qposadr[0] for joint in joints]
        self._wheel_velocities = [joint.dofadr[0] for joint in joints]
        mujoco.mj_forward(model, self.data)
        self.steps = 0
        for _ in range(round(_SETTLING_TIME / world.TIME_STEP)):
            self.step()
        self.steps = 0
        self.odom_origin = self.data.qpos[:3].copy()

    @property
    def time(self) -> float:
        """Since the robot came to rest [s]."""
        return self.steps * world.TIME_STEP

    def drive(self, forward: float, yaw_rate: float) -> None:
        """Command a forward speed [m/s] and a yaw rate [rad/s] from now on."""
        self.data.ctrl[:] = self._robot.wheel_speeds(forward, yaw_rate)

    def step(self) -> None:
        """Advance by ``world.TIME_STEP``."""
        self._push_wheels()
        mujoco.mj_step(self.model, self.data)
        self.steps += 1

    def update_kinematics(self) -> None:
        """Bring what sensors look at up to the present positions; after a step it is one step behind."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def state(self) -> BaseState:
        """The present pose and twist of the base frame."""
        quaternion = self.data.qpos[[4, 5, 6, 3]] / np.linalg.norm(self.data.qpos[3:7])
        return BaseState(
            position=self.data.qpos[:3] - self.odom_origin,
            quaternion=quaternion,
            # A free joint's linear velocity is in the world frame, its angular velocity in the body frame.
            linear_velocity=Rotation.from_quat(quaternion).inv().apply(self.data.qvel[:3]),
            angular_velocity=self.data.qvel[3:6].copy(),
        )

    def world_pose(self) -> np.ndarray:
        """Present pose ``[4, 4]``, world ← base."""
        pose = np.eye(4)
        pose[:3, :3] = self.state().rotation
        pose[:3, 3] = self.data.qpos[:3]
        return pose

    def wheel_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Angle [rad] and speed [rad/s] of each wheel, positive forwards."""
        return self.data.qpos[self._wheel_positions].copy(), self.data.qvel[self._wheel_velocities].copy()

    def mishap(self) -> str | None:
        """Why the drive cannot go on, or None."""
        if not np.isfinite(self.data.qpos).all():
            return "the simulation became unstable"
        if self.state().rotation[2, 2] < math.cos(_LARGEST_TILT):
            return "the robot tipped over"
        if not self._scenery.ground.contains(self.data.qpos[:2], _EDGE_MARGIN):
            return "the robot reached the edge of the world"
        return None

    def _push_wheels(self) -> None:
        """Let the grass act on the wheels."""
        centres = self.data.xpos[self._bodies]
        turning = self.data.xmat[self._base].reshape(3, 3) @ self.data.qvel[3:6]
        velocities = self.data.qvel[:3] + np.cross(turning, centres - self.data.xpos[self._base])
        forces = self._scenery.grass.wheel_forces(self._scenery.ground, centres, self._radii, velocities)
        self.data.xfrc_applied[self._bodies, :3] = 0.0 if forces is None else forces
