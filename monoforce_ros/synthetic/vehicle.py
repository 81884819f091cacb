"""Vehicle: a robot file as a MuJoCo body with wheels, and its base controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.robots import RobotFileError, RobotModel, is_lidar, load_robot, robot_file
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle_file import read_arms, read_wheels
from monoforce_ros.synthetic.vehicle_parts import (
    GROUP,
    Arm,
    Pivot,
    Servo,
    Wheel,
    add_joint_servo,
    collides,
    point_inertia,
    quaternion_wxyz,
    set_inertia,
    wheel_moments,
)

LIDAR_FRAME = "lidar"
__all__ = ["BODY", "GROUP", "IMU_SITE", "Vehicle", "Wheel"]

BODY = "base"
IMU_SITE = "imu"
_WHEELS_MASS_FRACTION = 0.12


@dataclass(frozen=True)
class Vehicle:
    """Contents of a robot file as numpy arrays in the base frame.

    Attributes:
        inertia: ``[3, 3]`` about the centre of mass [kg m²].
        hull: centre ``[3]`` and edge lengths ``[3]`` of each box [m].
        sensors: ``[4, 4]`` pose of each sensor frame, base ← sensor.
        arms: flippers and rockers.
        kinematics: the robot's model, whose inverse kinematics the base controller of a robot that steers uses; None
            for the others.
        crabs: whether commands may have a lateral speed.
        maximum_curvature: of a turn [1/m]; infinite for a robot that turns in place.
        wheelbase: of the bicycle to which a steering angle refers [m]; None for a robot without such commands.
        colour: of its body ``[3]`` in 0..1.
    """

    name: str
    base_frame: str
    mass: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray
    wheels: tuple[Wheel, ...]
    hull: tuple[tuple[np.ndarray, np.ndarray], ...]
    sensors: Mapping[str, np.ndarray]
    maximum_speed: float
    maximum_yaw_rate: float
    arms: tuple[Arm, ...] = ()
    kinematics: RobotModel | None = None
    crabs: bool = False
    maximum_curvature: float = float("inf")
    wheelbase: float | None = None
    colour: tuple[float, float, float] = (0.92, 0.72, 0.10)

    @classmethod
    def load(cls, name_or_file: str | Path) -> Vehicle:
        """Read a robot by name or file; each track or flipper becomes a row of small wheels that turn together.

        Raises:
            RobotFileError: the file is invalid.
        """
        robot: RobotModel = load_robot(name_or_file)
        content = yaml.safe_load(robot_file(name_or_file).read_text(encoding="utf-8"))
        hull = tuple((np.array(box["centre"], float), np.array(box["size"], float)) for box in content.get("hull", []))
        steered = robot.steered
        return cls(
            name=robot.name,
            base_frame=robot.base_frame,
            mass=float(robot.mass),
            centre_of_mass=robot.centre_of_mass.double().numpy(),
            inertia=robot.inertia.double().numpy(),
            wheels=tuple(read_wheels(robot, content)),
            hull=hull,
            sensors={frame: _rigid(pose.double().numpy()) for frame, pose in robot.sensors.items()},
            maximum_speed=robot.maximum_speed,
            maximum_yaw_rate=robot.maximum_yaw_rate,
            arms=tuple(read_arms(robot, content)),
            kinematics=None if steered is None else robot.to(torch.float64),
            crabs=steered is not None and steered.crabs,
            maximum_curvature=robot.maximum_curvature,
            wheelbase=None if steered is None or steered.crabs else steered.wheelbase,
        )

    @property
    def clearance(self) -> float:
        """Height of the base frame above level ground [m]."""
        return max(wheel.radius - float(wheel.centre[2]) for wheel in self.wheels)

    @property
    def driven(self) -> tuple[Wheel, ...]:
        """The wheels that a servo turns, in the order of the model's first actuators."""
        return tuple(wheel for wheel in self.wheels if wheel.driven)

    @property
    def steering(self) -> tuple[Pivot, ...]:
        """Pivots of the steered wheels, in the order of commanded angles and of the actuators after the drives'."""
        found = {wheel.pivot.name: wheel.pivot for wheel in self.wheels if wheel.pivot and wheel.pivot.servo}
        if self.kinematics is None or self.kinematics.steered is None:
            return ()
        return tuple(found[self.kinematics.joints[index].name] for index in self.kinematics.steered.joints)

    @property
    def casters(self) -> tuple[Pivot, ...]:
        """Pivots of the wheels that turn by contact."""
        return tuple(wheel.pivot for wheel in self.wheels if wheel.pivot and wheel.pivot.servo is None)

    @property
    def flippers(self) -> tuple[Arm, ...]:
        """Arms with a servo, in the order of the file and of the actuators after the steering's."""
        return tuple(arm for arm in self.arms if arm.servo is not None)

    @property
    def servos(self) -> tuple[Servo, ...]:
        """Servos of steering and flippers, in the order of the actuators after the drives'."""
        parts: list[Pivot | Arm] = [*self.steering, *self.flippers]
        return tuple(part.servo for part in parts if part.servo is not None)

    @property
    def lidar_frame(self) -> str:
        """Frame of the lidar: the one of that name, or else the first that has the name of one."""
        named = [frame for frame in self.sensors if is_lidar(frame)]
        return named[0] if named and LIDAR_FRAME not in self.sensors else LIDAR_FRAME

    def sensor(self, frame: str, option: str) -> np.ndarray:
        """Pose ``[4, 4]`` of a sensor; raises a ``RobotFileError`` that names the option to run without it."""
        if frame not in self.sensors:
            raise RobotFileError(
                f"robot {self.name}: sensors: got {sorted(self.sensors)}, expected one named {frame!r}; "
                f"add it to the robot's file or use `{option}`"
            )
        return self.sensors[frame]

    @property
    def differentials(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the wheels behind each differential."""
        names = sorted({wheel.differential for wheel in self.wheels} - {""})
        return tuple(tuple(i for i, wheel in enumerate(self.wheels) if wheel.differential == name) for name in names)

    def wheel_speeds(self, forward: float, yaw_rate: float, lateral: float = 0.0) -> np.ndarray:
        """Wheel speeds ``[wheels]`` [rad/s] of a command; see :meth:`command`."""
        return self.command(forward, yaw_rate, lateral)[0]

    def command(self, forward: float, yaw_rate: float, lateral: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Wheel speeds ``[wheels]`` [rad/s] and steering angles [rad] that the base controller commands.

        Args:
            forward: speed [m/s].
            yaw_rate: [rad/s].
            lateral: speed to the left of a robot that crabs [m/s].
        """
        if self.kinematics is None:
            forward = np.clip(forward, -self.maximum_speed, self.maximum_speed)
            yaw_rate = np.clip(yaw_rate, -self.maximum_yaw_rate, self.maximum_yaw_rate)
            speeds = [(forward - yaw_rate * wheel.side) / wheel.radius for wheel in self.wheels]
            return np.array(speeds), np.zeros(0)
        twist = [forward, yaw_rate, *([lateral] if self.crabs else [])]
        drives, angles = self.kinematics.command(torch.tensor(twist, dtype=torch.float64))
        by_name = dict(zip(self.kinematics.drive_names, drives.tolist(), strict=True))
        return np.array([by_name.get(wheel.name, 0.0) / wheel.radius for wheel in self.wheels]), angles.numpy()

    def add_to(self, spec: mujoco.MjSpec, height: float) -> None:
        """Add the robot to a world: at the origin, heading along x, its base frame at ``height`` [m]."""
        base = spec.worldbody.add_body(name=BODY, pos=[0.0, 0.0, height])
        base.add_freejoint()
        wheel_mass = _WHEELS_MASS_FRACTION * self.mass / len(self.wheels)
        self._set_inertia(base, wheel_mass)
        for centre, size in self.hull:
            base.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=size / 2, rgba=[*self.colour, 1], **collides()
            )
        carriers: dict[str, tuple[mujoco.MjsBody, np.ndarray]] = {"": (base, np.zeros(3))}
        for arm in self.arms:
            carried = [wheel for wheel in self.wheels if wheel.arm == arm.name]
            carriers[arm.name] = arm.add_to(base, self.mass, carried, wheel_mass), arm.place
        for wheel in self.wheels:
            wheel.add_to(spec, *carriers[wheel.arm], self.mass, len(self.wheels), wheel_mass)
        for turned in self.differentials:
            tendon = spec.add_tendon(name=self.wheels[turned[0]].differential)
            for index in turned:
                tendon.wrap_joint(self.wheels[index].joint, 1.0 / len(turned))
        for pivot in self.steering:
            add_joint_servo(spec, pivot, self.mass)
        for arm in self.flippers:
            add_joint_servo(spec, arm, self.mass)
        imu = self.sensors.get("imu_link", np.eye(4))
        base.add_site(
            name=IMU_SITE, pos=imu[:3, 3], quat=quaternion_wxyz(Rotation.from_matrix(imu[:3, :3])), group=GROUP
        )
        spec.add_sensor(
            name="accelerometer",
            type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=IMU_SITE,
        )
        spec.add_sensor(
            name="gyro", type=mujoco.mjtSensor.mjSENS_GYRO, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=IMU_SITE
        )

    def _set_inertia(self, base: mujoco.MjsBody, wheel_mass: float) -> None:
        """Set the chassis inertia so that all parts add up to the robot's mass, centre of mass and inertia."""
        massive = [arm for arm in self.arms if arm.mass]
        names = {arm.name for arm in massive}
        wheels = [wheel for wheel in self.wheels if wheel.arm not in names]
        chassis_mass = self.mass - wheel_mass * len(wheels) - sum(arm.mass for arm in massive)
        centres = np.array([wheel.centre for wheel in wheels]).reshape(-1, 3)
        moment = self.mass * self.centre_of_mass - wheel_mass * centres.sum(axis=0)
        for arm in massive:
            moment = moment - arm.mass * arm.centre
        centre = moment / chassis_mass
        inertia = self.inertia - point_inertia(chassis_mass, centre - self.centre_of_mass)
        for wheel in wheels:
            inertia -= point_inertia(wheel_mass, wheel.centre - self.centre_of_mass)
            inertia -= np.diag(wheel_moments(wheel, wheel_mass))
        for arm in massive:
            inertia -= point_inertia(arm.mass, arm.centre - self.centre_of_mass)
        set_inertia(base, chassis_mass, inertia, centre)


def _rigid(pose: np.ndarray) -> np.ndarray:
    """The pose with its single-precision rotation made orthonormal."""
    pose = pose.copy()
    pose[:3, :3] = Rotation.from_matrix(pose[:3, :3]).as_matrix()
    return pose
