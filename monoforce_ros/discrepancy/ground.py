"""Ground: which terrain a recording is compared on, and whether that is the ground that it was driven on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagError, Recording, SmoothedMotion
from monoforce_ros.core import NANOSECOND
from monoforce_ros.discrepancy.attitude import Lean, vertical
from monoforce_ros.discrepancy.encoder_ground import EncoderGround
from monoforce_ros.discrepancy.separate_stretches import starts_anew
from monoforce_ros.robots import RobotModel

LEVEL_SLOPE = np.arcsin(0.05)
"""Slope up to which ground counts as level [rad].

On it gravity pulls with a twentieth of the weight, the typical rolling resistance of the catalogue: more would be taken
for an effect.
"""
STEEPER = np.sqrt(2.0)
"""Ground that is so many times as steep as where the robot was commissioned leaves a residual that nobody has seen:
what slopes contribute to its variance grows with their square, to twice as much."""
_APART = 1.0
"""Distance over which slopes are taken from heights [m]."""


@dataclass(frozen=True)
class Ground:
    """The terrain that a recording is compared on."""

    source: str
    """``flat``, ``lidar``, ``traced``, ``camera``, ``lidar_camera`` or a file."""
    description: str
    """For reports: what was taken and why."""
    slope: float
    """Root mean square slope by the measured poses [rad]; see :func:`slopes_of`."""
    complaint: str = ""
    """Why this is not the ground that the robot drove on; empty if nothing speaks against it."""

    unexplained: str = ""
    """Why an error without a name may be the ground's; empty if a map shows the ground, or it is level."""
    uneven: bool = False
    """Whether no map shows slopes that differ from place to place: forces that these exert may pass for effects."""
    apart: bool = False
    """Whether each stretch of the recording is traced for itself, since the localisation starts anew in each."""
    encoder: EncoderGround | None = None
    """The encoder that predicts it; None where none does."""

    @property
    def unknown(self) -> bool:
        """Whether the robot drove over ground that no map shows."""
        return bool(self.complaint)


def choose_ground(terrain: str, recording: Recording, smoothed: SmoothedMotion, robot: RobotModel) -> Ground:
    """The terrain of a recording: as asked for, or for ``auto`` from what the bag holds.

    Args:
        terrain: ``auto``, ``flat``, ``lidar``, ``traced``, a source of :class:`EncoderGround` or a file of
            ``fit_terrain``.
        recording: its clouds serve as map where there are any and their sensor's pose is known.
        smoothed: the measured motion, whose roll, pitch and heights show whether ground is level.
        robot: its file may know the pose of the lidar.
    """
    slopes = slopes_of(smoothed)
    slope, uneven = slopes.total, slopes.uneven > LEVEL_SLOPE
    if terrain == "lidar":
        return Ground(terrain, f"lidar map of {len(recording.clouds)} sweeps", slope)
    if terrain == "traced":
        return _traced("along the measured poses", smoothed, slope, "as asked for", uneven)
    encoder = EncoderGround.named(terrain)
    if encoder is not None:
        return Ground(terrain, f"map of the terrain encoder ({encoder.kind})", slope, encoder=encoder)
    if terrain not in ("auto", "flat"):
        return Ground(terrain, f"map {Path(terrain).name}", slope)
    reason = "no clouds in the bag"
    if terrain == "auto" and recording.clouds:
        try:
            points, frame = recording.cloud(recording.clouds[0])
            recording.sensor_pose(frame, robot.base_frame, robot.sensors, recording.clouds[0].stamp)
            if len(points):
                return Ground("lidar", f"lidar map of {len(recording.clouds)} sweeps (the bag has clouds)", slope)
            reason = "the bag's clouds are empty"
        except (BagError, ValueError) as error:
            reason = f"clouds cannot be used: {error}"
    said = "as asked for" if terrain == "flat" else reason
    complaint = ""
    if terrain == "auto" and uneven:
        return _traced(
            f"(slopes of {np.degrees(slope):.1f}° by the poses, and {reason})", smoothed, slope, reason, uneven
        )
    if slope > LEVEL_SLOPE:
        remedy = "use --terrain lidar or a map" if recording.clouds else "record a lidar, or give a map of fit_terrain"
        what = f"the ground is not level (slopes of {np.degrees(slope):.1f}° by the poses, root mean square)"
        if not uneven:
            what = (
                f"the poses lie in a plane that is tilted by {np.degrees(slopes.plane):.1f}°: the ground slopes, or "
                "z of the localisation is not against gravity"
            )
            remedy = "level the localisation's frame by its IMU, or " + remedy
        complaint = f"{what}; level ground is assumed ({said}), so that slopes may pass for an effect: {remedy}"
    return Ground("flat", f"level ({said})", slope, complaint, complaint, uneven)


def _traced(how: str, smoothed: SmoothedMotion, slope: float, reason: str, uneven: bool) -> Ground:
    """Ground that is only known along the poses."""
    apart = starts_anew(smoothed)
    each = "; each stretch for itself, since the localisation starts anew in each" if apart else ""
    unexplained = _by_trace(slope, reason) if uneven else ""
    return Ground("traced", f"traced by the wheels {how}{each}", slope, "", unexplained, uneven, apart)


def _by_trace(slope: float, reason: str) -> str:
    """Why an error may be the ground's where the ground is only known along the poses."""
    return (
        f"the ground is not level (slopes of {np.degrees(slope):.1f}° by the poses, root mean square) and no map shows "
        f"it ({reason}): what its trace along the poses leaves unexplained may be the ground's; record a lidar, give a "
        "map of fit_terrain (--terrain), or commission the robot with a recording of such ground"
    )


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


@dataclass(frozen=True)
class Slopes:
    """Slopes of the ground that a robot drove over, by its poses [rad]."""

    total: float
    """Root mean square, beyond the noise of the poses."""
    plane: float
    """Tilt of the plane that fits the heights best."""
    uneven: float
    """Root mean square of what differs from that plane."""


def slopes_of(smoothed: SmoothedMotion) -> Slopes:
    """Slopes of the ground under a measured motion.

    Root mean squares are the larger of two estimates: the tilt of the robot, without one that it keeps in its own axes
    as a sensor mounted at an angle has; and the change of its height along the way.
    """
    motion = smoothed.motion
    rotations = Rotation.from_quat(motion.quaternions).as_matrix()
    lean, up = Lean.of(rotations), vertical(rotations)
    places = np.c_[motion.positions[:, :2], np.ones(len(motion))]
    plane = np.linalg.lstsq(places, motion.positions[:, 2], rcond=1e-6)[0]

    def root_mean_square(tilts: np.ndarray, heights: np.ndarray) -> float:
        tilt = float(np.mean((tilts**2).sum(axis=1))) - 2.0 * smoothed.rotation_noise**2
        return float(np.sqrt(max(tilt, _rise(smoothed, heights), 0.0)))

    return Slopes(
        root_mean_square(up - lean.own, motion.positions[:, 2]),
        float(np.arctan(np.hypot(*plane[:2]))),
        root_mean_square(up - lean.own - lean.of_plane(rotations), motion.positions[:, 2] - places @ plane),
    )


def _rise(smoothed: SmoothedMotion, heights: np.ndarray) -> float:
    """Mean square slope of heights ``[N]`` [m] along the way, beyond their noise."""
    motion, changes = smoothed.motion, []
    for stretch in smoothed.stretches:
        places = motion.positions[stretch]
        along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1))]
        if along[-1] < 2 * _APART or (motion.stamps[stretch][-1] - motion.stamps[stretch][0]) * NANOSECOND < 2.0:
            continue
        keep = np.r_[True, np.diff(along) > 1e-6]
        even = np.interp(np.arange(0.0, along[-1], _APART), along[keep], heights[stretch][keep])
        changes.append(np.diff(even) / _APART)
    if not changes:
        return 0.0
    # A height that drifts as a whole is no slope; the median is robust against jumps of a localisation.
    middle = float(np.median(np.abs(np.concatenate(changes))) / 0.6745)
    return middle**2 - 2.0 * (smoothed.position_noise / _APART) ** 2
