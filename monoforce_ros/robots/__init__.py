"""Robot models from YAML: body points, drives, sensors."""

from monoforce_ros.robots.loader import RobotFileError, load_robot, robot_file, shipped_robots
from monoforce_ros.robots.robot_model import Flipper, RobotModel

__all__ = ["Flipper", "RobotFileError", "RobotModel", "load_robot", "robot_file", "shipped_robots"]
