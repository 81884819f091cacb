"""CandidateInput: the newest candidates of the predictor, and whether a robot may be driven by them."""

from __future__ import annotations

import time

import numpy as np
from sensor_msgs.msg import PointCloud2

from monoforce_ros.core import NANOSECOND, MotionState
from monoforce_ros.messages import decoding
from monoforce_ros.nodes.health import ERROR, OK, Health
from monoforce_ros.nodes.stop import Stop

PART = "candidates"
_LATEST_START = 2.0
"""Largest `candidate_delay` of the predictor [s]; what claims to start later is late all the same."""


class CandidateInput:
    """Receives candidates.

    Args:
        health: gets the part ``candidates``.
        timeout: age up to which they are driven [s].
    """

    def __init__(self, health: Health, timeout: float):
        self._health, self._timeout = health, timeout
        self.arrival: float | None = None
        """Steady time of the newest ones [s]."""
        self._stamp = 0
        self._frame_id = ""
        self._fields: dict[str, np.ndarray] | None = None

    def receive(self, message: PointCloud2) -> None:
        """Take a message; one that cannot be used changes nothing."""
        try:
            fields = decoding.decode_fields(message)
        except decoding.MessageError as error:
            self._health.report(PART, ERROR, str(error), reason="unusable")
            return
        self.arrival = time.monotonic()
        self._stamp, self._frame_id, self._fields = decoding.stamp_of(message), message.header.frame_id, fields
        self._health.report(PART, OK, "receiving candidates")

    def usable(self, motion: MotionState, odometry_frame: str, cause: str) -> dict[str, np.ndarray]:
        """Fields of the newest candidates.

        Args:
            motion: newest motion of the base.
            odometry_frame: frame of the odometry.
            cause: of their absence, in words.

        Raises:
            Stop: they are missing, old, or in another frame than the odometry.
        """
        if self._fields is None:
            raise Stop(f"no candidates received: is the predictor running with `candidates`? ({cause})", "none")
        if self._frame_id.lstrip("/") != odometry_frame.lstrip("/"):
            frames = f"candidates are in frame {self._frame_id!r}, odometry in {odometry_frame!r}"
            raise Stop(f"{frames}: give predictor and path_selector the same `odometry_topic`", "candidate frame")
        age = (motion.stamp - self._stamp) * NANOSECOND
        # A slow predictor's candidates hold the last command for longer before they start.
        limit = max(self._timeout, self._start + 0.5 * self._timeout)
        if age > limit or age < -self._timeout:
            raise Stop(f"candidates are {age:.2f} s old, the limit is {limit:g} s", "late")
        return self._fields

    @property
    def _start(self) -> float:
        """Time after the stamp at which the candidates take effect [s]; 0 if they do not tell it."""
        start = (self._fields or {}).get("start", np.zeros(0))
        return float(np.clip(np.nan_to_num(start[0]), 0.0, _LATEST_START)) if len(start) else 0.0
