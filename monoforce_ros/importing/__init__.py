"""Importing robots: a robot file from a URDF, drawn, and checked in the physics."""

from monoforce_ros.importing.check import Finding, check_robot
from monoforce_ros.importing.picture import draw_robot

__all__ = ["Finding", "check_robot", "draw_robot"]
