"""Faults to inject into a simulated world.

Each uses a mechanism of the simulator, such as a different wheel, servo, mass or external force, instead of the formula
of the effect that the diagnosis fits, and shares no code with it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import override

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic.fault import Fault, Parameter, Simulation
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.vehicle_parts import set_inertia


class CommandDelay(Fault):
    """Commands wait in a queue before they reach the servos."""

    delay = Parameter(0.25, 0.05, 1.0)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        self._queue: deque[tuple[float, np.ndarray]] = deque()
        self._acting: np.ndarray | None = None

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        self._queue.append((time, speeds))
        while self._queue and self._queue[0][0] <= time - self.delay + 1e-9:
            self._acting = self._queue.popleft()[1]
        return np.zeros_like(speeds) if self._acting is None else self._acting


class ActuatorLag(Fault):
    """First-order filter between command and servo, built into the simulator's actuator."""

    time_constant = Parameter(0.3, 0.05, 1.5)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.driven:
            servo = spec.actuator(wheel.joint)
            servo.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
            servo.dynprm[0] = self.time_constant


class ActuatorSaturation(Fault):
    """Motor torque that falls linearly to zero at the largest speed."""

    limit = Parameter(0.5, 0.1, 5.0)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        robot = simulation.robot
        self._count = len(simulation.driven)
        simulation.model.actuator_forcelimited[: self._count] = 1
        self._largest = self.limit / np.array([wheel.radius for wheel in robot.driven])
        self._stall = 6.0 * robot.mass * 9.81 * robot.wheels[0].radius / len(robot.wheels)
        self.apply_forces(simulation)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        fraction = simulation.wheel_states()[1][simulation.driven] / self._largest
        limits = simulation.model.actuator_forcerange[: self._count]
        limits[:, 1] = self._stall * np.clip(1.0 - fraction, 0.0, 1.0)
        limits[:, 0] = -self._stall * np.clip(1.0 + fraction, 0.0, 1.0)


class ActuatorDeadband(Fault):
    """Static friction: a drive starts above 1.15 times the width, turns slower by the width, and stops below it."""

    width = Parameter(0.1, 0.02, 0.5)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        self._radii = np.array([wheel.radius for wheel in simulation.robot.wheels])
        self._turning = np.zeros(len(self._radii), bool)

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        surface = np.abs(speeds) * self._radii
        self._turning = surface > np.where(self._turning, self.width, 1.15 * self.width)
        return np.where(self._turning, np.sign(speeds) * (surface - self.width) / self._radii, 0.0)


class DriveGain(Fault):
    """Wheels whose radius differs from the one that the base controller assumes."""

    gain = Parameter(0.85, 0.5, 1.3, neutral=1.0)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.wheels:
            spec.geom(wheel.surface).size[0] = wheel.radius * self.gain


class DriveAsymmetry(Fault):
    """Unequal calibration of the motor controllers: one side runs faster than commanded, the other slower."""

    difference = Parameter(0.1, -0.4, 0.4)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.driven:
            spec.actuator(wheel.joint).gainprm[0] *= 1.0 - 0.5 * self.difference * np.sign(wheel.centre[1])


class DriveCompliance(Fault):
    """Soft servos: a wheel that pulls with as much as its load turns slower by this speed of its rim."""

    speed_loss = Parameter(0.15, 0.03, 1.0)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        load = robot.mass * 9.81 / len(robot.wheels)
        for wheel in robot.driven:
            servo = spec.actuator(wheel.joint)
            gain = load * wheel.radius**2 / self.speed_loss
            servo.gainprm[0] *= gain / -servo.biasprm[2]
            servo.biasprm[2] = -gain


class FrictionScale(Fault):
    """Tyres with another friction coefficient."""

    factor = Parameter(0.4, 0.1, 1.0, neutral=1.0)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        simulation.tyre_friction *= self.factor


class TurningScrub(Fault):
    """A longer wheelbase: the wheels scrub more in turns; straight driving is unchanged."""

    wheelbase_factor = Parameter(1.5, 1.0, 2.5, neutral=1.0)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        carriers = {"": 0.0} | {arm.name: arm.place[0] for arm in robot.arms}
        for wheel in robot.wheels:
            spec.body(wheel.joint).pos[0] = wheel.centre[0] * self.wheelbase_factor - carriers[wheel.arm]


class RollingResistance(Fault):
    """A force against the motion of each wheel, proportional to its static load."""

    coefficient = Parameter(0.15, 0.02, 0.6)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        robot, bodies = simulation.robot, simulation.wheel_bodies
        forward = Rotation.from_euler("z", simulation.heading()).apply([1.0, 0.0, 0.0])
        speed = simulation.wheel_velocities() @ forward
        load = robot.mass * 9.81 / len(robot.wheels)
        resistance = self.coefficient * load * np.clip(speed / 0.03, -1.0, 1.0)
        simulation.data.xfrc_applied[bodies, :3] -= resistance[:, None] * forward


class TerrainSoftness(Fault):
    """Compliant contacts between tyres and ground."""

    factor = Parameter(9.0, 2.0, 50.0, neutral=1.0)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        # The stiffness of a MuJoCo contact is proportional to the inverse square of its time constant.
        simulation.model.geom_solref[simulation.tyres, 0] *= math.sqrt(self.factor)


class VegetationDrag(Fault):
    """Grass with a larger drag on the wheels."""

    strength = Parameter(3.0, 1.0, 10.0, neutral=1.0)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        forces = simulation.grass_forces()
        if forces is not None:
            forces[:, 2] = 0.0
            simulation.data.xfrc_applied[simulation.wheel_bodies, :3] += (self.strength - 1.0) * forces


class Payload(Fault):
    """A box mounted on the robot."""

    mass = Parameter(20.0, 1.0, 300.0)
    x = Parameter(-0.25, -1.0, 1.0)
    y = Parameter(0.1, -1.0, 1.0)
    z = Parameter(0.35, 0.0, 1.5)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        box = spec.body("base").add_body(name="payload", pos=[self.x, self.y, self.z])
        set_inertia(box, self.mass, np.full(3, self.mass * 0.15**2 / 6))


class ViscousDrag(Fault):
    """Linear damping of the base's translation, as in a liquid."""

    coefficient = Parameter(150.0, 10.0, 1000.0)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        simulation.model.dof_damping[:3] = self.coefficient


class QuadraticDrag(Fault):
    """Air resistance that acts on the centre of the hull."""

    coefficient = Parameter(200.0, 10.0, 1000.0)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        velocity = simulation.data.qvel[:3].copy()
        velocity[2] = 0.0
        _push_hull(simulation, -self.coefficient * np.linalg.norm(velocity) * velocity)


class GravityTilt(Fault):
    """A tilted direction of gravity."""

    about_y = Parameter(0.08, -0.3, 0.3)
    about_x = Parameter(0.0, -0.3, 0.3)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        turn = Rotation.from_rotvec([self.about_x, self.about_y, 0.0])
        simulation.model.opt.gravity[:] = turn.apply([0.0, 0.0, -9.81])


class ConstantForce(Fault):
    """A tether that pulls at the hull with a slightly varying force."""

    x = Parameter(-80.0, -800.0, 800.0)
    y = Parameter(0.0, -800.0, 800.0)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        ripple = 1.0 + 0.1 * math.sin(2.0 * simulation.time)
        _push_hull(
            simulation, Rotation.from_euler("z", simulation.heading()).apply([self.x * ripple, self.y * ripple, 0])
        )


class PoseClockOffset(Fault):
    """Poses are stamped by an offset clock."""

    offset = Parameter(0.2, -1.0, 1.0)

    @property
    @override
    def pose_stamp_offset(self) -> float:
        return self.offset


class CommandClockOffset(Fault):
    """Commands are stamped by an offset clock."""

    offset = Parameter(0.2, -1.0, 1.0)

    @property
    @override
    def command_stamp_offset(self) -> float:
        return self.offset


class SensorYawOffset(Fault):
    """The pose sensor is mounted with a yaw offset."""

    angle = Parameter(0.15, -1.0, 1.0)

    @override
    def sensor_pose(self) -> tuple[np.ndarray, float]:
        return np.zeros(3), self.angle


class SensorLeverArm(Fault):
    """The pose sensor is mounted away from the base frame."""

    x = Parameter(0.4, -1.5, 1.5)
    y = Parameter(0.0, -1.5, 1.5)

    @override
    def sensor_pose(self) -> tuple[np.ndarray, float]:
        return np.array([self.x, self.y, 0.0]), 0.0


class GyroBias(Fault):
    """The gyro reports a constant yaw rate at rest."""

    bias = Parameter(0.05, -0.3, 0.3)

    @property
    @override
    def gyro_offset(self) -> float:
        return self.bias


class SteeringLag(Fault):
    """A viscous steering gear: a damper of the steered wheels that their servos have to overcome."""

    needs = "steering"
    time_constant = Parameter(0.4, 0.05, 1.5)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for pivot in robot.steering:
            spec.joint(pivot.name).damping = [self.time_constant * spec.actuator(pivot.name).gainprm[0], 0.0, 0.0]


class SteeringOffset(Fault):
    """A bent steering rod: wheels that are mounted on their hubs at an angle."""

    needs = "steering"
    offset = Parameter(0.05, -0.3, 0.3)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.wheels:
            if wheel.pivot is not None and wheel.pivot.servo is not None:
                spec.joint(wheel.pivot.name).ref = -self.offset


class SteeringGain(Fault):
    """Servos that turn further or less than commanded, such as by another linkage."""

    needs = "steering"
    gain = Parameter(0.75, 0.4, 1.4, neutral=1.0)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for pivot in robot.steering:
            spec.actuator(pivot.name).gainprm[0] *= self.gain


class SteeringDeadband(Fault):
    """Play between servo and hub: within it nothing but the caster trail of the wheels aligns them."""

    needs = "steering"
    width = Parameter(0.06, 0.01, 0.25)
    _TRAIL = 0.25
    """Of the wheel behind its steering axis, over its radius."""

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.wheels:
            if wheel.pivot is not None and wheel.pivot.servo is not None:
                spec.joint(wheel.pivot.name).pos[0] += self._TRAIL * wheel.radius

    @override
    def modify_model(self, simulation: Simulation) -> None:
        model, names = simulation.model, [pivot.name for pivot in simulation.robot.steering]
        self._servos = [model.actuator(name).id for name in names]
        self._joints = [model.joint(name).qposadr[0] for name in names]
        # The servo's damping acts through the play, too.
        model.actuator_biasprm[self._servos, 2] *= 0.1

    @override
    def joint_targets(self, simulation: Simulation, targets: np.ndarray) -> np.ndarray:
        angles, count = simulation.data.qpos[self._joints], len(self._joints)
        error = targets[:count] - angles
        engaged = np.sign(error) * np.maximum(np.abs(error) - self.width, 0.0)
        return np.concatenate([angles + engaged, targets[count:]])


class BlockedFlipper(Fault):
    """Seized gears: a damper that no motor moves, at the flippers whose value is one half or more."""

    needs = "flippers"
    front_left = Parameter(1.0, 0.0, 1.0, one_of_many=True)
    front_right = Parameter(0.0, 0.0, 1.0)
    rear_left = Parameter(0.0, 0.0, 1.0)
    rear_right = Parameter(0.0, 0.0, 1.0)
    _DAMPING = 1e4
    """[N m s/rad] per kilogram of the robot."""

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for arm in robot.flippers:
            end = "front" if arm.centre[0] >= arm.place[0] else "rear"
            side = "left" if arm.place[1] >= 0.0 else "right"
            if self.values[f"{end}_{side}"] >= 0.5:
                spec.joint(arm.name).damping = [self._DAMPING * robot.mass, 0.0, 0.0]


class FadingDrive(Fault):
    """Out of catalogue: drives that slow down as they warm up."""

    in_catalogue = False
    time_constant = Parameter(60.0, 10.0, 600.0)

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        return speeds * (0.4 + 0.6 * math.exp(-max(time, 0.0) / self.time_constant))


class GustingWind(Fault):
    """Out of catalogue: wind that oscillates along one direction of the world."""

    in_catalogue = False
    force = Parameter(200.0, 20.0, 800.0)
    period = Parameter(9.0, 2.0, 60.0)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        strength = math.sin(2 * math.pi * simulation.time / self.period)
        _push_hull(simulation, self.force * strength * np.array([0.5, 0.87, 0.0]))


class EccentricWheel(Fault):
    """Out of catalogue: the front left wheel is not centred on its axle."""

    in_catalogue = False
    offset = Parameter(0.03, 0.005, 0.08)

    @override
    def modify_spec(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        spec.geom(robot.wheels[0].surface).pos = [self.offset, 0.0, 0.0]


class StickyTurn(Fault):
    """Out of catalogue: backlash in the steering; the yaw rate follows a command only beyond the width."""

    in_catalogue = False
    width = Parameter(0.4, 0.05, 1.5)

    @override
    def modify_model(self, simulation: Simulation) -> None:
        self._side = np.sign([wheel.centre[1] for wheel in simulation.robot.wheels])
        self._arm = abs(simulation.robot.wheels[0].centre[1]) / simulation.robot.wheels[0].radius
        self._output = 0.0

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        turning = -(speeds * self._side).mean()
        half = 0.5 * self.width * self._arm
        self._output = float(np.clip(self._output, turning - half, turning + half))
        return speeds + self._side * (turning - self._output)


class SpeedPull(Fault):
    """Out of catalogue: a torque to the left that grows with the square of the speed."""

    in_catalogue = False
    torque = Parameter(200.0, 5.0, 600.0)

    @override
    def apply_forces(self, simulation: Simulation) -> None:
        speed = float(simulation.state().linear_velocity[0])
        simulation.data.xfrc_applied[simulation.base, 5] += self.torque * speed * abs(speed)


def _push_hull(simulation: Simulation, force: np.ndarray) -> None:
    """Apply a force in world axes [N] at the hull's centre, as a wrench at the base body's centre of mass."""
    data, base = simulation.data, simulation.base
    hull = simulation.robot.hull
    middle = hull[0][0] if hull else np.zeros(3)
    position = data.xpos[base] + data.xmat[base].reshape(3, 3) @ middle
    data.xfrc_applied[base, :3] += force
    data.xfrc_applied[base, 3:] += np.cross(position - data.xipos[base], force)
