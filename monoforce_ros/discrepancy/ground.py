"""Ground: which terrain a recording is compared on, and whether that is the ground that it was driven on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagError, Recording, SmoothedMotion
from monoforce_ros.core import NANOSECOND
from monoforce_ros.robots import RobotModel

LEVEL_SLOPE = np.arcsin(0.05)
"""Slope up to which ground counts as level [rad].

On it gravity pulls with a twentieth of the weight, the typical rolling resistance of the catalogue: more would be taken
for an effect.
"""
STEEPER = np.sqrt(2.0)
"""Ground that is so many times as steep as where the robot was commissioned leaves a residual that nobody has seen:
what slopes contribute to its variance grows with their square, to twice as much."""
_SHARE_OF_PLANE = 0.8
"""Share of the heights' variance above which one plane describes the ground: most of it, with room for noise."""
_APART = 1.0
"""Distance over which slopes are taken from heights [m]."""


@dataclass(frozen=True)
class Ground:
    """The terrain that a recording is compared on."""

    source: str
    """``flat``, ``lidar``, ``traced`` or a file."""
    description: str
    """For reports: what was taken and why."""
    slope: float
    """Root mean square slope by the measured poses [rad]; see :func:`slope_of`."""
    complaint: str = ""
    """Why this is not the ground that the robot drove on; empty if nothing speaks against it."""

    unexplained: str = ""
    """Why an error without a name may be the ground's; empty if a map shows the ground, or it is level."""

    @property
    def unknown(self) -> bool:
        """Whether the robot drove over ground that no map shows."""
        return bool(self.complaint)


def choose_ground(terrain: str, recording: Recording, smoothed: SmoothedMotion, robot: RobotModel) -> Ground:
    """The terrain of a recording: as asked for, or for ``auto`` from what the bag holds.

    Args:
        terrain: ``auto``, ``flat``, ``lidar``, ``traced`` or a file of ``fit_terrain``.
        recording: its clouds serve as map where there are any and their sensor's pose is known.
        smoothed: the measured motion, whose roll, pitch and heights show whether ground is level.
        robot: its file may know the pose of the lidar.
    """
    slope, plane = slope_of(smoothed)
    if terrain == "lidar":
        return Ground(terrain, f"lidar map of {len(recording.clouds)} sweeps", slope)
    if terrain == "traced":
        return Ground(terrain, "traced by the wheels along the measured poses", slope)
    if terrain not in ("auto", "flat"):
        return Ground(terrain, f"map {Path(terrain).name}", slope)
    reason = "no clouds in the bag"
    if terrain == "auto" and recording.clouds:
        try:
            points, frame = recording.cloud(recording.clouds[0])
            recording.sensor_pose(frame, robot.base_frame, robot.sensors)
            if len(points):
                return Ground("lidar", f"lidar map of {len(recording.clouds)} sweeps (the bag has clouds)", slope)
            reason = "the bag's clouds are empty"
        except (BagError, ValueError) as error:
            reason = f"clouds cannot be used: {error}"
    said = "as asked for" if terrain == "flat" else reason
    complaint = ""
    if terrain == "auto" and slope > LEVEL_SLOPE and plane <= _SHARE_OF_PLANE:
        degrees = np.degrees(slope)
        unexplained = (
            f"the ground is not level (slopes of {degrees:.1f}° by the poses, root mean square) and no map shows it "
            f"({reason}): what its trace along the poses leaves unexplained may be the ground's; record a lidar, or "
            "give a map of fit_terrain (--terrain)"
        )
        description = f"traced by the wheels: slopes of {degrees:.1f}° by the poses, and {reason}"
        return Ground("traced", description, slope, unexplained=unexplained)
    if slope > LEVEL_SLOPE:
        remedy = "use --terrain lidar or a map" if recording.clouds else "record a lidar, or give a map of fit_terrain"
        what = f"the ground is not level (slopes of {np.degrees(slope):.1f}° by the poses, root mean square)"
        if plane > _SHARE_OF_PLANE:
            what = (
                f"the poses lie in a plane that is tilted by {np.degrees(slope):.1f}°: the ground slopes, or z of the "
                "localisation is not against gravity"
            )
            remedy = "level the localisation's frame by its IMU, or " + remedy
        complaint = f"{what}; level ground is assumed ({said}), so that slopes may pass for an effect: {remedy}"
    return Ground("flat", f"level ({said})", slope, complaint, complaint)


def beyond_commissioning(slope: float, commissioned: float | None) -> str:
    """Why an error without a name may be that of steeper ground than the healthy robot was seen on; empty if not.

    Args:
        slope: of the recording, root mean square [rad].
        commissioned: that of the recordings by which the robot was commissioned; None if unknown.
    """
    if commissioned is None or slope <= max(LEVEL_SLOPE, STEEPER * commissioned):
        return ""
    return (
        f"the robot was commissioned on ground with slopes of {np.degrees(commissioned):.1f}°, and drives over slopes "
        f"of {np.degrees(slope):.1f}° here (root mean square): how large its errors are there when it is healthy is "
        "not known; commission it with a recording of such ground, too (diagnose --commission BAG BAG)"
    )


def slope_of(smoothed: SmoothedMotion) -> tuple[float, float]:
    """Root mean square slope of the ground that the robot drove over, by its poses, beyond their noise [rad].

    Also returns the share of the variance of the heights that one tilted plane explains. The slope is the larger of two
    estimates: the tilt of the robot, without one that it keeps in its own axes as a sensor mounted at an angle has; and
    the change of its height along the way.
    """
    motion = smoothed.motion
    rotations = Rotation.from_quat(motion.quaternions).as_matrix()
    every = max(1, len(motion) // 4000)
    up = rotations[::every, 2, :2]  # of the odometry frame's z axis, in the base frame: minus pitch and roll
    yaw = np.arctan2(rotations[::every, 1, 0], rotations[::every, 0, 0])
    # up = mounting + slope turned into the base frame; where the robot hardly turns all of it is slope.
    rows = np.zeros((len(up), 2, 4))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, 0, 2], rows[:, 0, 3] = np.cos(yaw), np.sin(yaw)
    rows[:, 1, 2], rows[:, 1, 3] = -np.sin(yaw), np.cos(yaw)
    matrix = rows.reshape(-1, 4)
    prior = np.diag([1.0, 1.0, 0.0, 0.0]) * 0.02 * len(up) + 1e-9 * np.eye(4)
    solution = np.linalg.solve(matrix.T @ matrix + prior, matrix.T @ up.ravel())
    tilts = up - solution[:2]
    tilt = float(np.mean((tilts**2).sum(axis=1))) - 2.0 * smoothed.rotation_noise**2
    heights = []
    for stretch in smoothed.stretches:
        places = motion.positions[stretch]
        along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1))]
        if along[-1] < 2 * _APART or (motion.stamps[stretch][-1] - motion.stamps[stretch][0]) * NANOSECOND < 2.0:
            continue
        keep = np.r_[True, np.diff(along) > 1e-6]
        heights.append(np.diff(np.interp(np.arange(0.0, along[-1], _APART), along[keep], places[keep, 2])) / _APART)
    rise = 0.0
    if heights:
        steps = np.concatenate(heights)
        # A height that drifts as a whole is no slope; the median is robust against jumps of a localisation.
        rise = float(np.median(np.abs(steps)) / 0.6745) ** 2 - 2.0 * (smoothed.position_noise / _APART) ** 2
    places = np.c_[motion.positions[:, :2], np.ones(len(motion))]
    height = motion.positions[:, 2]
    off = height - places @ np.linalg.lstsq(places, height, rcond=None)[0]
    return float(np.sqrt(max(tilt, rise, 0.0))), 1.0 - float(off.var() / max(height.var(), 1e-12))
