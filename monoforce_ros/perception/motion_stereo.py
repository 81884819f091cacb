"""Motion stereo: where things are, from the images of a camera that moves with the robot."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from monoforce_ros.core import NANOSECOND, CameraModel, MotionState, transform_points
from monoforce_ros.perception.epipolar import EpipolarPair, PinholeImage, pinhole_image
from monoforce_ros.perception.observation import Observation
from monoforce_ros.perception.relative_pose import GREY_NOISE, RelativePose, refined
from monoforce_ros.perception.trace import continues

BASELINES = (0.5, 1.0)
"""Distances of the two earlier images from the newest one that are sought [m]."""
_SHORTEST = 0.25
"""Least baseline [m]."""
_APART = 1.4
"""Least ratio of the two baselines: what repeats itself along an epipolar line fits one of them by chance."""
_STORED_AFTER = 0.1
"""Distance after which an image is kept [m]."""
_KEPT, _RETENTION_TIME = 16, 20.0
"""Images kept of each camera, and for how long [s]; odometry's drift is corrected, and what stands stays."""
_REUSED_FOR = 0.5
"""How long points are used again while the camera has moved less than :data:`_STORED_AFTER` [s]: hardly any parallax
has arisen, and what came or went is noticed soon enough."""
_NEAREST, _FARTHEST = 0.6, 8.0
"""Ranges that are sought [m]."""
_WINDOW = 5
"""Edge of the square that is matched [cells]."""
_CHANGE, _JUMP = 8 * _WINDOW**2, 32 * _WINDOW**2
"""Penalties of the matcher on displacements that change by one, and by more, between neighbours: those of its authors
(Hirschmüller 2008, in OpenCV's units)."""
_UNIQUE = 10
"""By how many percent the second best displacement has to be worse."""
_MATCHING_ERROR = 0.15
"""Standard deviation of where a window with plenty of texture is found in the other image [px]."""
_MISMATCHED, _LEAST_NOISE = 4.0, 1.0
"""Median differences of grey levels from which on cells are mismatched, and least noise of a grey level: its unit."""
_SUPPORT = 12.0
"""Windows whose texture tells a displacement: besides its own those before it on the matcher's five paths."""
_AGREEING = 3.0
"""Standard deviations within which the ranges of two baselines agree."""


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of surfaces that one camera measured, in the base frame."""

    origin: np.ndarray
    """Position of the camera ``[3]`` [m]."""
    points: np.ndarray
    """``[n, 3]`` [m]."""
    errors: np.ndarray
    """Standard deviation of each along its ray ``[n]`` [m]."""
    shared: np.ndarray
    """Its part that comes of the camera's motion and that all points share ``[n]`` [m]."""
    windows: np.ndarray
    """Share of a window's pixels that each stands for ``[n]``: the sum over points is the number of windows that were
    matched independently of each other."""


@dataclass(frozen=True)
class _Matches:
    """Ranges measured in cells of a pair of images."""

    pixels: np.ndarray
    """``[n, 2]`` of the newest image [px]."""
    directions: np.ndarray
    """``[n, 3]`` in axes of the newest camera."""
    ranges: np.ndarray
    """``[n]`` [m]."""
    errors: np.ndarray
    """``[n]`` [m]."""
    shared: np.ndarray
    """``[n]`` [m], see :class:`MeasuredPoints`."""
    windows: np.ndarray
    """See :class:`MeasuredPoints`."""


def matched(
    newest: PinholeImage, earlier: PinholeImage, pose: RelativePose, down: np.ndarray, height: float
) -> _Matches | None:
    """Ranges of what two images of a moving camera both show; None if they do not fit each other.

    Args:
        newest, earlier: the images.
        pose: odometry's relative pose.
        down: direction of gravity in axes of the newest camera ``[3]``.
        height: of the newest camera above the ground [m].
    """
    expected = EpipolarPair(newest, earlier, pose.rotation, pose.translation, down, _NEAREST)
    falls = expected.along(down)
    ground = np.where(falls > height / _FARTHEST, height / np.maximum(falls, 1e-6), _FARTHEST)
    corrected = refined(expected, expected.displacement(np.maximum(ground, _NEAREST)))
    if corrected is None:
        return None
    pair = EpipolarPair(newest, earlier, corrected.rotation, corrected.translation, down, _NEAREST)
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
        minDisparity=0, numDisparities=pair.displacements, blockSize=_WINDOW, P1=_CHANGE, P2=_JUMP, disp12MaxDiff=1,
        preFilterCap=31, uniquenessRatio=_UNIQUE, mode=cv2.STEREO_SGBM_MODE_SGBM,
    )  # fmt: skip
    displaced = matcher.compute(*pair.images)
    rows, columns = np.nonzero((displaced > 0) & pair.seen)
    # The matcher counts in sixteenths.
    displacement = displaced[rows, columns] / 16.0
    found = np.rint(columns - displacement).astype(int)
    # Where the earlier image does not show what is far away, something nearer would be found in its place.
    shown = pair.earlier_seen[rows, np.maximum(found, 0)] & (found >= 0) & pair.earlier_seen[rows, columns]
    rows, columns, displacement = rows[shown], columns[shown], displacement[shown]
    sine = np.sin(pair.phi[columns])
    pixels = (pair.step * sine / newest.pixel) ** 2
    # A window tells a displacement as well as its grey levels change along the row (the bound of Cramér and Rao);
    # where cells are smaller than pixels they repeat each other.
    slope = cv2.Sobel(pair.images[0], cv2.CV_32F, 1, 0, ksize=3, scale=1.0 / 8.0)
    energy = cv2.boxFilter(slope**2, -1, (_WINDOW, _WINDOW), normalize=False)[rows, columns] * np.minimum(1.0, pixels)
    noise = _grey_noise(pair, rows, columns, displacement)
    doubt = 2.0 * (noise * pair.step * sine) ** 2 / np.maximum(_SUPPORT * energy, 1e-6)
    ranges, change = pair.ranges(columns, displacement)
    turned = corrected.rotation_error**2 + (corrected.direction_error * pair.baseline / np.maximum(ranges, 0.1)) ** 2
    errors = change * np.sqrt((_MATCHING_ERROR * newest.pixel) ** 2 + doubt + turned)
    x, y = pair.places
    return _Matches(
        pixels=np.stack([x[rows, columns], y[rows, columns]], axis=1),
        directions=pair.directions(rows, columns),
        ranges=ranges,
        errors=errors,
        shared=change * np.sqrt(turned),
        windows=np.minimum(1.0, pixels) / _WINDOW**2 * np.maximum(1.0, pixels),
    )


def _grey_noise(pair: EpipolarPair, rows: np.ndarray, columns: np.ndarray, displacement: np.ndarray) -> float:
    """Standard deviation of a grey level, from the differences of matched cells ``[n]``: of the camera, of JPEG and of
    what the resampling leaves."""
    if not len(rows):
        return GREY_NOISE
    newest, earlier = pair.images
    places = (columns - displacement).astype(np.float32)[None], rows.astype(np.float32)[None]
    apart = newest[rows, columns] - cv2.remap(earlier, *places, cv2.INTER_LINEAR)[0].astype(np.float32)
    # Exposure may change between images.
    apart = np.abs(apart - np.median(apart))
    usual = apart[apart <= _MISMATCHED * max(float(np.median(apart)), 1.0)]
    return max(float(np.sqrt(np.mean(usual**2) / 2.0)), _LEAST_NOISE)


def confirmed(first: _Matches, second: _Matches, shape: tuple[int, int]) -> _Matches:
    """Those of the first matches to which the second ones, of another baseline, give the same range.

    Args:
        first, second: matches of one newest image.
        shape: its height and width [px].
    """
    size = shape[0] // 2 + 1, shape[1] // 2 + 1
    inverse, spread = np.full(size, np.nan), np.full(size, np.nan)
    column, row = (second.pixels / 2.0).astype(int).T
    inverse[row, column] = 1.0 / second.ranges
    spread[row, column] = second.errors / second.ranges**2
    column, row = (first.pixels / 2.0).astype(int).T
    with np.errstate(invalid="ignore"):
        apart = np.abs(inverse[row, column] - 1.0 / first.ranges)
        kept = apart < _AGREEING * np.hypot(spread[row, column], first.errors / first.ranges**2)
    return _Matches(*(getattr(first, name)[kept] for name in _Matches.__dataclass_fields__))


@dataclass(frozen=True)
class _Keyframe:
    """An image, and where it was taken."""

    stamp: int
    image: PinholeImage
    odometry_from_camera: np.ndarray

    def seconds_after(self, other: _Keyframe) -> float:
        """Time from another one to this one [s]."""
        return (self.stamp - other.stamp) * NANOSECOND


class MotionStereo:
    """Keeps images of each camera while the robot drives, and matches the newest one with two of them.

    A robot that has not moved measures nothing. One that stops has the images that it took on its way.
    """

    def __init__(self) -> None:
        self._kept: dict[str, deque[_Keyframe]] = {}
        self._measured: dict[str, tuple[_Keyframe, MeasuredPoints | None]] = {}
        """Where each camera measured last, and what, in the odometry frame."""
        self._models: dict[str, CameraModel] = {}
        self._previous: MotionState | None = None

    def points(self, observation: Observation, motion: MotionState, ground: float) -> list[MeasuredPoints]:
        """What the images of an observation and earlier ones tell, for each camera that measured something.

        Args:
            observation: images with their cameras; those without a calibration or pose are left out.
            motion: the robot's motion at the same time; calls come in order of time.
            ground: height of the ground under the robot in its terrain frame [m].
        """
        parts = []
        base_from_odometry = np.linalg.inv(motion.odometry_from_base)
        for name, newest, mounted in self._newest(observation, motion):
            last, seen = self._measured.get(name, (None, None))
            if last is None or _distance(last, newest) >= _STORED_AFTER or newest.seconds_after(last) >= _REUSED_FOR:
                found = _measured(newest, list(self._kept[name]), motion.terrain_from_base @ mounted, ground)
                seen = None
                if found is not None and len(found.ranges):
                    pose = newest.odometry_from_camera
                    points = transform_points(pose, found.directions * found.ranges[:, None])
                    seen = MeasuredPoints(pose[:3, 3], points, found.errors, found.shared, found.windows)
                self._measured[name] = newest, seen
            if seen is not None:
                origin, points = (transform_points(base_from_odometry, v) for v in (seen.origin[None], seen.points))
                parts.append(replace(seen, origin=origin[0], points=points))
            self._keep(name, newest)
        return parts

    def keep(self, observation: Observation, motion: MotionState) -> None:
        """Keep the images of an observation for later ones; calls come in order of time."""
        for name, newest, _ in self._newest(observation, motion):
            self._keep(name, newest)

    def _newest(self, observation: Observation, motion: MotionState) -> Iterator[tuple[str, _Keyframe, np.ndarray]]:
        """Each usable image with its camera's name and pose in the base frame; forgets what no longer fits it."""
        if self._previous is None or not continues(motion, self._previous):
            self._kept, self._measured = {}, {}
        self._previous = motion
        for name, image in observation.images.items():
            camera, mounted = observation.cameras.get(name), observation.base_from_cameras.get(name)
            if camera is None or mounted is None or image.shape[:2] != (camera.height, camera.width):
                continue
            if name in self._models and not self._models[name].same(camera):
                self._kept.pop(name, None)
                self._measured.pop(name, None)
            self._models[name] = camera
            kept = self._kept.setdefault(name, deque(maxlen=_KEPT))
            while kept and (motion.stamp - kept[0].stamp) * NANOSECOND > _RETENTION_TIME:
                kept.popleft()
            yield (
                name,
                _Keyframe(motion.stamp, pinhole_image(image, camera), motion.odometry_from_base @ mounted),
                mounted,
            )

    def _keep(self, name: str, newest: _Keyframe) -> None:
        kept = self._kept[name]
        if not kept or _distance(kept[-1], newest) >= _STORED_AFTER:
            kept.append(newest)


def _measured(
    newest: _Keyframe, kept: list[_Keyframe], terrain_from_camera: np.ndarray, ground: float
) -> _Matches | None:
    """Confirmed ranges of the newest image; None without two earlier ones far enough away, or if they do not fit it."""
    baselines = np.array([_distance(earlier, newest) for earlier in kept])
    usable = np.flatnonzero(baselines >= _SHORTEST)
    if len(usable) < 2:
        return None
    far = usable[np.argmin(np.abs(baselines[usable] - BASELINES[1]))]
    nearer = usable[baselines[usable] * _APART <= baselines[far]]
    if not len(nearer):
        return None
    near = nearer[np.argmin(np.abs(baselines[nearer] - 0.5 * baselines[far]))]
    down = terrain_from_camera[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    height = max(float(terrain_from_camera[2, 3]) - ground, 0.1)
    found = []
    for index in (far, near):
        moved = np.linalg.inv(kept[index].odometry_from_camera) @ newest.odometry_from_camera
        pose = RelativePose(moved[:3, :3], moved[:3, :3].T @ moved[:3, 3])
        try:
            matches = matched(newest.image, kept[index].image, pose, down, height)
        except ValueError:
            return None
        if matches is None:
            return None
        found.append(matches)
    return confirmed(found[0], found[1], newest.image.pixels.shape)


def _distance(first: _Keyframe, second: _Keyframe) -> float:
    """Distance of the cameras of two images [m]."""
    return float(np.linalg.norm(first.odometry_from_camera[:3, 3] - second.odometry_from_camera[:3, 3]))
