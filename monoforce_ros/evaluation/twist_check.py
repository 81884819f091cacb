"""Twist check: whether an odometry's twists are those of its poses, in the frame that nav_msgs/Odometry says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionTrack

_MOVING = 0.1
"""Speed of the poses from which on a sample says something [m/s]."""
_FEWEST = 20
_BETTER = 0.3
"""Share of the error that is left in another frame, if the twists are in that one."""
_LEAST_ERROR = 0.1
"""Median error of the speed that is worth a word [m/s]: more than slip and smoothing explain."""


def twist_fault(stated: MotionTrack, smoothed: MotionTrack) -> str:
    """What is wrong with an odometry's twists, in words; empty if nothing is.

    Args:
        stated: motion as recorded.
        smoothed: the same poses, with velocities that follow from them.
    """
    said, true = stated.linear_velocities[:, :2], smoothed.linear_velocities[:, :2]
    moving = np.linalg.norm(true, axis=1) > _MOVING
    if len(said) != len(true) or moving.sum() <= _FEWEST:
        return ""
    said, true = said[moving], true[moving]
    if np.abs(said).max() < 1e-6:
        return "the odometry's twists are zero"
    if np.median(np.sign(said[:, 0]) * np.sign(true[:, 0])) < 0 and np.abs(true[:, 0]).mean() > 0.5 * _MOVING:
        turned = _in_odometry_frame(true, smoothed.quaternions[moving])
        if not _fits(said, turned, true):
            return "the odometry's speed has the opposite sign of its poses' motion: wrong frame of the twist?"
    if _fits(said, _in_odometry_frame(true, smoothed.quaternions[moving]), true):
        return "the odometry's twists are in the frame of its poses, not in the child frame as nav_msgs/Odometry says"
    return ""


def with_usable_twists(stated: MotionTrack, smoothed: MotionTrack) -> tuple[MotionTrack, str]:
    """The motion as recorded, with velocities of its poses where its twists are wrong, and what was wrong."""
    fault = twist_fault(stated, smoothed)
    if not fault:
        return stated, ""
    own = replace(stated, linear_velocities=smoothed.linear_velocities, angular_velocities=smoothed.angular_velocities)
    return own, f"{fault}; velocities are taken from the smoothed poses"


def _in_odometry_frame(velocities: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    turned = Rotation.from_quat(quaternions).apply(np.column_stack([velocities, np.zeros(len(velocities))]))
    return turned[:, :2]


def _fits(said: np.ndarray, other: np.ndarray, true: np.ndarray) -> bool:
    """Whether stated velocities are those of another frame rather than the true ones."""
    error, left = (float(np.median(np.linalg.norm(said - values, axis=1))) for values in (true, other))
    return error > _LEAST_ERROR and left < _BETTER * error
