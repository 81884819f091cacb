"""Plants: physics that is hidden in a simulated world for a workflow to find.

Each works by a mechanism of the simulator — another wheel, another servo, another mass, a force at a place — rather
than by a formula of the model that is to be found wanting, and shares no code with it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import ClassVar, override

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic.fault import Fault, Subject
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle import Vehicle


class CommandDelay(Fault):
    """Commands wait in a queue before the servos see them."""

    parameters: ClassVar = {"delay": (0.25, 0.05, 1.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self._queue: deque[tuple[float, np.ndarray]] = deque()
        self._acting = None

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        self._queue.append((time, speeds))
        while self._queue and self._queue[0][0] <= time - self.delay + 1e-9:
            self._acting = self._queue.popleft()[1]
        return np.zeros_like(speeds) if self._acting is None else self._acting


class ActuatorLag(Fault):
    """The simulator's own first-order filter between command and servo."""

    parameters: ClassVar = {"time_constant": (0.3, 0.05, 1.5)}

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for servo in spec.actuators:
            servo.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
            servo.dynprm[0] = self.time_constant


class ActuatorSaturation(Fault):
    """Motors whose torque falls along a line to nothing at their largest speed."""

    parameters: ClassVar = {"limit": (0.5, 0.1, 5.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        robot = simulation.robot
        simulation.model.actuator_forcelimited[:] = 1
        self._largest = self.limit / np.array([wheel.radius for wheel in robot.wheels])
        self._stall = 6.0 * robot.mass * 9.81 * robot.wheels[0].radius / len(robot.wheels)
        self.push(simulation)

    @override
    def push(self, simulation: Subject) -> None:
        share = simulation.wheel_states()[1] / self._largest
        limits = simulation.model.actuator_forcerange
        limits[:, 1] = self._stall * np.clip(1.0 - share, 0.0, 1.0)
        limits[:, 0] = -self._stall * np.clip(1.0 + share, 0.0, 1.0)


class ActuatorDeadband(Fault):
    """Static friction: a drive starts to turn above the band, turns slower by it, and stops within half of it."""

    parameters: ClassVar = {"width": (0.1, 0.02, 0.5)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self._radii = np.array([wheel.radius for wheel in simulation.robot.wheels])
        self._turning = np.zeros(len(self._radii), bool)

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        surface = np.abs(speeds) * self._radii
        self._turning = surface > np.where(self._turning, self.width, 1.15 * self.width)
        return np.where(self._turning, np.sign(speeds) * (surface - self.width) / self._radii, 0.0)


class DriveGain(Fault):
    """Wheels of another radius than the base controller believes."""

    parameters: ClassVar = {"gain": (0.85, 0.5, 1.3)}

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        _scale_wheels(spec, robot, lambda wheel: self.gain)


class DriveAsymmetry(Fault):
    """Motor controllers that were calibrated differently: one side runs faster than told, the other slower."""

    parameters: ClassVar = {"difference": (0.1, -0.4, 0.4)}

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for servo, wheel in zip(spec.actuators, robot.wheels, strict=True):
            servo.gainprm[0] *= 1.0 - 0.5 * self.difference * np.sign(wheel.centre[1])


class FrictionScale(Fault):
    """Tyres of another rubber, whose friction wins over the ground's."""

    parameters: ClassVar = {"factor": (0.4, 0.1, 1.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        simulation.tyre_friction *= self.factor


class TurningScrub(Fault):
    """Axles further apart: the wheels scrub more in a turn, and drive straight as before."""

    parameters: ClassVar = {"wheelbase_factor": (1.5, 1.0, 2.5)}

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        for wheel in robot.wheels:
            spec.body(wheel.joint).pos[0] = wheel.centre[0] * self.wheelbase_factor


class RollingResistance(Fault):
    """A force at each wheel against its rolling, as a part of the weight that it carries at rest."""

    parameters: ClassVar = {"coefficient": (0.15, 0.02, 0.6)}

    @override
    def push(self, simulation: Subject) -> None:
        robot, bodies = simulation.robot, simulation.wheel_bodies
        ahead = Rotation.from_euler("z", simulation.heading()).apply([1.0, 0.0, 0.0])
        speed = simulation.wheel_velocities() @ ahead
        load = robot.mass * 9.81 / len(robot.wheels)
        held = self.coefficient * load * np.clip(speed / 0.03, -1.0, 1.0)
        simulation.data.xfrc_applied[bodies, :3] -= held[:, None] * ahead


class TerrainSoftness(Fault):
    """Contacts that give way."""

    parameters: ClassVar = {"factor": (9.0, 2.0, 50.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        # The stiffness of a MuJoCo contact goes with the inverse square of its time constant.
        simulation.model.geom_solref[simulation.tyres, 0] *= math.sqrt(self.factor)


class VegetationDrag(Fault):
    """Grass that holds the wheels back harder."""

    parameters: ClassVar = {"strength": (3.0, 1.0, 10.0)}

    @override
    def push(self, simulation: Subject) -> None:
        forces = simulation.grass_forces()
        if forces is not None:
            forces[:, 2] = 0.0
            simulation.data.xfrc_applied[simulation.wheel_bodies, :3] += (self.strength - 1.0) * forces


class Payload(Fault):
    """A box fixed to the robot."""

    parameters: ClassVar = {
        "mass": (20.0, 1.0, 300.0),
        "x": (-0.25, -1.0, 1.0),
        "y": (0.1, -1.0, 1.0),
        "z": (0.35, 0.0, 1.5),
    }

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        box = spec.body("base").add_body(name="payload", pos=[self.x, self.y, self.z])
        box.explicitinertial = True
        box.mass = self.mass
        box.inertia = np.full(3, self.mass * 0.15**2 / 6)


class ViscousDrag(Fault):
    """Damping of the base's translation, as in a liquid."""

    parameters: ClassVar = {"coefficient": (150.0, 10.0, 1000.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        simulation.model.dof_damping[:3] = self.coefficient


class QuadraticDrag(Fault):
    """The air's resistance on the hull, at its middle."""

    parameters: ClassVar = {"coefficient": (200.0, 10.0, 1000.0)}

    @override
    def push(self, simulation: Subject) -> None:
        velocity = simulation.data.qvel[:3].copy()
        velocity[2] = 0.0
        _push_hull(simulation, -self.coefficient * np.linalg.norm(velocity) * velocity)


class GravityTilt(Fault):
    """A world that leans."""

    parameters: ClassVar = {"about_y": (0.08, -0.3, 0.3), "about_x": (0.0, -0.3, 0.3)}

    @override
    def prepare(self, simulation: Subject) -> None:
        turn = Rotation.from_rotvec([self.about_x, self.about_y, 0.0])
        simulation.model.opt.gravity[:] = turn.apply([0.0, 0.0, -9.81])


class ConstantForce(Fault):
    """A tether that pulls at the hull, not quite evenly."""

    parameters: ClassVar = {"x": (-80.0, -800.0, 800.0), "y": (0.0, -800.0, 800.0)}

    @override
    def push(self, simulation: Subject) -> None:
        ripple = 1.0 + 0.1 * math.sin(2.0 * simulation.time)
        _push_hull(
            simulation, Rotation.from_euler("z", simulation.heading()).apply([self.x * ripple, self.y * ripple, 0])
        )


class PoseClockOffset(Fault):
    """Poses carry the stamp of another clock."""

    parameters: ClassVar = {"offset": (0.2, -1.0, 1.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self.pose_stamp_offset = self.offset


class CommandClockOffset(Fault):
    """Commands carry the stamp of another clock."""

    parameters: ClassVar = {"offset": (0.2, -1.0, 1.0)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self.command_stamp_offset = self.offset


class SensorYawOffset(Fault):
    """The pose sensor is mounted askew."""

    parameters: ClassVar = {"angle": (0.15, -1.0, 1.0)}

    @override
    def sensor_pose(self) -> tuple[np.ndarray, float]:
        return np.zeros(3), self.angle


class SensorLeverArm(Fault):
    """The pose sensor sits elsewhere."""

    parameters: ClassVar = {"x": (0.4, -1.5, 1.5), "y": (0.0, -1.5, 1.5)}

    @override
    def sensor_pose(self) -> tuple[np.ndarray, float]:
        return np.array([self.x, self.y, 0.0]), 0.0


class GyroBias(Fault):
    """The gyro shows a rate at rest."""

    parameters: ClassVar = {"bias": (0.05, -0.3, 0.3)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self.gyro_offset = self.bias


class FadingDrive(Fault):
    """Not in the catalogue: drives that slow down as they warm up."""

    in_catalogue: ClassVar = False
    parameters: ClassVar = {"time_constant": (60.0, 10.0, 600.0)}

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        return speeds * (0.4 + 0.6 * math.exp(-max(time, 0.0) / self.time_constant))


class GustingWind(Fault):
    """Not in the catalogue: a wind from one direction of the world that comes and goes."""

    in_catalogue: ClassVar = False
    parameters: ClassVar = {"force": (200.0, 20.0, 800.0), "period": (9.0, 2.0, 60.0)}

    @override
    def push(self, simulation: Subject) -> None:
        strength = math.sin(2 * math.pi * simulation.time / self.period)
        _push_hull(simulation, self.force * strength * np.array([0.5, 0.87, 0.0]))


class EccentricWheel(Fault):
    """Not in the catalogue: front left wheel not centred on its axle."""

    in_catalogue: ClassVar = False
    parameters: ClassVar = {"offset": (0.03, 0.005, 0.08)}

    @override
    def shape(self, spec: mujoco.MjSpec, robot: Vehicle) -> None:
        spec.geom(robot.wheels[0].surface).pos = [self.offset, 0.0, 0.0]


class StickyTurn(Fault):
    """Not in the catalogue: play in the steering, so that the turning rate follows only after a change of the width."""

    in_catalogue: ClassVar = False
    parameters: ClassVar = {"width": (0.4, 0.05, 1.5)}

    @override
    def prepare(self, simulation: Subject) -> None:
        self._side = np.sign([wheel.centre[1] for wheel in simulation.robot.wheels])
        self._arm = abs(simulation.robot.wheels[0].centre[1]) / simulation.robot.wheels[0].radius
        self._held = 0.0

    @override
    def wheel_speeds(self, time: float, speeds: np.ndarray) -> np.ndarray:
        turning = -(speeds * self._side).mean()
        half = 0.5 * self.width * self._arm
        self._held = float(np.clip(self._held, turning - half, turning + half))
        return speeds + self._side * (turning - self._held)


class SpeedPull(Fault):
    """Not in the catalogue: a torque that turns the robot to the left and grows with the square of its speed."""

    in_catalogue: ClassVar = False
    parameters: ClassVar = {"torque": (200.0, 5.0, 600.0)}

    @override
    def push(self, simulation: Subject) -> None:
        speed = float(simulation.state().linear_velocity[0])
        simulation.data.xfrc_applied[simulation.base, 5] += self.torque * speed * abs(speed)


def _scale_wheels(spec: mujoco.MjSpec, robot: Vehicle, factor) -> None:
    for wheel in robot.wheels:
        spec.geom(wheel.surface).size[0] = wheel.radius * factor(wheel)


def _push_hull(simulation: Subject, force: np.ndarray) -> None:
    """A force in world axes [N] at the middle of the hull, by its effect at the base body's centre of mass."""
    data, base = simulation.data, simulation.base
    hull = simulation.robot.hull
    middle = hull[0][0] if hull else np.zeros(3)
    place = data.xpos[base] + data.xmat[base].reshape(3, 3) @ middle
    data.xfrc_applied[base, :3] += force
    data.xfrc_applied[base, 3:] += np.cross(place - data.xipos[base], force)
