"""Vehicle: a robot file as a MuJoCo body with driven wheels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, robot_file
from monoforce_ros.synthetic.graphics import mujoco

BODY = "base"
IMU_SITE = "imu"
GROUP = 5
"""Geometry group of the robot, which lidar rays ignore."""

# Tyres and servos of a robot of this mass with four wheels, tuned to turn like the real one without hopping. They scale
# with the robot's mass and are divided among its wheels.
_REFERENCE_MASS = 50.0
_TYRE_STIFFNESS = 60_000.0
_TYRE_DAMPING = 2_800.0
_SERVO_GAIN = 1_200.0
# Inertia of motors and gears reflected to the wheels [kg m²]; without it a robot at rest vibrates.
_GEAR_INERTIA = 0.4
_WHEELS_MASS_FRACTION = 0.12
# Spacing of the small wheels that model a track, in wheel radii; close enough to climb like a belt.
_TRACK_WHEEL_DISTANCE = 1.1
# Three wheels of a flipper touch each other; five take twice as long to simulate.
_FLIPPER_WHEELS = 3
_GRAVITY = 9.81


@dataclass(frozen=True)
class Wheel:
    """A driven wheel; lengths in metres, in the base frame.

    Attributes:
        side: lateral offset that maps a twist to this wheel's speed [m].
        centre: ``[3]``.
    """

    name: str
    side: float
    centre: np.ndarray
    radius: float
    width: float

    @property
    def joint(self) -> str:
        """Name of its joint in the model and in joint states."""
        return f"{self.name}_wheel"

    @property
    def surface(self) -> str:
        """Name of its contact geometry."""
        return f"{self.name}_surface"


@dataclass(frozen=True)
class Vehicle:
    """Contents of a robot file as numpy arrays in the base frame.

    Attributes:
        inertia: ``[3, 3]`` about the centre of mass [kg m²].
        hull: centre ``[3]`` and edge lengths ``[3]`` of each box [m].
        sensors: ``[4, 4]`` pose of each sensor frame, base ← sensor.
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
    colour: tuple[float, float, float] = (0.92, 0.72, 0.10)

    @classmethod
    def load(cls, name_or_file: str | Path) -> Vehicle:
        """Read a robot by name or file; each track becomes a row of small wheels that turn together.

        Flippers stand still at the angles of the file, with a row of wheels each.

        Raises:
            RobotFileError: the file is invalid.
        """
        robot: RobotModel = load_robot(name_or_file)
        if robot.steered is not None or robot.point_grip is not None:
            raise RobotFileError(
                f"robot {robot.name}: drive.kind: the simulator drives robots of the kind 'skid' without free wheels; "
                "benchmarks/mujoco_drives.py has a model with steering and casters"
            )
        content = yaml.safe_load(robot_file(name_or_file).read_text(encoding="utf-8"))
        offsets = dict(zip(robot.drive_names, robot.drive_offsets.tolist(), strict=True))
        wheels = [_wheel(wheel, offsets) for wheel in content.get("wheels", [])]
        for track in content.get("tracks", []):
            wheels += _track_wheels(track, offsets)
        for flipper in content.get("flippers", []):
            wheels += _flipper_wheels(flipper, offsets)
        hull = tuple((np.array(box["centre"], float), np.array(box["size"], float)) for box in content.get("hull", []))
        return cls(
            name=robot.name,
            base_frame=robot.base_frame,
            mass=float(robot.mass),
            centre_of_mass=robot.centre_of_mass.double().numpy(),
            inertia=robot.inertia.double().numpy(),
            wheels=tuple(wheels),
            hull=hull,
            sensors={frame: _rigid(pose.double().numpy()) for frame, pose in robot.sensors.items()},
            maximum_speed=robot.maximum_speed,
            maximum_yaw_rate=robot.maximum_yaw_rate,
        )

    @property
    def clearance(self) -> float:
        """Height of the base frame above level ground [m]."""
        return max(wheel.radius - float(wheel.centre[2]) for wheel in self.wheels)

    def sensor(self, frame: str, option: str) -> np.ndarray:
        """Pose ``[4, 4]`` of a sensor; raises a ``RobotFileError`` that names the option to run without it."""
        if frame not in self.sensors:
            raise RobotFileError(
                f"robot {self.name}: sensors: got {sorted(self.sensors)}, expected one named {frame!r}; "
                f"add it to the robot's file or use `{option}`"
            )
        return self.sensors[frame]

    def wheel_speeds(self, forward: float, yaw_rate: float) -> np.ndarray:
        """Wheel speeds ``[wheels]`` [rad/s] of a commanded forward speed [m/s] and yaw rate [rad/s]."""
        forward = np.clip(forward, -self.maximum_speed, self.maximum_speed)
        yaw_rate = np.clip(yaw_rate, -self.maximum_yaw_rate, self.maximum_yaw_rate)
        return np.array([(forward - yaw_rate * wheel.side) / wheel.radius for wheel in self.wheels])

    def add_to(self, spec: mujoco.MjSpec, height: float) -> None:
        """Add the robot to a world: at the origin, heading along x, its base frame at ``height`` [m]."""
        base = spec.worldbody.add_body(name=BODY, pos=[0.0, 0.0, height])
        base.add_freejoint()
        wheel_mass = _WHEELS_MASS_FRACTION * self.mass / len(self.wheels)
        self._set_inertia(base, wheel_mass)
        for centre, size in self.hull:
            base.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=size / 2, rgba=[*self.colour, 1], **_collides()
            )
        for wheel in self.wheels:
            self._add_wheel(spec, base, wheel, wheel_mass)
        imu = self.sensors.get("imu_link", np.eye(4))
        base.add_site(
            name=IMU_SITE, pos=imu[:3, 3], quat=_quaternion_wxyz(Rotation.from_matrix(imu[:3, :3])), group=GROUP
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
        """Set the chassis inertia so that chassis and wheels add up to the robot's mass, centre of mass and inertia."""
        chassis_mass = self.mass - wheel_mass * len(self.wheels)
        centres = np.array([wheel.centre for wheel in self.wheels])
        centre = (self.mass * self.centre_of_mass - wheel_mass * centres.sum(axis=0)) / chassis_mass
        inertia = self.inertia - _point_inertia(chassis_mass, centre - self.centre_of_mass)
        for wheel in self.wheels:
            inertia -= _point_inertia(wheel_mass, wheel.centre - self.centre_of_mass)
            inertia -= np.diag(_wheel_moments(wheel, wheel_mass))
        base.explicitinertial = True
        base.mass = chassis_mass
        base.ipos = centre
        base.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def _add_wheel(self, spec: mujoco.MjSpec, base: mujoco.MjsBody, wheel: Wheel, mass: float) -> None:
        body = base.add_body(name=wheel.joint, pos=wheel.centre)
        body.explicitinertial = True
        body.mass = mass
        body.inertia = _wheel_moments(wheel, mass)
        tyre = body.add_joint(name=f"{wheel.name}_tyre", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        share = self.mass / _REFERENCE_MASS / len(self.wheels)
        stiffness = share * _TYRE_STIFFNESS
        tyre.stiffness = [stiffness, 0.0, 0.0]
        tyre.damping = [share * _TYRE_DAMPING, 0.0, 0.0]
        # Preload: at rest on level ground the base frame keeps its height.
        tyre.springref = -self.mass * _GRAVITY / len(self.wheels) / stiffness
        axle = body.add_joint(name=wheel.joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        axle.armature = share * _GEAR_INERTIA
        lying = _quaternion_wxyz(Rotation.from_euler("x", 90, degrees=True))
        size = [wheel.radius, wheel.width / 2, 0.0]
        # The tyre's friction takes priority over the ground's, so that it can vary with position.
        body.add_geom(
            name=wheel.surface, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, quat=lying,
            rgba=[0.08, 0.08, 0.09, 1], priority=1, **_collides(),
        )  # fmt: skip
        hub = [0.5 * wheel.radius, wheel.width / 2 + 0.005, 0.0]
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=hub, quat=lying, rgba=[0.45, 0.45, 0.47, 1], group=GROUP,
            contype=0, conaffinity=0,
        )  # fmt: skip
        servo = spec.add_actuator(name=wheel.joint, target=wheel.joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_velocity(kv=share * _SERVO_GAIN)


def _wheel(entry: Mapping, offsets: Mapping[str, float]) -> Wheel:
    drive = offsets[str(entry["drive"])]
    return Wheel(
        str(entry["name"]), drive, np.array(entry["centre"], float), float(entry["radius"]), float(entry["width"])
    )


def _track_wheels(track: Mapping, offsets: Mapping[str, float]) -> list[Wheel]:
    """Wheels along the bottom of a track; the first and last are its rollers."""
    centre, radius, length = np.array(track["centre"], float), float(track["radius"]), float(track["length"])
    count = max(2, 1 + round(length / (_TRACK_WHEEL_DISTANCE * radius)))
    offsets_x = np.linspace(length / 2, -length / 2, count)
    return [
        Wheel(
            f"{track['name']}_{index}", offsets[str(track["drive"])], centre + np.array([offset, 0.0, 0.0]), radius,
            float(track["width"]),
        )
        for index, offset in enumerate(offsets_x)
    ]  # fmt: skip


def _flipper_wheels(flipper: Mapping, offsets: Mapping[str, float]) -> list[Wheel]:
    """Wheels along a flipper at its angle, from the root to the smaller tip."""
    joint, length, angle = np.array(flipper["joint"], float), float(flipper["length"]), float(flipper.get("angle", 0.0))
    root, tip = float(flipper["root_radius"]), float(flipper["tip_radius"])
    forward = 1.0 if flipper["end"] == "front" else -1.0
    direction = np.array([forward * np.cos(angle), 0.0, np.sin(angle)])
    return [
        Wheel(
            f"{flipper['name']}_{index}", offsets[str(flipper["drive"])], joint + share * length * direction,
            root + share * (tip - root), float(flipper["width"]),
        )
        for index, share in enumerate(np.linspace(0.0, 1.0, _FLIPPER_WHEELS))
    ]  # fmt: skip


def _collides() -> dict[str, object]:
    """Collisions with the world but not with the robot itself: wheels overlap the chassis."""
    return {"contype": 2, "conaffinity": 1, "group": GROUP, "friction": [1.0, 0.005, 0.0001], "solref": [0.02, 1.0]}


def _wheel_moments(wheel: Wheel, mass: float) -> np.ndarray:
    across = mass * (3 * wheel.radius**2 + wheel.width**2) / 12
    return np.array([across, mass * wheel.radius**2 / 2, across])


def _point_inertia(mass: float, offset: np.ndarray) -> np.ndarray:
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def _rigid(pose: np.ndarray) -> np.ndarray:
    """The pose with its single-precision rotation made orthonormal."""
    pose = pose.copy()
    pose[:3, :3] = Rotation.from_matrix(pose[:3, :3]).as_matrix()
    return pose


def _quaternion_wxyz(rotation: Rotation) -> np.ndarray:
    # SciPy puts the scalar last; its option scalar_first is newer than Ubuntu 24.04's SciPy 1.11.
    return np.roll(rotation.as_quat(), 1)
