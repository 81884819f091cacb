"""Newton engine: simulates many platforms' drives in one model with position-based dynamics (XPBD) on Warp.

A step costs tens of milliseconds of Python whatever it contains, so drives are simulated side by side.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import newton
import numpy as np
import warp as wp
from drawn_platform import GRAVITY, Platform
from drive_session import DriveJob, DriveSession, Trace, combined_build
from ground_shape import HALF_SIZE, Ground
from injection import TICK, BaseState, Build
from scipy.spatial.transform import Rotation

TIME_STEP = 0.002
"""[s]; with 5 ms the robots hop."""
_ITERATIONS = 4
_SETTLING = 1.0
_WHEEL_SHARE = 0.12
"""Share of a robot's mass in its wheels."""
_DAMPING_RATIO = 0.5
"""Of the tyres."""
_HILL_STRIDE = 2
"""Every second node of the height field: contacts cost by the triangles under a wheel. After 3 s on six grounds robots
are 3 mm elsewhere, less than the map is wrong."""
_SOFT_TYRES = 0.25
"""Factor on the tyres' stiffness on soft ground: contacts of this engine are rigid."""


def simulate_together(
    jobs: Sequence[DriveJob], progress: Callable[[float], object] = lambda seconds: None
) -> list[Trace]:
    """Simulate drives; each ends early at a mishap, which its trace names.

    Args:
        jobs: the drives.
        progress: called with the simulated seconds since its last call.
    """
    worlds = _Worlds(jobs)
    sessions = [DriveSession(job) for job in jobs]
    worlds.step(round(_SETTLING / TIME_STEP))
    running = [True] * len(jobs)
    count = max(round(job.duration / TICK) for job in jobs) + 1
    for number in range(count):
        if not any(running):
            break
        states = worlds.states()
        for index, (session, state) in enumerate(zip(sessions, states, strict=True)):
            running[index] &= number <= round(jobs[index].duration / TICK)
            if not running[index]:
                continue
            worlds.drive(index, *session.tick(state))
            if number % 50 == 0 and not session.check():
                running[index] = False
                worlds.drive(index, np.zeros(2), np.zeros(3), np.zeros(3))
        worlds.step(round(TICK / TIME_STEP))
        if number % 100 == 99:
            progress(100 * TICK)
    return [session.trace() for session in sessions]


@wp.kernel
def _servo_torques(
    poses: wp.array[wp.transform],
    velocities: wp.array[wp.spatial_vector],
    wheels: wp.array[int],
    chassis: wp.array[int],
    targets: wp.array[float],
    stiffness: wp.array[float],
    limits: wp.array[float],
    forces: wp.array[wp.spatial_vector],
):
    """Torques [N m] of the servos on wheels, with the reactions on their chassis."""
    index = wp.tid()
    wheel, base = wheels[index], chassis[index]
    axle = wp.quat_rotate(wp.transform_get_rotation(poses[base]), wp.vec3(0.0, 1.0, 0.0))
    speed = wp.dot(axle, wp.spatial_bottom(velocities[wheel]) - wp.spatial_bottom(velocities[base]))
    torque = wp.clamp(stiffness[index] * (targets[index] - speed), -limits[index], limits[index]) * axle
    forces[wheel] = wp.spatial_vector(wp.vec3(), torque)
    wp.atomic_sub(forces, base, wp.spatial_vector(wp.vec3(), torque))


class _Worlds:
    """A model with one world per drive."""

    def __init__(self, jobs: Sequence[DriveJob]):
        wp.config.log_level = wp.LOG_WARNING
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        slippery = newton.ModelBuilder.ShapeConfig(mu=0.0, density=0.0)
        self._robots = []
        for job in jobs:
            builder.begin_world()
            # In its own world: a plane for all would fill the valleys of the others.
            if job.ground.heights is None:
                builder.add_ground_plane(cfg=slippery)
            else:
                _add_hills(builder, job.ground, slippery)
            self._robots.append(_Robot(builder, job))
            builder.end_world()
        self._model = builder.finalize(device="cpu")
        self._solver = newton.solvers.SolverXPBD(self._model, iterations=_ITERATIONS)
        self._pipeline = newton.CollisionPipeline(self._model, broad_phase="explicit")
        self._contacts = self._pipeline.contacts()
        self._state, self._next = self._model.state(), self._model.state()
        self._control = self._model.control()
        newton.eval_fk(self._model, self._model.joint_q, self._model.joint_qd, self._state)
        robots = self._robots
        self._targets = np.zeros(sum(len(robot.wheels) for robot in robots), np.float32)
        self._external = wp.zeros_like(self._state.body_f)
        self._forces = self._external.numpy()
        self._goals = wp.array(self._targets, dtype=float)
        self._wheels = wp.array([wheel for robot in robots for wheel in robot.wheels], dtype=int)
        self._chassis = wp.array([robot.chassis for robot in robots for _ in robot.wheels], dtype=int)
        self._stiffness = wp.array([robot.servo_stiffness for robot in robots for _ in robot.wheels], dtype=float)
        self._limits = wp.array([robot.torque_limit for robot in robots for _ in robot.wheels], dtype=float)
        first = np.cumsum([0, *(len(robot.wheels) for robot in robots)])
        self._slices = [slice(start, stop) for start, stop in itertools.pairwise(first.tolist())]

    def drive(self, index: int, targets: np.ndarray, force: np.ndarray, torque: np.ndarray) -> None:
        """Set target speeds ``[2]`` [rad/s], force [N] and torque [N m] of one robot."""
        robot = self._robots[index]
        self._targets[self._slices[index]] = np.where(robot.left, targets[0], targets[1])
        self._forces[robot.chassis, :3], self._forces[robot.chassis, 3:] = force, torque

    def step(self, count: int) -> None:
        """Advance by some time steps."""
        self._goals.assign(self._targets)
        self._external.assign(self._forces)
        for _ in range(count):
            state = self._state
            wp.copy(state.body_f, self._external)
            inputs = [state.body_q, state.body_qd, self._wheels, self._chassis, self._goals, self._stiffness]
            wp.launch(_servo_torques, len(self._targets), [*inputs, self._limits, state.body_f])
            self._pipeline.collide(state, self._contacts)
            self._solver.step(state, self._next, self._control, self._contacts, TIME_STEP)
            self._state, self._next = self._next, state

    def states(self) -> list[BaseState]:
        """States of all robots."""
        poses, velocities = self._state.body_q.numpy(), self._state.body_qd.numpy()
        rotations = Rotation.from_quat(poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)).as_matrix()
        return [robot.state(poses, velocities, rotations) for robot in self._robots]


class _Robot:
    """A platform as bodies and joints of a world."""

    def __init__(self, builder: newton.ModelBuilder, job: DriveJob):
        platform, ground, build = job.platform, job.ground, combined_build(job.injections)
        centres = platform.wheel_centres
        points = [centres[:, :2] + (shift, 0.0) for shift in np.linspace(-platform.radius, platform.radius, 5)]
        surface = float(ground.height(np.concatenate(points)).max())
        height = surface + platform.radius - platform.axle_height + 0.005 + (0.3 if build.lifted else 0.0)
        wheel_mass = _WHEEL_SHARE * platform.mass / len(centres)
        mass, centre, inertia = _chassis(platform, build, wheel_mass)
        self._centre = centre
        self.torque_limit, self.servo_stiffness = platform.torque_limit, platform.servo_stiffness
        self.left = np.arange(len(centres)) < platform.axles
        self.chassis = builder.add_link(
            xform=wp.transform((0.0, 0.0, height), wp.quat_identity()), com=wp.vec3(*centre), mass=mass,
            inertia=wp.mat33(*inertia.ravel()), lock_inertia=True,
        )  # fmt: skip
        start = wp.transform((0.0, 0.0, height), wp.quat_identity())
        if build.lifted:
            joints = [builder.add_joint_fixed(parent=-1, child=self.chassis, parent_xform=start)]
        else:
            joints = [builder.add_joint_free(child=self.chassis, parent_xform=wp.transform())]
            builder.joint_q[-7:] = [0.0, 0.0, height, 0.0, 0.0, 0.0, 1.0]
        self.wheels: list[int] = []
        middle = float(centres[:, 0].mean())
        for index, place in enumerate(centres):
            end = 0 if place[0] > middle + 1e-9 else 1
            factor = build.friction[end] if abs(place[0] - middle) > 1e-9 else float(np.mean(build.friction))
            eccentricity = build.eccentricity if index == 0 else 0.0
            joints.append(self._add_wheel(builder, platform, build, place, height, wheel_mass, factor, eccentricity))
        builder.add_articulation(joints)

    def _add_wheel(
        self, builder: newton.ModelBuilder, platform: Platform, build: Build, place: np.ndarray, height: float,
        mass: float, friction: float, eccentricity: float,
    ) -> int:  # fmt: skip
        spin = _spin_inertia(platform, mass)
        across = max(0.55 * spin, mass * (3 * platform.radius**2 + platform.width**2) / 12)
        wheel = builder.add_link(
            xform=wp.transform((place[0], place[1], height + place[2]), wp.quat_identity()), mass=mass,
            inertia=wp.mat33(*np.diag([across, spin, across]).ravel()), lock_inertia=True,
        )  # fmt: skip
        # The ground has no friction of its own, and the engine takes the mean of both.
        grip = newton.ModelBuilder.ShapeConfig(mu=2.0 * friction * platform.friction, density=0.0)
        builder.add_shape_sphere(
            wheel, xform=wp.transform((eccentricity, 0.0, 0.0), wp.quat_identity()), radius=platform.radius, cfg=grip
        )
        stiffness = platform.load / platform.tyre_deflection * (_SOFT_TYRES if build.contact_time > 1.0 else 1.0)
        damping = 2 * _DAMPING_RATIO * math.sqrt(stiffness * platform.load / GRAVITY)
        config = newton.ModelBuilder.JointDofConfig
        joint = builder.add_joint_d6(
            parent=self.chassis,
            child=wheel,
            # At rest on level ground the base frame keeps its height.
            linear_axes=[
                config(axis=(0.0, 0.0, 1.0), target_q=-platform.tyre_deflection, target_ke=stiffness, target_kd=damping)
            ],
            angular_axes=[config(axis=(0.0, 1.0, 0.0))],
            parent_xform=wp.transform(tuple(place), wp.quat_identity()),
            collision_filter_parent=True,
        )
        self.wheels.append(wheel)
        return joint

    def state(self, poses: np.ndarray, velocities: np.ndarray, rotations: np.ndarray) -> BaseState:
        """The state of this robot among those of all bodies; velocities are those of the centres of mass."""
        rotation, position = rotations[self.chassis], poses[self.chassis, :3].astype(float)
        rates = rotation.T @ velocities[self.chassis, 3:]
        velocity = rotation.T @ velocities[self.chassis, :3] - np.cross(rates, self._centre)
        axle = rotation[:, 1]
        speeds = velocities[self.wheels, 3:] @ axle - rates[1]
        return BaseState(position, rotation, velocity, rates, speeds)


def _spin_inertia(platform: Platform, mass: float) -> float:
    """Inertia of a wheel about its axle, with motor and gear, without which the servo is faster than the time step."""
    return mass * platform.radius**2 + 0.008 * platform.servo_stiffness


def _chassis(platform: Platform, build: Build, wheel_mass: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass ``[3]`` and inertia ``[3, 3]`` of the chassis, with the payload."""
    centres = platform.wheel_centres
    mass = platform.mass - wheel_mass * len(centres)
    centre = (platform.mass * np.array(platform.centre_of_mass) - wheel_mass * centres.sum(axis=0)) / mass
    x, y, z = np.array(platform.box) ** 2
    inertia = np.diag([y + z, x + z, x + y]) * mass / 12.0
    if build.payload:
        position, total = np.array(build.payload_position), mass + build.payload
        joint = (mass * centre + build.payload * position) / total
        for part, place in ((mass, centre), (build.payload, position)):
            offset = place - joint
            inertia = inertia + part * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        mass, centre = total, joint
    return mass, centre, inertia


def _add_hills(builder: newton.ModelBuilder, ground: Ground, config: newton.ModelBuilder.ShapeConfig) -> None:
    assert ground.heights is not None
    heights = ground.heights[::_HILL_STRIDE, ::_HILL_STRIDE]
    low, high = float(heights.min()), float(heights.max())
    rows, columns = heights.shape
    field = newton.Heightfield(data=heights, nrow=rows, ncol=columns, hx=HALF_SIZE, hy=HALF_SIZE, min_z=low, max_z=high)
    builder.add_shape_heightfield(heightfield=field, cfg=config)
