"""Simulation: step a robot through a world and read its state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic import vehicle, world
from monoforce_ros.synthetic.fault import Fault
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.joint_servos import JointServos
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.vehicle import Vehicle

_SETTLING_TIME = 1.5
_LARGEST_TILT = math.radians(55.0)
_EDGE_MARGIN = 1.5
# A map of friction is read this often: a wheel moves less than 2 cm in between.
_STEPS_PER_FRICTION = 5


@dataclass(frozen=True)
class BaseState:
    """Pose and twist of the base frame.

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
    """A robot in a world, at rest on the ground and driven by wheel speeds and by the angles of its joints.

    The odom frame is the world frame, shifted to where the base frame comes to rest before the start: its z axis points
    up, and the robot starts at its origin with a heading of 0.

    Attributes:
        model, data: MuJoCo's model and state.
        odom_origin: ``[3]`` position of the odom frame's origin in the world [m].
        steps: number of steps of ``world.TIME_STEP`` since the robot came to rest.
        base: id of the chassis body.
        wheel_bodies: ids of the wheel bodies.
        tyres: ids of the wheel geometries that touch the ground.
        tyre_friction: friction coefficient of each tyre on ordinary ground ``[wheels]``.
        driven: indices of the wheels that the model's first actuators turn, in their order; those of steering and
            flippers follow.
    """

    def __init__(self, model: mujoco.MjModel, scenery: Scenery, robot: Vehicle, hidden: Sequence[Fault] = ()):
        self.model, self.data = model, mujoco.MjData(model)
        self.robot = robot
        self._differentials = [list(turned) for turned in robot.differentials]
        self._scenery, self._hidden = scenery, hidden
        self._cell = scenery.ground.resolution
        self.base = model.body(vehicle.BODY).id
        self.wheel_bodies = [model.body(wheel.joint).id for wheel in robot.wheels]
        self.tyres = [model.geom(wheel.surface).id for wheel in robot.wheels]
        self.tyre_friction = model.geom_friction[self.tyres, 0].copy()
        self.driven = np.array([index for index, wheel in enumerate(robot.wheels) if wheel.driven], int)
        self._speeds = np.zeros(len(robot.wheels))
        self._steering = np.zeros(len(robot.steering))
        self._rest = np.array([0.0] * len(robot.steering) + [arm.angle for arm in robot.flippers])
        self._flippers = self._rest[len(robot.steering) :]
        self._servos = JointServos(robot.servos, self._rest, world.TIME_STEP) if robot.servos else None
        # Most steps are on ordinary ground, where one look-up in these masks suffices.
        x, y = scenery.ground.grid()
        positions = np.stack([x, y], axis=-1)
        reach = 2 * round((np.linalg.norm([w.centre[:2] for w in robot.wheels], axis=1).max() + 0.3) / self._cell) + 1
        self._near_grass = maximum_filter(scenery.grass.soft_cells, reach)
        in_patch = np.zeros(x.shape, bool)
        for patch in scenery.patches:
            in_patch |= patch.contains(positions)
        self._near_patch = maximum_filter(in_patch, reach)
        self._radii = np.array([wheel.radius for wheel in robot.wheels])
        # The total force of the grass does not depend on the number of wheels.
        self._grass_share = 4.0 / len(robot.wheels)
        joints = [model.joint(wheel.joint) for wheel in robot.wheels]
        self._wheel_positions = [joint.qposadr[0] for joint in joints]
        self._wheel_velocities = [joint.dofadr[0] for joint in joints]
        moving = [pivot.name for pivot in (*robot.steering, *robot.casters)] + [arm.name for arm in robot.flippers]
        self.joint_names = (*(wheel.joint for wheel in robot.wheels), *moving)
        """Names of the joints of :meth:`joint_states`."""
        self._joints = [model.joint(name) for name in moving]
        self._offsets = np.array([0.0] * (len(moving) - len(robot.flippers)) + [arm.angle for arm in robot.flippers])
        mujoco.mj_forward(model, self.data)
        self.steps = 0
        self._faults_active = False
        for _ in range(round(_SETTLING_TIME / world.TIME_STEP)):
            self.step()
        self.steps = 0
        self.odom_origin = self.data.qpos[:3].copy()
        # Faults start after the robot has settled, so that the start state is the same as without faults.
        for fault in hidden:
            fault.modify_model(self)
        self._faults_active = True
        self._on_patch = True
        self._set_friction()

    @property
    def time(self) -> float:
        """Time since the robot came to rest [s]."""
        return self.steps * world.TIME_STEP

    def drive(self, forward: float, yaw_rate: float, lateral: float = 0.0) -> None:
        """Command a forward speed [m/s], a yaw rate [rad/s] and, of a robot that crabs, a speed to the left [m/s].

        Commands hold until the next call.
        """
        self._speeds, self._steering = self.robot.command(forward, yaw_rate, lateral)

    def move_flippers(self, angles: np.ndarray) -> None:
        """Command angles of the flippers ``[F]`` [rad], held until the next call."""
        self._flippers = np.array(angles, float)

    def step(self) -> None:
        """Advance by ``world.TIME_STEP``."""
        speeds, angles = self._speeds, np.concatenate([self._steering, self._flippers])
        self.data.xfrc_applied[:] = 0.0
        grass = self.grass_forces()
        if grass is not None:
            self.data.xfrc_applied[self.wheel_bodies, :3] = grass
        if self._faults_active:
            for fault in self._hidden:
                speeds = fault.wheel_speeds(self.time, speeds)
                fault.apply_forces(self)
            self._set_friction()
        if self._differentials:
            # The servos of one differential act on the same mean speed.
            speeds = np.array(speeds)
            for turned in self._differentials:
                speeds[turned] = speeds[turned].mean()
        self.data.ctrl[: len(self.driven)] = speeds[self.driven]
        if self._servos is not None:
            # The model's zero is the angle in the robot file.
            targets = self._servos.step(angles) - self._rest
            if self._faults_active:
                for fault in self._hidden:
                    targets = fault.joint_targets(self, targets)
            self.data.ctrl[len(self.driven) :] = targets
        mujoco.mj_step(self.model, self.data)
        self.steps += 1

    def update_kinematics(self) -> None:
        """Update the geometry that sensors see to the current state; after a step it lags by one step."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def state(self) -> BaseState:
        """Current pose and twist of the base frame."""
        quaternion = self.data.qpos[[4, 5, 6, 3]] / np.linalg.norm(self.data.qpos[3:7])
        return BaseState(
            position=self.data.qpos[:3] - self.odom_origin,
            quaternion=quaternion,
            # A free joint's linear velocity is in the world frame, its angular velocity in the body frame.
            linear_velocity=Rotation.from_quat(quaternion).inv().apply(self.data.qvel[:3]),
            angular_velocity=self.data.qvel[3:6].copy(),
        )

    def world_pose(self) -> np.ndarray:
        """Current pose ``[4, 4]``, world ← base."""
        pose = np.eye(4)
        pose[:3, :3] = self.state().rotation
        pose[:3, 3] = self.data.qpos[:3]
        return pose

    def wheel_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Angle [rad] and speed [rad/s] of each wheel, positive forwards."""
        return self.data.qpos[self._wheel_positions].copy(), self.data.qvel[self._wheel_velocities].copy()

    def joint_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Angle [rad] and rate [rad/s] of wheels, steering, casters and flippers, in the order of ``joint_names``."""
        angles, speeds = self.wheel_states()
        if not self._joints:
            return angles, speeds
        moved = np.array([self.data.qpos[joint.qposadr[0]] for joint in self._joints]) + self._offsets
        rates = np.array([self.data.qvel[joint.dofadr[0]] for joint in self._joints])
        return np.concatenate([angles, moved]), np.concatenate([speeds, rates])

    def mishap(self) -> str | None:
        """Why the simulation cannot continue, or None."""
        if not np.isfinite(self.data.qpos).all():
            return "the simulation became unstable"
        if self.state().rotation[2, 2] < math.cos(_LARGEST_TILT):
            return "the robot tipped over"
        if not self._scenery.ground.contains(self.data.qpos[:2], _EDGE_MARGIN):
            return "the robot reached the edge of the world"
        return None

    def heading(self) -> float:
        """Direction of the chassis' x axis in the horizontal plane [rad]."""
        axes = self.data.xmat[self.base]
        return math.atan2(axes[3], axes[0])

    def wheel_velocities(self) -> np.ndarray:
        """Velocity of each wheel's centre in world axes ``[wheels, 3]`` [m/s]."""
        centres = self.data.xpos[self.wheel_bodies]
        turning = self.data.xmat[self.base].reshape(3, 3) @ self.data.qvel[3:6]
        return self.data.qvel[:3] + np.cross(turning, centres - self.data.xpos[self.base])

    def grass_forces(self) -> np.ndarray | None:
        """Force of the grass on each wheel ``[wheels, 3]`` [N], or None where no wheel touches grass."""
        if not self._is_near(self._near_grass):
            return None
        centres = self.data.xpos[self.wheel_bodies]
        return self._scenery.grass.wheel_forces(
            self._scenery.ground, centres, self._radii, self.wheel_velocities(), self._grass_share
        )

    def _is_near(self, cells: np.ndarray) -> bool:
        origin = self._scenery.ground.origin
        column, row = ((self.data.qpos[axis] - origin[axis]) / self._cell for axis in range(2))
        if not (math.isfinite(row) and math.isfinite(column)):
            return False
        last = cells.shape[0] - 1
        return bool(cells[min(max(int(row), 0), last), min(max(int(column), 0), last)])

    def _set_friction(self) -> None:
        """Set the friction of each tyre to that of the ground below it."""
        friction = self._scenery.friction
        if friction is not None:
            if self.steps % _STEPS_PER_FRICTION == 0:
                factors = friction.nearest(self.data.xpos[self.wheel_bodies, :2])
                self.model.geom_friction[self.tyres, 0] = self.tyre_friction * factors
            return
        near = self._is_near(self._near_patch)
        if not near and not self._on_patch:
            return
        self._on_patch = near
        factors = np.ones(len(self.tyres))
        for patch in self._scenery.patches:
            factors[patch.contains(self.data.xpos[self.wheel_bodies, :2])] = patch.friction
        self.model.geom_friction[self.tyres, 0] = self.tyre_friction * factors
