"""Trace: the ground that a robot drove over, from its poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import NANOSECOND, MotionState, MotionTrack, transform_points
from monoforce_ros.perception.ground_alignment import lowest_points, stands, support_points
from monoforce_ros.robots import RobotModel

TRACE_LENGTH = 6.0
"""Length of the path whose ground counts as known [m]; further back it is outside the map or odometry has drifted."""


def traced_ground(robot: RobotModel, odometry_from_bases: np.ndarray, step: float) -> np.ndarray:
    """Ground under the wheels along the last metres of a path.

    Args:
        robot: its wheels or tracks.
        odometry_from_bases: poses ``[n, 4, 4]`` up to now, oldest first.
        step: distance between the poses that are used [m].

    Returns:
        ``[k, 3]`` in the odometry frame [m], without poses in which the robot tips over; empty if it has not moved by
        ``step`` yet.
    """
    if len(odometry_from_bases) < 2:
        return np.zeros((0, 3))
    positions = odometry_from_bases[:, :3, 3]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    back = travelled[-1] - travelled
    wanted = np.arange(step, min(TRACE_LENGTH, back[0]) + 1e-9, step)
    index = np.unique(np.searchsorted(-back, -wanted))
    poses = [pose for pose in odometry_from_bases[index] if stands(robot, pose[:3, :3])]
    lowest = lowest_points(robot)
    return np.concatenate([transform_points(pose, lowest) for pose in poses] or [np.zeros((0, 3))])


class DrivenGround:
    """Collects, while driving, the ground under the wheels along the last metres.

    It starts over where odometry jumps or time goes back, and leaves out where the robot tips over: its wheels are in
    the air.

    Args:
        robot: its wheels or tracks.
        stiffness: of the ground that carries it [N/m³].
        length: length of the path that is kept [m].
        step: distance after which the ground under the wheels is added [m].
    """

    def __init__(self, robot: RobotModel, stiffness: float, *, length: float = TRACE_LENGTH, step: float = 0.1):
        self._robot, self._stiffness = robot, stiffness
        self._length, self._step = length, step
        self._places: list[tuple[np.ndarray, np.ndarray]] = []
        """Position of the robot and the points under its wheels, in the odometry frame."""
        self._previous: MotionState | None = None

    def update(self, motion: MotionState, track: MotionTrack | None = None) -> np.ndarray:
        """Add where the robot has been, and return the ground that it drove over before.

        Args:
            motion: the robot's motion now.
            track: measured motion; what lies between the last call and now is added. By default only where the robot
                is at the time of each call is known.

        Returns:
            ``[k, 3]`` in the terrain frame [m], without the ground under the robot now.
        """
        last = self._previous
        if last is not None and last.stamp > motion.stamp:
            last = None
        # Of a track only measured states count: what is known of a time does not depend on when it was asked for.
        for state in [motion] if track is None else track.states(-1 if last is None else last.stamp, motion.stamp):
            if last is None or not continues(state, last):
                self._places = []
            last = state
            far = not self._places or np.linalg.norm(state.position - self._places[-1][0]) >= self._step
            if far and stands(self._robot, state.rotation):
                support = support_points(self._robot, state, self._stiffness)
                self._places.append((state.position, transform_points(state.odometry_from_terrain, support)))
        self._previous = last
        kept = round(self._length / self._step)
        self._places = self._places[-kept:]
        earlier = list(self._places)
        if earlier and np.linalg.norm(motion.position - earlier[-1][0]) < self._step:
            earlier.pop()
        if not earlier:
            return np.zeros((0, 3))
        points = np.concatenate([points for _, points in earlier])
        return transform_points(np.linalg.inv(motion.odometry_from_terrain), points)


_LONGEST_BREAK = 1.0
"""Time after which a track's first state no longer goes on from an earlier one [s]."""
_JUMP = 1.0
"""Largest distance between the measured position and the one extrapolated from the last velocity [m]; beyond it, the
robot was moved or its odometry jumped."""


def continues(motion: MotionState, previous: MotionState) -> bool:
    """Whether the robot can have moved from the previous pose to this one in the time between."""
    elapsed = (motion.stamp - previous.stamp) * NANOSECOND
    expected = previous.position + previous.rotation @ previous.linear_velocity * elapsed
    return elapsed >= 0.0 and float(np.linalg.norm(motion.position - expected)) < _JUMP * max(1.0, elapsed)


def unbroken(track: MotionTrack, since: MotionState) -> bool:
    """Whether a track goes on from a state without a jump of its poses.

    Args:
        track: measured motion that begins at the time of the state, or earlier.
        since: a state measured earlier by the same odometry.
    """
    first = int(np.searchsorted(track.stamps, since.stamp))
    if first == len(track) or (int(track.stamps[first]) - since.stamp) * NANOSECOND > _LONGEST_BREAK:
        return False
    if not continues(track.at(int(track.stamps[first])), since):
        return False
    # As of :func:`continues`, of all states at once.
    positions, velocities = track.positions[first:], track.linear_velocities[first:-1]
    elapsed = np.diff(track.stamps[first:]) * NANOSECOND
    moved = (
        Rotation.from_quat(track.quaternions[first:-1]).apply(velocities) * elapsed[:, None] if len(elapsed) else 0.0
    )
    off = np.linalg.norm(np.diff(positions, axis=0) - moved, axis=1)
    return bool((off < _JUMP * np.maximum(1.0, elapsed)).all())
