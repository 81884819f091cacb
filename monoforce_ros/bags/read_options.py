"""Read options: which topics of a bag are used, and where its odometry is on the robot, if the bag does not say."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from monoforce_ros.bags.recording import Recording
from monoforce_ros.core import pose_matrix

if TYPE_CHECKING:  # robots load torch, for which bag_player and bag_recorder need not wait
    from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class ReadOptions:
    """What replaces detection by type and the bag's own transforms; None and empty values leave it to them."""

    odometry: str | None = None
    """Topic."""
    commands: str | None = None
    """Topic."""
    cloud: str | None = None
    """Topic."""
    joints: str | None = None
    """Topic of measured joint states."""
    flipper_commands: str | None = None
    """Topic of joint states."""
    base_frame: str = ""
    """Name of the robot's base frame in the bag, if it is not the one of the robot file."""
    odometry_child_pose: tuple[float, ...] | None = None
    """Pose of the odometry's child frame in the base frame: x, y, z [m], roll, pitch, yaw [rad]."""

    def robot_in_bag(self, robot: RobotModel) -> RobotModel:
        """The robot with the name that its base frame has in the bag."""
        return replace(robot, base_frame=self.base_frame) if self.base_frame else robot

    def open(self, path: str | Path, robot: RobotModel) -> Recording:
        """The recording of the robot's base.

        Raises:
            BagError: the bag or a topic cannot be used, or it is unknown where its odometry is on the robot.
        """
        return self.at_base(self.open_as_measured(path, robot), robot)

    def open_as_measured(self, path: str | Path, robot: RobotModel) -> Recording:
        """The recording with the motion of the odometry's child frame, and the commands and joints of a robot.

        Raises:
            BagError: the bag or a topic cannot be used.
        """
        return Recording.open(
            path, odometry=self.odometry, commands=self.commands, cloud=self.cloud, joints=self.joints,
            flipper_commands=self.flipper_commands, robot=robot,
        )  # fmt: skip

    def at_base(self, recording: Recording, robot: RobotModel) -> Recording:
        """A recording that was opened as measured, with the motion of the robot's base.

        Raises:
            BagError: it is unknown where the odometry's child frame is on the robot.
        """
        pose = None if self.odometry_child_pose is None else pose_matrix(self.odometry_child_pose)
        return recording.in_base_frame(self.base_frame or robot.base_frame, pose, file_frame=robot.base_frame)


DETECTED = ReadOptions()
"""Everything as the bag says."""


def add_read_options(parser: argparse.ArgumentParser) -> None:
    """The options of a command line that :func:`read_options` reads."""
    roles = (
        ("odometry", "odometry"), ("commands", "command"), ("cloud", "point cloud"), ("joints", "joint state"),
        ("flipper-commands", "flipper command (joint states)"),
    )  # fmt: skip
    for role, what in roles:
        parser.add_argument(f"--{role}", metavar="TOPIC", help=f"{what} topic (default: detected by type)")
    parser.add_argument(
        "--base-frame",
        default="",
        metavar="FRAME",
        help="the robot's base frame in the bag (default: the robot file's)",
    )
    parser.add_argument(
        "--odometry-child-pose",
        nargs=6,
        type=float,
        metavar=("X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="pose of the odometry's child frame in the base frame [m, rad] (default: from the bag's transforms)",
    )


def read_options(options: argparse.Namespace) -> ReadOptions:
    """The read options of a parsed command line."""
    pose = options.odometry_child_pose
    return ReadOptions(
        odometry=options.odometry,
        commands=options.commands,
        cloud=options.cloud,
        joints=options.joints,
        flipper_commands=options.flipper_commands,
        base_frame=options.base_frame,
        odometry_child_pose=None if pose is None else tuple(pose),
    )
