"""Sensors: camera, lidar and IMU of the simulated robot."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from monoforce_ros.synthetic import world
from monoforce_ros.synthetic.graphics import HOW_TO_DRAW, DrawingError, mujoco

# Coefficients by distortion model, in the order of sensor_msgs/CameraInfo.
_COEFFICIENTS = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
_NUMBERS = {4: "four", 5: "five", 8: "eight"}
_LARGEST_SLOPE = 4.0
"""Largest x / z of a pixel's ray: the image is rendered by a pinhole camera."""
_WIDEST_DRAWN = 1.4
"""Largest edge of a fisheye's rendered image, relative to the image."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """A camera with optional lens distortion.

    Attributes:
        width: width of the image [pixels].
        height: height of the image [pixels].
        field_of_view: horizontal field of view [rad].
        rate: images per second [Hz].
        quality: quality of the JPEG files, 1 to 100.
        distortion: coefficients of the distortion model: k1, k2, p1, p2, k3 of ``plumb_bob``, also k4, k5, k6 of
            ``rational_polynomial``, or k1 to k4 of ``equidistant``; empty for none.
        distortion_model: one of :data:`monoforce_ros.core.DISTORTION_MODELS`.
        oversampling: rendered pixels per image pixel along each side, for anti-aliasing; 0 selects 2 for images up to
            400 pixels wide and 1 for larger ones.
    """

    width: int = 320
    height: int = 240
    field_of_view: float = math.radians(85.0)
    rate: float = 10.0
    quality: int = 85
    distortion: tuple[float, ...] = ()
    oversampling: int = 0
    distortion_model: str = "plumb_bob"

    def __post_init__(self):
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 4096:
                raise ValueError(f"camera {name}: got {getattr(self, name)}, expected 16 to 4096 pixels")
        if not math.radians(10) <= self.field_of_view <= math.radians(150):
            raise ValueError(f"camera field_of_view: got {self.field_of_view}, expected 0.175 to 2.618 rad")
        if not 0.1 <= self.rate <= 100.0:
            raise ValueError(f"camera rate: got {self.rate}, expected 0.1 to 100 Hz")
        if not 1 <= self.quality <= 100:
            raise ValueError(f"camera quality: got {self.quality}, expected 1 to 100")
        if self.oversampling == 0:
            object.__setattr__(self, "oversampling", 2 if self.width <= 400 else 1)
        if not 1 <= self.oversampling <= 4:
            raise ValueError(f"camera oversampling: got {self.oversampling}, expected 1 to 4")
        if self.distortion_model not in _COEFFICIENTS:
            raise ValueError(
                f"camera distortion_model: got {self.distortion_model!r}, expected one of {', '.join(_COEFFICIENTS)}"
            )
        names = _COEFFICIENTS[self.distortion_model]
        if len(self.distortion) not in (0, len(names)) or not all(abs(value) <= 1.0 for value in self.distortion):
            raise ValueError(
                f"camera distortion: got {self.distortion}, expected {_NUMBERS[len(names)]} numbers {', '.join(names)}"
            )
        if self.distortion:
            self._check_distortion()

    @property
    def matrix(self) -> np.ndarray:
        """Camera matrix ``[3, 3]`` [pixels]; the centre of the first pixel is (0, 0).

        The field of view is that of the lens without the distortion's coefficients: of a pinhole, or of an ideal
        equidistant fisheye.
        """
        half = self.field_of_view / 2
        focal = self.width / 2 / (half if self._is_fisheye else math.tan(half))
        return np.array([[focal, 0, (self.width - 1) / 2], [0, focal, (self.height - 1) / 2], [0, 0, 1]])

    @property
    def drawn_size(self) -> tuple[int, int]:
        """Width and height [pixels] of the rendered image, which has no distortion."""
        size = np.array([self.width, self.height])
        if self.distortion:
            reach = np.nanmax(np.abs(self._rays()).reshape(-1, 2), axis=0)
            size = 2 * np.ceil(reach * self._drawn_focal).astype(int) + 2
        width, height = self.oversampling * size
        return int(width), int(height)

    @property
    def vertical_field_of_view(self) -> float:
        """Of the rendered image [rad]."""
        return 2 * math.atan(self.drawn_size[1] / self.oversampling / 2 / self._drawn_focal)

    @property
    def horizontal_field_of_view(self) -> float:
        """Angle between the rays of the outermost pixels of the middle row [rad]."""
        if not self.distortion:
            return self.field_of_view
        slopes = self._rays()[self.height // 2, :, 0]
        return float(math.atan(np.nanmax(slopes)) - math.atan(np.nanmin(slopes)))

    def drawn_pixels(self) -> np.ndarray | None:
        """Where each pixel lies in the rendered image, ``[height, width, 2]`` float32; None without distortion.

        Pixels outside the lens' circle lie outside the rendered image.
        """
        if not self.distortion:
            return None
        middle = (np.array(self.drawn_size) - 1) / 2
        places = self._rays() * self._drawn_focal * self.oversampling + middle
        return np.nan_to_num(places, nan=-10.0).astype(np.float32)

    @property
    def _is_fisheye(self) -> bool:
        return self.distortion_model == "equidistant"

    @property
    def _drawn_focal(self) -> float:
        """Focal length of the rendered image [pixels]; a wide lens is rendered with fewer pixels in its middle."""
        focal = float(self.matrix[0, 0])
        if not self._is_fisheye:
            return focal
        reach = np.nanmax(np.abs(self._rays()).reshape(-1, 2), axis=0)
        return min(focal, _WIDEST_DRAWN * min(self.width / 2 / reach[0], self.height / 2 / reach[1]))

    def _rays(self) -> np.ndarray:
        """Direction x / z, y / z of each pixel, ``[height, width, 2]``; NaN outside a fisheye's circle."""
        columns, rows = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
        if self._is_fisheye:
            rays = cv2.fisheye.undistortPoints(pixels, self.matrix, np.array(self.distortion))
            # A pinhole camera renders no wider cone: the image is black beyond it, like outside a real lens' circle.
            outward = (rays * (pixels - self.matrix[:2, 2])).sum(axis=-1, keepdims=True) >= 0.0
            rays = np.where(outward & (np.abs(rays).max(axis=-1, keepdims=True) < _LARGEST_SLOPE), rays, np.nan)
        else:
            rays = cv2.undistortPoints(pixels, self.matrix, np.array(self.distortion))
        return rays.reshape(self.height, self.width, 2)

    def _check_distortion(self) -> None:
        rays = self._rays()
        points = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1).reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if self._is_fisheye else cv2.projectPoints
        back, _ = project(points, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
        rows, columns = np.mgrid[: self.height, : self.width]
        error = np.nanmax(np.abs(back.reshape(self.height, self.width, 2) - np.stack([columns, rows], axis=-1)))
        if not error < 0.2 or np.nanmax(np.abs(rays)) > _LARGEST_SLOPE:
            raise ValueError(
                f"camera distortion: got {self.distortion}, which folds the image; expected a weaker distortion"
            )


class Camera:
    """Renders the images of one of the robot's cameras.

    Args:
        model: the world.
        frame: name of the camera in it.
        settings: resolution, lens and rate.
        imaging: what the camera does to a perfect image ``[height, width, 3]`` uint8; None for nothing.

    Raises:
        DrawingError: no graphics library can render.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        frame: str,
        settings: CameraSettings,
        imaging: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self.frame = frame
        self.settings = settings
        self._imaging = imaging
        # A copy of the model, in which geometry outside the view is hidden without affecting the lidar.
        self._model = copy.copy(model)
        self._groups = model.geom_group.copy()
        self._static = np.flatnonzero(model.geom_bodyid == 0)
        self._id = self._model.camera(frame).id
        width, height = settings.drawn_size
        self._size = width, height
        self._pixels = settings.drawn_pixels()
        upright = math.tan(settings.vertical_field_of_view / 2)
        self._half_diagonal = math.atan(math.hypot(width, height) / height * upright)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        if not hasattr(mujoco, "GLContext"):
            raise DrawingError(f"no graphics library for camera images was found; {HOW_TO_DRAW}")
        try:
            self._renderer = mujoco.Renderer(self._model, height, width, max_geom=model.ngeom + 100)
        except Exception as error:
            raise DrawingError(f"the graphics library cannot draw camera images ({error}); {HOW_TO_DRAW}") from error
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[list(world.DRAWN_GROUPS)] = 1

    def capture(self, data: mujoco.MjData) -> np.ndarray:
        """RGB image ``[height, width, 3]`` uint8 of a state whose kinematics are up to date."""
        pixels = self._rendered(data)
        return pixels if self._imaging is None else self._imaging(pixels)

    def _rendered(self, data: mujoco.MjData) -> np.ndarray:
        self._hide_outside_view(data)
        self._renderer.update_scene(data, self.frame, self._options)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_FOG] = 1
        for flag in ("SHADOW", "REFLECTION", "CULL_FACE"):
            flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        pixels = self._renderer.render()
        size = (self.settings.width, self.settings.height)
        if self._pixels is not None:
            # The stubs do not know that the second map may be None.
            return cv2.remap(pixels, self._pixels, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        return pixels if self.settings.oversampling == 1 else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

    def close(self) -> None:
        """Free the graphics library."""
        self._renderer.close()

    def _hide_outside_view(self, data: mujoco.MjData) -> None:
        position, axes = data.cam_xpos[self._id], data.cam_xmat[self._id].reshape(3, 3)
        centres = data.geom_xpos[self._static] - position
        radii = self._model.geom_rbound[self._static]
        forward = -axes[:, 2]
        along = centres @ forward
        across = np.linalg.norm(centres - along[:, None] * forward, axis=1)
        # Outside the cone around the image's corners by more than the bounding sphere's radius.
        outside = across * math.cos(self._half_diagonal) - along * math.sin(self._half_diagonal) > radii
        groups = self._groups.copy()
        groups[self._static[outside]] = world.COLLISION_GROUND_GROUP
        self._model.geom_group[:] = groups


def encode_jpeg(pixels: np.ndarray, quality: int) -> bytes:
    """JPEG file of an RGB image ``[height, width, 3]`` uint8."""
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise DrawingError("OpenCV could not encode a JPEG image")
    return data.tobytes()


@dataclass(frozen=True, kw_only=True)
class LidarSettings:
    """A spinning lidar with motion-compensated clouds: all points of a revolution are measured at one instant.

    Attributes:
        rings: number of rings.
        columns: rays per ring.
        lowest: angle of the lowest ring [rad].
        highest: angle of the highest ring [rad].
        minimum_range: [m].
        maximum_range: [m].
        rate: revolutions per second [Hz].
        range_noise: standard deviation [m].
        step: resolution of the coordinates [m].
    """

    rings: int = 16
    columns: int = 360
    lowest: float = math.radians(-35.0)
    highest: float = math.radians(15.0)
    minimum_range: float = 0.5
    maximum_range: float = 20.0
    rate: float = 5.0
    range_noise: float = 0.008
    step: float = 1.0 / 1024.0

    def __post_init__(self):
        if not 1 <= self.rings <= 256:
            raise ValueError(f"lidar rings: got {self.rings}, expected 1 to 256")
        if not 4 <= self.columns <= 4096:
            raise ValueError(f"lidar columns: got {self.columns}, expected 4 to 4096")
        if not -math.pi / 2 <= self.lowest <= self.highest <= math.pi / 2:
            raise ValueError(f"lidar lowest, highest: got {self.lowest}, {self.highest}, expected ascending angles")
        if not 0.0 <= self.minimum_range < self.maximum_range:
            raise ValueError(
                f"lidar minimum_range, maximum_range: got {self.minimum_range}, {self.maximum_range}, "
                "expected ascending distances"
            )
        if not 0.1 <= self.rate <= 50.0:
            raise ValueError(f"lidar rate: got {self.rate}, expected 0.1 to 50 Hz")
        for name in ("range_noise", "step"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"lidar {name}: got {getattr(self, name)}, expected 0 to 1 m")


class Lidar:
    """Casts rays from a sensor frame at ground, rocks, trees and grass."""

    def __init__(self, model: mujoco.MjModel, pose: np.ndarray, settings: LidarSettings, random: np.random.Generator):
        self.settings = settings
        self._model = model
        self._pose = pose
        self._random = random
        rise = np.linspace(settings.lowest, settings.highest, settings.rings)[:, None]
        turn = np.arange(settings.columns) / settings.columns * 2 * math.pi
        rays = [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise) + 0.0 * turn]
        self._rays = np.stack(rays, axis=-1).reshape(-1, 3)
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[list(world.RAY_GROUPS)] = 1
        # Ray casting uses scratch memory of the state, so each thread has its own.
        self._states = (mujoco.MjData(model), mujoco.MjData(model))
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="lidar")

    def scan(self, data: mujoco.MjData, base_pose: np.ndarray) -> np.ndarray:
        """Points ``[n, 3]`` float32 [m] in the lidar's frame, ring by ring; rays without an echo are left out.

        See :meth:`start`.
        """
        return self.start(data, base_pose)()

    def start(self, data: mujoco.MjData, base_pose: np.ndarray) -> Callable[[], np.ndarray]:
        """Begin a scan in other threads; calling the result waits for the points.

        Args:
            data: the state, whose kinematics are up to date.
            base_pose: ``[4, 4]``, world ← base.
        """
        pose = base_pose @ self._pose
        rays = self._rays @ pose[:3, :3].T
        count = len(rays)
        ranges = np.empty(count)
        for state in self._states:
            mujoco.mj_copyData(state, self._model, data)

        def cast(part: tuple[mujoco.MjData, slice]) -> None:
            state, rows = part
            hits, found = np.empty(rows.stop - rows.start, np.int32), np.empty(rows.stop - rows.start)
            mujoco.mj_multiRay(
                self._model, state, pose[:3, 3].copy(), rays[rows].ravel(), self._groups, True, -1, hits, found, None,
                len(found), self.settings.maximum_range,
            )  # fmt: skip
            ranges[rows] = found

        parts = (slice(0, count // 2), slice(count // 2, count))
        jobs = [self._threads.submit(cast, part) for part in zip(self._states, parts, strict=True)]

        def points() -> np.ndarray:
            for job in jobs:
                job.result()
            return self._points(ranges)

        return points

    def _points(self, ranges: np.ndarray) -> np.ndarray:
        """Points ``[n, 3]`` of the rays' ranges ``[rays]``."""
        count = len(ranges)
        noise = self._random.normal(0.0, self.settings.range_noise, count)
        echo = (ranges >= self.settings.minimum_range) & (ranges <= self.settings.maximum_range)
        points = self._rays[echo] * (ranges + noise)[echo, None]
        if self.settings.step > 0.0:
            points = np.round(points / self.settings.step) * self.settings.step
        return points.astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class ImuSettings:
    """An IMU without bias.

    Attributes:
        rate: [Hz].
        acceleration_noise: standard deviation [m/s²].
        rate_noise: standard deviation of the angular velocity [rad/s].
    """

    rate: float = 100.0
    acceleration_noise: float = 0.03
    rate_noise: float = 0.002

    def __post_init__(self):
        if not 1.0 <= self.rate <= 1.0 / world.TIME_STEP:
            raise ValueError(f"IMU rate: got {self.rate}, expected 1 to {1.0 / world.TIME_STEP:g} Hz")
        for name in ("acceleration_noise", "rate_noise"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"IMU {name}: got {getattr(self, name)}, expected 0 or more")


class Imu:
    """Averages specific force and angular velocity between readings, as real IMUs do."""

    def __init__(self, settings: ImuSettings, random: np.random.Generator):
        self.settings = settings
        self._random = random
        self._sum = np.zeros(6)
        self._count = 0

    def add(self, data: mujoco.MjData) -> None:
        """Accumulate a simulation step."""
        self._sum += data.sensordata[:6]
        self._count += 1

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean angular velocity ``[3]`` [rad/s] and specific force ``[3]`` [m/s²] since the last reading, IMU frame."""
        mean = self._sum / max(self._count, 1)
        self._sum, self._count = np.zeros(6), 0
        turning = mean[3:] + self._random.normal(0.0, self.settings.rate_noise, 3)
        return turning, mean[:3] + self._random.normal(0.0, self.settings.acceleration_noise, 3)
