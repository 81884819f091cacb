"""OdometryInput: the newest motion of the base, and whether a robot may be driven by it."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from nav_msgs.msg import Odometry

from monoforce_ros.core import FrameError, MotionState, RobotFrames
from monoforce_ros.messages import decoding
from monoforce_ros.nodes.frames import TRANSFORMS_PATIENCE, TransformListener
from monoforce_ros.nodes.health import ERROR, OK, Health
from monoforce_ros.nodes.stop import Stop

PART = "odometry"
_COARSEST = 0.05
"""Largest rounding of the candidates' positions [m]: half of the distance that counts as progress."""


class OdometryInput:
    """Receives odometry.

    Args:
        frames: of the robot.
        transforms: of ``/tf``.
        health: gets the part ``odometry``.
        timeout: time without odometry after which the robot stops [s].
    """

    def __init__(self, frames: RobotFrames, transforms: TransformListener, health: Health, timeout: float):
        self._frames, self._transforms, self._health, self._timeout = frames, transforms, health, timeout
        self.motion: MotionState | None = None
        """Of the base."""
        self.frame = ""
        """Frame of the odometry."""
        self.base_name = ""
        """Name of the base's frame."""
        self.on_robot: Mapping[str, np.ndarray] = {}
        """Poses of the base and of the frame that the odometry describes, in the base's frame ``[4, 4]``."""
        self.arrival: float | None = None
        """Steady time of the newest message [s]."""
        self.first_arrival = 0.0
        """Steady time of the first message with a stamp [s]; 0 before."""
        self._problem = ""
        self._stamp: int | None = None
        self._advanced = 0.0

    def receive(self, message: Odometry) -> bool:
        """Take a message; returns whether it tells the motion of the base."""
        self.arrival = time.monotonic()
        try:
            state, frame_id, child = decoding.decode_odometry(message)
            if not state.stamp:
                raise decoding.MessageError("the stamps are zero: the state estimator does not set them")
        except decoding.MessageError as error:
            self._problem = str(error)
            self._health.report(PART, ERROR, self._problem, reason="unusable")
            return False
        if state.stamp != self._stamp:
            self._stamp, self._advanced = state.stamp, self.arrival
        self.first_arrival = self.first_arrival or self.arrival
        # The name of REP 105, as the predictor takes it.
        self.frame = frame_id or "odom"
        try:
            offset = self._frames.odometry_child(child, self._transforms.tree)
        except FrameError as error:
            self._problem = self._transforms.explained(error)
            # Transforms may be on their way.
            if self._transforms.unavailable or time.monotonic() - self.first_arrival > TRANSFORMS_PATIENCE:
                self._health.report(PART, ERROR, self._problem, reason="frame")
            return False
        self._problem = ""
        self.motion = state.of_base(offset)
        self.base_name = self._frames.base_name(child, self._transforms.tree.frames)
        self.on_robot = {child or self.base_name: offset, self.base_name: np.eye(4)}
        self._health.report(PART, OK, "receiving odometry")
        return True

    def usable(self, cause: str) -> MotionState:
        """The newest motion of the base.

        Args:
            cause: of the odometry's absence, in words.

        Raises:
            Stop: it is missing, old, of an unknown frame, or too far from the origin.
        """
        if self._problem:
            raise Stop(self._problem, "odometry")
        if self.motion is None or self.arrival is None:
            raise Stop(f"no odometry: the position is unknown ({cause})", "no odometry")
        # Stamps cannot detect this: without odometry there are no new candidates either, so their age stays constant.
        silence = time.monotonic() - self.arrival
        if silence > self._timeout:
            raise Stop(f"no odometry for {silence:.1f} s: the position is unknown ({cause})", "silent")
        # With such odometry candidates cannot grow old either.
        frozen = time.monotonic() - self._advanced
        if frozen > self._timeout:
            raise Stop(f"odometry has repeated the same stamp for {frozen:.1f} s: the position is unknown", "frozen")
        if self.motion.rounding > _COARSEST:
            far = f"{np.abs(self.motion.position).max() / 1e3:.0f} km from the origin of {self.frame!r}"
            raise Stop(
                f"odometry is {far}, where the 32-bit positions of candidates are {100 * self.motion.rounding:.0f} cm "
                "apart: use an odometry frame that begins near the robot (REP 105)",
                "far",
            )
        return self.motion
