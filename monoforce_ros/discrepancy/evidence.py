"""Evidence: data of a recording, and the windows of it on which hypotheses are tested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from monoforce_ros.bags import JointRecord, SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, EffortTrack, MotionTrack, WheelTrack
from monoforce_ros.terrain import TerrainMap

MOTION = ("along", "across", "heading")
"""Components of a residual: position in the frame of the window's start pose [m], heading [rad]."""
ATTITUDE = (*MOTION, "roll", "pitch", "height")
"""Those where the ground is known, too: roll and pitch beside what the recording always leans [rad], and the height
since the start of the window [m]."""
COMPONENTS = (*ATTITUDE, "roll rate", "pitch rate", "climb rate")
"""And how fast these three change: root mean squares, since the sample before, of the angular velocity about the
base's x and y axes [rad/s] and of the vertical velocity [m/s]. Softness of ground and tyres shows in them more than in
the attitude itself. Not their values at an instant: over bumps these follow from where the robot is within centimetres,
and small errors of its timing, which every model has, would count most."""
RATE_TIME = 0.05
"""Between angular and vertical velocities in such a mean [s]."""
_MARGIN = 1.3
"""Margin at both ends of a stretch, so that data remain available with a shifted clock [s]."""
_SHORT = 12.0
"""Stretches shorter than this keep their beginning, which often contains the manoeuvre, such as a step [s]."""


class Place(Protocol):
    """A part of the ground."""

    def holds(self, places: np.ndarray, data: EvidenceWindows) -> np.ndarray:
        """Places ``[N, 2]`` [m] in the odometry frame that are on it, ``[N]`` bool."""
        ...

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Its lowest and highest corner, ``[2]`` each [m] in the odometry frame; None: it is as large as the map."""
        ...


@dataclass(frozen=True)
class Evidence:
    """Data of a recording: motion, commands, ground, and other sensors."""

    smoothed: SmoothedMotion
    commands: CommandTrack
    terrain: TerrainMap | None = None
    """One map in its own frame, or None for level ground."""
    odometry_from_terrain: np.ndarray | None = None
    """Pose ``[4, 4]`` of the map in the odometry frame; required with a map."""
    split_maps: tuple[TerrainMap, TerrainMap] | None = None
    """Maps from the even and from the odd sweeps alone."""
    gyro: AngularVelocityTrack | None = None
    """Angular velocity measured by an IMU."""
    wheels: WheelTrack | None = None
    """Measured wheel speeds, in rad/s."""
    wheel_unit: float = 1.0
    """Recorded wheel speeds over these."""
    efforts: EffortTrack | None = None
    """Currents or torques of the drive wheels' motors."""
    joints: JointRecord | None = None
    """Measured joints and commands to flippers."""
    components: tuple[str, ...] = MOTION
    """Names of the ``C`` components of a residual: :data:`COMPONENTS` where the ground is known from something else
    than roll, pitch and height."""

    @property
    def with_attitude(self) -> bool:
        """Whether roll, pitch and height are residuals, too."""
        return len(self.components) > len(MOTION)

    def cut(self, starts: np.ndarray, samples: np.ndarray) -> EvidenceWindows:
        """Windows from ``starts`` [ns] to the last of ``samples`` [s]."""
        return EvidenceWindows(
            self.smoothed.motion,
            self.commands,
            starts,
            float(samples[-1]),
            samples,
            self.terrain,
            self.odometry_from_terrain,
            self.joints,
            self.components,
        )


@dataclass(frozen=True)
class EvidenceWindows:
    """Windows of a recording on which hypotheses are tested."""

    motion: MotionTrack
    """Smoothed."""
    commands: CommandTrack
    starts: np.ndarray
    """Start of each window in recorded time, ``[W]`` int64 [ns]."""
    horizon: float
    """Length of a window [s]."""
    samples: np.ndarray
    """Times in a window at which residuals are computed [s], ``[K]``."""
    terrain: TerrainMap | None = None
    """One map in its own frame, or None for level ground."""
    odometry_from_terrain: np.ndarray | None = None
    joints: JointRecord | None = None
    """Measured joints and commands to flippers."""
    components: tuple[str, ...] = MOTION
    """Names of the ``C`` components of a residual: a beginning of :data:`COMPONENTS`."""
    place: Place | None = None
    """The part of the ground on which the contact and body effects of hypotheses act; None: everywhere."""

    @property
    def with_attitude(self) -> bool:
        """Whether roll, pitch and height are residuals, too."""
        return len(self.components) > len(MOTION)


def window_starts(motion: MotionTrack, stretches: Sequence[slice], horizon: float, stride: float) -> np.ndarray:
    """Starts of windows within gap-free stretches of odometry, ``[W]`` [ns]."""
    starts: list[int] = []
    for stretch in stretches:
        first, last = int(motion.stamps[stretch.start]), int(motion.stamps[stretch.stop - 1])
        # Pose clocks are late rather than early: a short stretch keeps its margin at the end only.
        lead = _MARGIN if last - first > round(_SHORT * 1e9) else 0.1
        low, high = first + round(lead * 1e9), last - round((horizon + _MARGIN) * 1e9)
        starts.extend(range(low, high + 1, round(stride * 1e9)))
    return np.array(starts, np.int64)


def subsampled(starts: np.ndarray, block: float, most: int) -> np.ndarray:
    """At most about ``most`` windows of a long recording: pairs of blocks [s], spread evenly over it."""
    if len(starts) <= most:
        return starts
    pairs = (starts - starts[0]) // round(2 * block * 1e9)
    numbers = np.unique(pairs)
    kept = numbers[:: -(-len(starts) // most)]
    return starts[np.isin(pairs, kept)]


def sample_motion(motion: MotionTrack, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, rotation matrices, linear and angular velocities in the base frame at stamps ``[...]``."""
    shape = stamps.shape
    origin = int(motion.stamps[0])
    times = (motion.stamps - origin) * 1e-9
    at = np.clip((stamps.ravel() - origin) * 1e-9, times[0], times[-1])

    def blend(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(at, times, values[:, axis]) for axis in range(3)], axis=1).reshape(*shape, 3)

    rotations = Slerp(times, Rotation.from_quat(motion.quaternions))(at).as_matrix().reshape(*shape, 3, 3)
    return blend(motion.positions), rotations, blend(motion.linear_velocities), blend(motion.angular_velocities)


def rate_means(rates: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Root mean squares of rates since the sample before, ``[..., K, R]``.

    Args:
        rates: every :data:`RATE_TIME` after the start of a window, up to the last sample, ``[..., T, R]``.
        samples: times of the samples [s], ``[K]``.
    """
    ends = np.maximum(np.rint(samples / RATE_TIME).astype(int), 1)
    begins = np.minimum(np.r_[0, ends[:-1]], ends - 1)
    means = [(rates[..., low:high, :] ** 2).mean(axis=-2) for low, high in zip(begins, ends, strict=True)]
    return np.sqrt(np.stack(means, axis=-2))


def rate_stamps(data: EvidenceWindows) -> np.ndarray:
    """Times of the rates in each window, ``[W, T]`` [ns]."""
    count = max(round(float(data.samples[-1]) / RATE_TIME), 1)
    return data.starts[:, None] + np.rint(RATE_TIME * 1e9 * np.arange(1, count + 1)).astype(np.int64)
