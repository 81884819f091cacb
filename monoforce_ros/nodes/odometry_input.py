"""OdometryInput: the newest motion of the base, and whether a robot may be driven by it."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from nav_msgs.msg import Odometry

from monoforce_ros.core import MotionState
from monoforce_ros.nodes.health import OK
from monoforce_ros.nodes.odometry_reader import PART, OdometryReader
from monoforce_ros.nodes.stop import Stop

_COARSEST = 0.05
"""Largest rounding of the candidates' positions [m]: half of the distance that counts as progress."""


class OdometryInput:
    """Receives odometry.

    Args:
        reader: of its messages.
        timeout: time without odometry after which the robot stops [s].
    """

    def __init__(self, reader: OdometryReader, timeout: float):
        self._reader, self._timeout = reader, timeout
        self.motion: MotionState | None = None
        """Of the base."""
        self.base_name = ""
        """Name of the base's frame."""
        self.on_robot: Mapping[str, np.ndarray] = {}
        """Poses of the base and of the frame that the odometry describes, in the base's frame ``[4, 4]``."""
        self.arrival: float | None = None
        """Steady time of the newest message [s]."""
        self._stamp: int | None = None
        self._advanced = 0.0

    @property
    def first_arrival(self) -> float:
        """Steady time of the first message with a stamp [s]; 0 before."""
        return self._reader.first_arrival

    @property
    def frame(self) -> str:
        """Frame of the odometry; empty before the first message."""
        return self._reader.frame

    def receive(self, message: Odometry) -> bool:
        """Take a message; returns whether it tells the motion of the base."""
        self.arrival = time.monotonic()
        received = self._reader.read(message)
        if received is None:
            return False
        if received.motion.stamp != self._stamp:
            self._stamp, self._advanced = received.motion.stamp, self.arrival
        self.motion = received.motion
        self.base_name = self._reader.base_name(received.child_frame_id)
        self.on_robot = {
            received.child_frame_id or self.base_name: received.base_from_child, self.base_name: np.eye(4)
        }  # fmt: skip
        self._reader.health.report(PART, OK, "receiving odometry")
        return True

    def usable(self, cause: str) -> MotionState:
        """The newest motion of the base.

        Args:
            cause: of the odometry's absence, in words.

        Raises:
            Stop: it is missing, old, of an unknown frame, or too far from the origin.
        """
        if self._reader.problem:
            raise Stop(self._reader.problem, "odometry")
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
