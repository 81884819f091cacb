"""Robot models: body points, drives, mass properties and sensors, read from and written to YAML files, or from URDF."""

from monoforce_ros.robots.loader import RobotFileError, load_robot, robot_file, shipped_robots
from monoforce_ros.robots.mass import add_point_mass
from monoforce_ros.robots.robot_copy import fingerprint, read_commissioning, read_nominal_residual, write_robot
from monoforce_ros.robots.robot_model import Flipper, RobotModel
from monoforce_ros.robots.urdf import (
    Conversion,
    ConversionOptions,
    Description,
    UrdfError,
    convert_description,
    read_description,
)

__all__ = [
    "Conversion",
    "ConversionOptions",
    "Description",
    "Flipper",
    "RobotFileError",
    "RobotModel",
    "UrdfError",
    "add_point_mass",
    "convert_description",
    "fingerprint",
    "load_robot",
    "read_commissioning",
    "read_description",
    "read_nominal_residual",
    "robot_file",
    "shipped_robots",
    "write_robot",
]
