"""OdometryReader: what an odometry message says of the robot's base, or why it cannot be used."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import Odometry

from monoforce_ros.core import FrameError, MotionState, RobotFrames
from monoforce_ros.messages import decoding
from monoforce_ros.nodes.alternating_poses import AlternatingPoses
from monoforce_ros.nodes.frames import TRANSFORMS_PATIENCE, TransformListener
from monoforce_ros.nodes.health import ERROR, Health

PART = "odometry"
"""Part of the node's health."""
_LYING = 0.5
"""Vertical component of the base's z axis below which a robot lies rather than stands: a slope of 60°, beyond which
ground counts as a wall, and steeper than wheels or tracks hold."""
ZERO_STAMPS = "the stamps are zero: the {} does not set them"


@dataclass(frozen=True)
class BaseOdometry:
    """One odometry message."""

    motion: MotionState
    """Of the base."""
    frame_id: str
    """Frame of the poses; empty if the message names none."""
    child_frame_id: str
    """Frame that the message describes."""
    base_from_child: np.ndarray
    """Pose ``[4, 4]`` of that frame in the base frame."""


class OdometryReader:
    """Reads odometry messages, and reports those that cannot be used.

    Args:
        frames: of the robot.
        transforms: of ``/tf``.
        health: gets the part ``odometry``.
        publishers: tells the names of the nodes that publish on the topic, one for each publisher.
    """

    def __init__(
        self,
        frames: RobotFrames,
        transforms: TransformListener,
        health: Health,
        publishers: Callable[[], Sequence[str]],
    ):
        self._frames, self._transforms, self.health, self._publishers = frames, transforms, health, publishers
        self._alternating = AlternatingPoses()
        self.first_arrival = 0.0
        """Steady time of the first message with a stamp [s]; 0 before."""
        self.problem = ""
        """Why the newest message cannot be used; empty if it can."""
        self.frame = ""
        """Frame of the newest message with a stamp, that of REP 105 if it names none."""
        self.alternates = False
        """Whether the poses come from two estimators that do not agree."""

    def base_name(self, child_frame_id: str) -> str:
        """Name of the base's frame beside that which the odometry describes."""
        return self._frames.base_name(child_frame_id, self._transforms.tree.frames)

    def read(self, message: Odometry) -> BaseOdometry | None:
        """What a message says; None if it cannot be used."""
        try:
            state, frame_id, child = decoding.decode_odometry(message)
        except decoding.MessageError as error:
            self._refuse(str(error), "unusable")
            return None
        if not state.stamp:
            self._refuse(ZERO_STAMPS.format("state estimator"), "zero stamp")
            return None
        self.first_arrival = self.first_arrival or time.monotonic()
        if (frame_id or "odom") != self.frame:
            self._alternating.clear()
        self.frame = frame_id or "odom"
        try:
            offset = self._frames.odometry_child(child, self._transforms.tree)
        except FrameError as error:
            # Transforms may be on their way.
            patient = not self._transforms.unavailable and time.monotonic() - self.first_arrival <= TRANSFORMS_PATIENCE
            self._refuse(self._transforms.explained(error), "frame", silent=patient)
            return None
        motion = state.of_base(offset)
        upright = float(motion.rotation[2, 2])
        if upright < _LYING:
            self._refuse(
                "by its odometry the robot lies on its side or upside down, "
                f"{np.degrees(np.arccos(upright)):.0f}° from upright in {self.frame!r}: expected the pose of "
                f"{child or 'the base'}, x forward and z up, in a frame whose z axis points up (REP 103, REP 105); "
                "poses in NED or of an optical frame have to be converted",
                "lies",
            )
            return None
        apart, names = self._alternating.add(motion), self._publishers()
        # The poses of one estimator may be rough, but they are its own.
        self.alternates = apart > 0.0 and len(names) > 1
        if self.alternates:
            self._refuse(
                f"its poses alternate between two tracks that are {apart:.2f} m or rad apart: expected one estimator "
                f"on the topic, which is published by {', '.join(dict.fromkeys(names))}; remap or stop the other one",
                "two tracks",
            )
            return None
        self.problem = ""
        return BaseOdometry(motion, frame_id, child, offset)

    def _refuse(self, problem: str, reason: str, *, silent: bool = False) -> None:
        self.problem = problem
        if not silent:
            self.health.report(PART, ERROR, problem, reason=reason)
