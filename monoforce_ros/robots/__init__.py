"""Robot models: body points, drives, mass properties and sensors, read from and written to YAML files."""

from monoforce_ros.robots.loader import RobotFileError, load_robot, robot_file, shipped_robots
from monoforce_ros.robots.mass import add_point_mass
from monoforce_ros.robots.robot_copy import fingerprint, read_commissioning, read_nominal_residual, write_robot
from monoforce_ros.robots.robot_model import Flipper, RobotModel

__all__ = [
    "Flipper",
    "RobotFileError",
    "RobotModel",
    "add_point_mass",
    "fingerprint",
    "load_robot",
    "read_commissioning",
    "read_nominal_residual",
    "robot_file",
    "shipped_robots",
    "write_robot",
]
