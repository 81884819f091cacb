"""Tracks: measured motion, angular velocity, wheel speeds and commands over time; definition of the terrain frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from monoforce_ros.core.geometry import homogeneous

NANOSECOND = 1e-9
LARGEST_COMMAND = 100.0
"""Larger commands are no robot's and are refused [m/s, rad/s]."""


class StaleDataError(ValueError):
    """No measurement lies close enough to the requested time; the message gives the gap to the nearest one."""


@dataclass(frozen=True)
class MotionState:
    """A robot's measured motion at one time (REP 105, nav_msgs/Odometry)."""

    stamp: int
    """Time [ns]."""
    position: np.ndarray
    """Position of the base frame in the odometry frame [m], ``[3]``."""
    rotation: np.ndarray
    """Rotation odometry ← base, ``[3, 3]``."""
    linear_velocity: np.ndarray
    """Velocity in base axes [m/s], ``[3]``."""
    angular_velocity: np.ndarray
    """Angular velocity in base axes [rad/s], ``[3]``."""

    @property
    def heading(self) -> float:
        """Yaw of the base's x axis [rad]."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    @property
    def rounding(self) -> float:
        """Distance of 32-bit numbers, as clouds hold them, at the position [m]."""
        return float(np.spacing(np.float32(np.abs(self.position).max())))

    def onwards(self, seconds: float) -> MotionState:
        """The state extrapolated at constant velocities in base axes, also backwards; stamp unchanged."""
        if not seconds:
            return self
        turn = Rotation.from_rotvec(self.angular_velocity * seconds).as_matrix()
        half = Rotation.from_rotvec(self.angular_velocity * (0.5 * seconds)).as_matrix()
        position = self.position + self.rotation @ half @ self.linear_velocity * seconds
        return replace(self, position=position, rotation=self.rotation @ turn)

    def of_base(self, base_from_child: np.ndarray) -> MotionState:
        """The motion of the base, if this is the motion of a frame with pose ``[4, 4]`` in the base frame."""
        child_from_base = np.linalg.inv(base_from_child)
        turn = base_from_child[:3, :3]
        lever = child_from_base[:3, 3]
        return replace(
            self,
            position=self.position + self.rotation @ lever,
            rotation=self.rotation @ child_from_base[:3, :3],
            linear_velocity=turn @ (self.linear_velocity + np.cross(self.angular_velocity, lever)),
            angular_velocity=turn @ self.angular_velocity,
        )

    @property
    def odometry_from_base(self) -> np.ndarray:
        """Homogeneous transform ``[4, 4]``."""
        return homogeneous(self.rotation, self.position)

    @property
    def odometry_from_terrain(self) -> np.ndarray:
        """Homogeneous transform ``[4, 4]`` from the terrain frame: at the base, x along its heading, z up."""
        return homogeneous(Rotation.from_euler("z", self.heading).as_matrix(), self.position)

    @property
    def terrain_from_base(self) -> np.ndarray:
        """Homogeneous transform ``[4, 4]``: roll and pitch of the robot, no translation."""
        return np.linalg.inv(self.odometry_from_terrain) @ self.odometry_from_base


@dataclass(frozen=True)
class MotionTrack:
    """Measured motion over time, in order of stamp."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], strictly increasing."""
    positions: np.ndarray
    """``[n, 3]`` [m]."""
    quaternions: np.ndarray
    """``[n, 4]`` x, y, z, w, odometry ← base."""
    linear_velocities: np.ndarray
    """``[n, 3]`` in base axes [m/s]."""
    angular_velocities: np.ndarray
    """``[n, 3]`` in base axes [rad/s]."""
    frame_id: str = "odom"
    child_frame_id: str = "base_link"

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, stamp: int, *, maximum_gap: float = 0.5) -> MotionState:
        """The motion at a time, interpolated between the measurements around it.

        After the last measurement the motion is extrapolated at constant velocity: sensor data are often slightly ahead
        of odometry.

        Args:
            stamp: time [ns].
            maximum_gap: largest time difference to the measurements used [s].

        Raises:
            StaleDataError: the nearest measurements are further away than ``maximum_gap``.
        """
        if not len(self):
            raise StaleDataError("no odometry has been received")
        after = int(np.searchsorted(self.stamps, stamp))
        before = max(after - 1, 0)
        after = min(after, len(self) - 1)
        if after == before:  # before the first or after the last measurement
            gap = abs(int(self.stamps[after]) - stamp) * NANOSECOND
            self._refuse_gap(gap, maximum_gap)
            # Before the first measurement it may have stood.
            return self._state(after, stamp).onwards(max(0.0, (stamp - int(self.stamps[after])) * NANOSECOND))
        span = int(self.stamps[after] - self.stamps[before])
        gaps = (stamp - int(self.stamps[before])) * NANOSECOND, (int(self.stamps[after]) - stamp) * NANOSECOND
        if min(gaps) > maximum_gap:
            self._refuse_gap(min(gaps), maximum_gap)
        if max(gaps) > maximum_gap:
            # Beside a pause the robot goes on moving: held, a pose at a tenth of a second would be centimetres off.
            near, elapsed = (before, gaps[0]) if gaps[0] < gaps[1] else (after, -gaps[1])
            return self._state(near, stamp).onwards(elapsed)
        fraction = (stamp - int(self.stamps[before])) / span

        def blend(values: np.ndarray) -> np.ndarray:
            return (1 - fraction) * values[before] + fraction * values[after]

        pair = Rotation.from_quat(self.quaternions[[before, after]])
        return MotionState(
            stamp=int(stamp),
            position=blend(self.positions),
            rotation=Slerp([0.0, 1.0], pair)(fraction).as_matrix(),
            linear_velocity=blend(self.linear_velocities),
            angular_velocity=blend(self.angular_velocities),
        )

    def states(self, after: int, until: int) -> Iterator[MotionState]:
        """Measured states with stamps after ``after`` and up to ``until`` [ns]."""
        first, last = np.searchsorted(self.stamps, [after, until], side="right")
        for index in range(int(first), int(last)):
            yield self._state(index, int(self.stamps[index]))

    def of_base(self, base_from_child: np.ndarray, base_frame: str) -> MotionTrack:
        """The motion of the base, if this is the motion of a frame with pose ``[4, 4]`` in the base frame.

        Args:
            base_from_child: pose of the frame that was measured, or its poses ``[N, 4, 4]``; how fast these change is
                neglected in the velocities.
            base_frame: name of the base frame.
        """
        if np.allclose(base_from_child, np.eye(4), atol=1e-9):
            return replace(self, child_frame_id=base_frame)
        child_from_base = np.linalg.inv(base_from_child)
        turn, lever = base_from_child[..., :3, :3], child_from_base[..., :3, 3]
        rotations = Rotation.from_quat(self.quaternions)

        def turned(vectors: np.ndarray) -> np.ndarray:
            return np.asarray((turn @ vectors[..., None])[..., 0])

        return replace(
            self,
            positions=self.positions + rotations.apply(lever),
            quaternions=(rotations * Rotation.from_matrix(child_from_base[..., :3, :3])).as_quat(),
            linear_velocities=turned(self.linear_velocities + np.cross(self.angular_velocities, lever)),
            angular_velocities=turned(self.angular_velocities),
            child_frame_id=base_frame,
        )

    def base_between(self, start: int, end: int, *, maximum_gap: float = 0.5) -> np.ndarray:
        """Pose ``[4, 4]`` of the base frame of time ``start`` [ns] in that of ``end``; errors as in :meth:`at`."""
        if start == end:
            return np.eye(4)
        before, after = (self.at(stamp, maximum_gap=maximum_gap) for stamp in (start, end))
        return np.linalg.inv(homogeneous(after.rotation, after.position)) @ homogeneous(
            before.rotation, before.position
        )

    def _refuse_gap(self, gap: float, maximum_gap: float) -> None:
        if gap > maximum_gap:
            raise StaleDataError(
                f"the nearest odometry is {gap:.2f} s away from the requested time, expected at most {maximum_gap:g} s"
            )

    def _state(self, index: int, stamp: int) -> MotionState:
        return MotionState(
            stamp=int(stamp),
            position=self.positions[index],
            rotation=Rotation.from_quat(self.quaternions[index]).as_matrix(),
            linear_velocity=self.linear_velocities[index],
            angular_velocity=self.angular_velocities[index],
        )


@dataclass(frozen=True)
class AngularVelocityTrack:
    """Angular velocity measured by an IMU over time, in the IMU's axes."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], ascending."""
    rates: np.ndarray
    """``[n, 3]`` [rad/s]."""
    frame_id: str = "imu_link"

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True)
class WheelTrack:
    """Measured angular speed of the left and right wheels over time."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], ascending."""
    speeds: np.ndarray
    """Mean over the left and over the right wheels, ``[n, 2]`` [rad/s]."""

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True)
class EffortTrack:
    """How hard the motors of the left and right wheels work over time: currents or torques, as the driver publishes."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], ascending."""
    efforts: np.ndarray
    """Mean magnitude over the left and over the right wheels, ``[n, 2]`` [A, N m, or another unit of the driver]."""

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True)
class CommandTrack:
    """Commanded motion over time; each command holds until the next."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], increasing."""
    twists: np.ndarray
    """``[n, 2]`` forward speed [m/s], yaw rate [rad/s]; ``[n, 3]`` with the lateral speed [m/s] of robots that crab."""

    def __len__(self) -> int:
        return len(self.stamps)

    def sample(self, stamps: np.ndarray, *, timeout: float = np.inf) -> np.ndarray:
        """Commands that are active at given times.

        Args:
            stamps: ``[...]`` int64 [ns].
            timeout: age [s] after which a command expires and zero velocity is assumed.

        Returns:
            ``[..., 2]`` or ``[..., 3]``; zero before the first command.
        """
        stamps = np.asarray(stamps, np.int64)
        if not len(self):
            return np.zeros((*stamps.shape, self.twists.shape[-1]))
        index = np.searchsorted(self.stamps, stamps, side="right") - 1
        latest = self.twists[np.maximum(index, 0)]
        age = (stamps - self.stamps[np.maximum(index, 0)]) * NANOSECOND
        return np.where(((index >= 0) & (age <= timeout))[..., None], latest, 0.0)
