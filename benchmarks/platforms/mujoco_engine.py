"""MuJoCo engine: simulates a platform's drive; shares no vehicle or terrain code with the package."""

from __future__ import annotations

import math

import numpy as np
from drawn_platform import GRAVITY, Platform
from drive_session import DriveJob, DriveSession, Trace, combined_build
from ground_shape import HALF_SIZE, Ground
from injection import TICK, BaseState, Build

from monoforce_ros.synthetic.graphics import mujoco

TIME_STEP = 0.002
"""[s]."""
_SETTLING = 2.0
_WHEEL_SHARE = 0.12
"""Share of a robot's mass in its wheels."""
_DAMPING_RATIO = 0.5
"""Of the tyres."""


def simulate(job: DriveJob) -> Trace:
    """Simulate a drive; it ends early at a mishap, which the trace names."""
    build = combined_build(job.injections)
    model = _model(job.platform, job.ground, build)
    data = mujoco.MjData(model)
    base = model.body("base").id
    axles = [model.joint(f"axle_{index}").dofadr[0] for index in range(2 * job.platform.axles)]
    left = np.arange(2 * job.platform.axles) < job.platform.axles
    free = 0 if not build.lifted else None
    ticks = round(TICK / TIME_STEP)
    mujoco.mj_step(model, data, round(_SETTLING / TIME_STEP))

    def state() -> BaseState:
        rotation = data.xmat[base].reshape(3, 3).copy()
        if free is None:
            velocity = rates = np.zeros(3)
        else:
            velocity, rates = rotation.T @ data.qvel[0:3], data.qvel[3:6].copy()
        return BaseState(data.xpos[base].copy(), rotation, velocity, rates, data.qvel[axles].copy())

    session = DriveSession(job)
    for number in range(round(job.duration / TICK) + 1):
        targets, force, torque = session.tick(state())
        if number % 50 == 0 and not session.check():
            break
        data.ctrl[:] = np.where(left, targets[0], targets[1])
        data.xfrc_applied[base, :3], data.xfrc_applied[base, 3:] = force, torque
        mujoco.mj_step(model, data, ticks)
    return session.trace()


def _model(platform: Platform, ground: Ground, build: Build) -> mujoco.MjModel:
    """The compiled world. Only wheels collide with the ground, which is too gentle to touch the chassis."""
    spec = mujoco.MjSpec()
    spec.option.timestep = TIME_STEP
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    _add_ground(spec, ground)
    centres = platform.wheel_centres
    # Dropped from just above the highest ground under a wheel; it settles before the recording starts.
    points = [centres[:, :2] + (shift, 0.0) for shift in np.linspace(-platform.radius, platform.radius, 5)]
    surface = float(ground.height(np.concatenate(points)).max())
    height = surface + platform.radius - platform.axle_height + 0.01
    base = spec.worldbody.add_body(name="base", pos=[0.0, 0.0, height + (0.3 if build.lifted else 0.0)])
    if not build.lifted:
        base.add_freejoint()
    wheel_mass = _WHEEL_SHARE * platform.mass / len(centres)
    _set_chassis(base, platform, build, wheel_mass)
    middle = float(centres[:, 0].mean())
    for index, centre in enumerate(centres):
        front = 0 if centre[0] > middle + 1e-9 else 1
        factor = build.friction[front] if abs(centre[0] - middle) > 1e-9 else float(np.mean(build.friction))
        eccentricity = build.eccentricity if index == 0 else 0.0
        _add_wheel(spec, base, platform, index, centre, wheel_mass, platform.friction * factor, eccentricity, build)
    return spec.compile()


def _add_ground(spec: mujoco.MjSpec, ground: Ground) -> None:
    # The wheels' contact parameters have priority over these.
    if ground.heights is None:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], contype=1, conaffinity=2)
        return
    low, high = float(ground.heights.min()), float(ground.heights.max())
    rows, columns = ground.heights.shape
    spec.add_hfield(
        name="ground",
        nrow=rows,
        ncol=columns,
        size=[HALF_SIZE, HALF_SIZE, high - low, 0.5],
        userdata=((ground.heights - low) / (high - low)).ravel().tolist(),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[0.0, 0.0, low], contype=1, conaffinity=2
    )


def _set_chassis(base: mujoco.MjsBody, platform: Platform, build: Build, wheel_mass: float) -> None:
    """Set the inertia of the chassis so that chassis, wheels and payload add up to the robot's."""
    centres = platform.wheel_centres
    mass = platform.mass - wheel_mass * len(centres)
    centre = (platform.mass * np.array(platform.centre_of_mass) - wheel_mass * centres.sum(axis=0)) / mass
    inertia = _box_inertia(platform.mass, np.array(platform.box))
    inertia *= 1.0 - _WHEEL_SHARE
    if build.payload:
        position = np.array(build.payload_position)
        total = mass + build.payload
        joint = (mass * centre + build.payload * position) / total
        inertia = inertia + _point_inertia(mass, centre - joint) + _point_inertia(build.payload, position - joint)
        mass, centre = total, joint
    base.explicitinertial = True
    base.mass = mass
    base.ipos = centre
    base.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _add_wheel(
    spec: mujoco.MjSpec, base: mujoco.MjsBody, platform: Platform, index: int, centre: np.ndarray, mass: float,
    friction: float, eccentricity: float, build: Build,
) -> None:  # fmt: skip
    wheel = base.add_body(name=f"wheel_{index}", pos=centre)
    wheel.explicitinertial = True
    # Left out, it would be as far from the axle as the axle is from the base frame's origin.
    wheel.ipos = [0.0, 0.0, 0.0]
    wheel.mass = mass
    spin, across = mass * platform.radius**2 / 2, mass * (3 * platform.radius**2 + platform.width**2) / 12
    wheel.inertia = [across, spin, across]
    stiffness = platform.load / platform.tyre_deflection
    tyre = wheel.add_joint(name=f"tyre_{index}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    tyre.stiffness = [stiffness, 0.0, 0.0]
    tyre.damping = [2 * _DAMPING_RATIO * math.sqrt(stiffness * platform.load / GRAVITY), 0.0, 0.0]
    # At rest on level ground the base frame keeps its height.
    tyre.springref = -platform.tyre_deflection
    axle = wheel.add_joint(name=f"axle_{index}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    # Inertia of motor and gear; without it the servo of a light wheel is faster than the time step.
    axle.armature = spin + 0.02 * platform.servo_stiffness
    # A balloon tyre; a cylinder's edges cost three times as much over a height field.
    wheel.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[platform.radius, platform.width / 2, platform.radius],
        pos=[eccentricity, 0.0, 0.0], contype=2, conaffinity=1, priority=1, condim=3,
        friction=[friction, 0.005, 0.0001], solref=[platform.contact_time * build.contact_time, 1.0],
    )  # fmt: skip
    servo = spec.add_actuator(name=f"servo_{index}", target=f"axle_{index}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_velocity(kv=platform.servo_stiffness)
    servo.forcelimited = True
    servo.forcerange = [-platform.torque_limit, platform.torque_limit]


def _box_inertia(mass: float, edges: np.ndarray) -> np.ndarray:
    x, y, z = edges**2
    return np.diag([y + z, x + z, x + y]) * mass / 12.0


def _point_inertia(mass: float, offset: np.ndarray) -> np.ndarray:
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
