"""JointInput: newest measured and commanded joint angles of the robot, thread-safe."""

from __future__ import annotations

import threading

import numpy as np
from sensor_msgs.msg import JointState

from monoforce_ros.messages import decoding
from monoforce_ros.prediction import JointMotion
from monoforce_ros.robots import RobotModel


class JointInput:
    """Measured joints and commands for flippers, as a :class:`JointMotion` for each prediction.

    Args:
        robot: names the joints.
        continues: whether flippers without a command go on at their measured rates instead of holding their angles.
        timeout: age beyond which measurements and commands are not used [s].
    """

    def __init__(self, robot: RobotModel, *, continues: bool, timeout: float):
        self._robot, self._continues, self._timeout = robot, continues, timeout
        self._lock = threading.Lock()
        self._measured: tuple[int, np.ndarray, np.ndarray] | None = None
        self._commanded: tuple[int, np.ndarray, np.ndarray] | None = None

    def clear(self) -> None:
        """Forget everything, after a backward time jump."""
        with self._lock:
            self._measured = self._commanded = None

    def measure(self, message: JointState) -> None:
        """Keep measured angles. Drivers may publish joints in several messages: each joint keeps its newest.

        Raises ``MessageError`` if the message is unusable; earlier measurements are then forgotten.
        """
        try:
            stamp = self._stamp(message)
            angles, rates = decoding.decode_joints(message, self._robot.joint_names)
        except decoding.MessageError:
            with self._lock:
                self._measured = None
            raise
        with self._lock:
            if self._measured is not None and 0 <= stamp - self._measured[0] <= self._limit:
                angles = np.where(np.isfinite(angles), angles, self._measured[1])
                rates = np.where(np.isfinite(rates), rates, self._measured[2])
            self._measured = stamp, angles, rates

    def command(self, message: JointState) -> None:
        """Keep commanded angles or rates of flippers; raises ``MessageError`` if the message is unusable."""
        flippers = [joint.name for joint in self._robot.joints if joint.kind == "flipper"]
        try:
            stamp = self._stamp(message)
            decoding.decode_joints(message, flippers)
            angles, rates = decoding.decode_joints(message, self._robot.joint_names)
        except decoding.MessageError:
            with self._lock:
                self._commanded = None
            raise
        with self._lock:
            self._commanded = stamp, angles, rates

    @property
    def _limit(self) -> int:
        return round(self._timeout * 1e9)

    def _stamp(self, message: JointState) -> int:
        stamp = decoding.stamp_of(message)
        if not stamp:
            raise decoding.MessageError("joint states: the stamps are zero: the driver does not set them")
        return stamp

    def at(self, stamp: int) -> JointMotion | None:
        """Joints for a prediction from ``stamp`` [ns]; None if none were ever measured or commanded.

        Raises:
            ValueError: the newest measurement is older than the timeout.
        """
        with self._lock:
            measured, commanded = self._measured, self._commanded
        if measured is None and commanded is None:
            return None
        unknown = np.full(len(self._robot.joints), np.nan)
        angles, rates = unknown, unknown
        if measured is not None:
            age = stamp - measured[0]
            if age > self._limit:
                raise ValueError(
                    f"joint states: the newest is {1e-9 * age:.1f} s older than the sensor data, expected at most "
                    f"{self._timeout:g} s"
                )
            angles = measured[1]
            rates = measured[2] if self._continues else unknown
        targets, target_rates = unknown, unknown
        if commanded is not None and stamp - commanded[0] <= self._limit:
            targets, target_rates = commanded[1:]
        return JointMotion.of(self._robot, angles, rates, targets, target_rates)
