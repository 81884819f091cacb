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
        self._robot, self._continues, self.timeout = robot, continues, timeout
        self._lock = threading.Lock()
        self._stamps = np.zeros(len(robot.joints), np.int64)
        """When each joint was measured last [ns]; 0: never."""
        self._angles, self._rates = (np.full(len(robot.joints), np.nan) for _ in range(2))
        self._fault = ""
        """Why the last message cannot be used."""
        self._commanded: tuple[int, np.ndarray, np.ndarray] | None = None

    def clear(self) -> None:
        """Forget everything, after a backward time jump."""
        with self._lock:
            self._stamps[:], self._fault, self._commanded = 0, "", None

    def measure(self, message: JointState) -> None:
        """Keep measured angles. Drivers may publish joints in several messages: each joint keeps its newest.

        Messages of other joints alone are ignored while this robot's are measured.

        Raises ``MessageError`` if the message is unusable; there are no joints then until a usable one.
        """
        try:
            stamp = self._stamp(message)
            angles, rates = decoding.decode_joints(message, self._robot.joint_names)
        except decoding.MessageError as error:
            with self._lock:
                foreign = not set(message.name) & set(self._robot.joint_names)
                if foreign and self._stamps.any() and decoding.stamp_of(message) - self._stamps.max() <= self._limit:
                    return
                self._fault = str(error)
            raise
        with self._lock:
            known = np.isfinite(angles)
            self._stamps[known], self._angles[known], self._rates[known] = stamp, angles[known], rates[known]
            self._fault = ""

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
        return round(self.timeout * 1e9)

    def _stamp(self, message: JointState) -> int:
        stamp = decoding.stamp_of(message)
        if not stamp:
            raise decoding.MessageError("joint states: the stamps are zero: the driver does not set them")
        return stamp

    def at(self, stamp: int) -> JointMotion | None:
        """Joints for a prediction from ``stamp`` [ns]; None if none were ever measured or commanded.

        Raises:
            ValueError: the newest message is unusable, or a joint that was measured is not within the timeout.
        """
        with self._lock:
            stamps, angles, rates = self._stamps.copy(), self._angles.copy(), self._rates.copy()
            commanded, fault = self._commanded, self._fault
        if fault:
            raise ValueError(fault)
        measured = stamps > 0
        if not measured.any() and commanded is None:
            return None
        unknown = np.full(len(self._robot.joints), np.nan)
        ages = np.where(measured, stamp - stamps, 0)
        worst = int(np.abs(ages).argmax())
        if abs(ages[worst]) > self._limit:
            relation = "older" if ages[worst] > 0 else "newer"
            raise ValueError(
                f"joint states: the newest of {self._robot.joint_names[worst]} is {1e-9 * abs(ages[worst]):.1f} s "
                f"{relation} than the sensor data, expected at most {self.timeout:g} s"
            )
        angles = np.where(measured, angles, unknown)
        rates = np.where(measured, rates, unknown) if self._continues else unknown
        targets, target_rates = unknown, unknown
        if commanded is not None and stamp - commanded[0] <= self._limit:
            targets, target_rates = commanded[1:]
        return JointMotion.of(self._robot, angles, rates, targets, target_rates)
