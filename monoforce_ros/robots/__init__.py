"""Robot models: body points, drives, mass properties and sensors, read from and written to YAML files, or from URDF."""

from monoforce_ros.robots.checks import RobotFileError
from monoforce_ros.robots.controls import Controls
from monoforce_ros.robots.digest import robot_digest
from monoforce_ros.robots.joint import Coordinate, Joint
from monoforce_ros.robots.kinematics import SteeredDrive
from monoforce_ros.robots.loader import load_robot, robot_file, shipped_robots
from monoforce_ros.robots.mass import add_point_mass
from monoforce_ros.robots.robot_copy import fingerprint, read_commissioning, read_nominal_residual, write_robot
from monoforce_ros.robots.robot_model import Flipper, RobotModel
from monoforce_ros.robots.sensor_names import is_lidar
from monoforce_ros.robots.servo import servo_response
from monoforce_ros.robots.urdf import (
    Conversion,
    ConversionOptions,
    Description,
    UrdfError,
    convert_description,
    read_description,
)

__all__ = [
    "Controls",
    "Conversion",
    "ConversionOptions",
    "Coordinate",
    "Description",
    "Flipper",
    "Joint",
    "RobotFileError",
    "RobotModel",
    "SteeredDrive",
    "UrdfError",
    "add_point_mass",
    "convert_description",
    "fingerprint",
    "is_lidar",
    "load_robot",
    "read_commissioning",
    "read_description",
    "read_nominal_residual",
    "robot_digest",
    "robot_file",
    "servo_response",
    "shipped_robots",
    "write_robot",
]
