"""Sensors: camera, lidar and IMU of the simulated robot."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import cv2
import numpy as np

from monoforce_ros.synthetic import world
from monoforce_ros.synthetic.graphics import HOW_TO_DRAW, DrawingError, mujoco


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """A pinhole camera without distortion.

    Attributes:
        width: [pixels].
        height: [pixels].
        field_of_view: horizontal [rad].
        rate: images per second [Hz].
        quality: of the JPEG files, 1 to 100.
        oversampling: pixels drawn per pixel kept, along each side; drawing costs triangles more than pixels.
    """

    width: int = 320
    height: int = 240
    field_of_view: float = math.radians(85.0)
    rate: float = 10.0
    quality: int = 85
    oversampling: int = 2

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
        if not 1 <= self.oversampling <= 4:
            raise ValueError(f"camera oversampling: got {self.oversampling}, expected 1 to 4")

    @property
    def matrix(self) -> np.ndarray:
        """Camera matrix ``[3, 3]`` [pixels]; the centre of the first pixel is (0, 0)."""
        focal = self.width / 2 / math.tan(self.field_of_view / 2)
        return np.array([[focal, 0, (self.width - 1) / 2], [0, focal, (self.height - 1) / 2], [0, 0, 1]])

    @property
    def vertical_field_of_view(self) -> float:
        """[rad]."""
        return 2 * math.atan(self.height / 2 / self.matrix[1, 1])


class Camera:
    """Draws what one of the robot's cameras sees.

    Raises:
        DrawingError: no graphics library can draw.
    """

    def __init__(self, model: mujoco.MjModel, frame: str, settings: CameraSettings):
        self.frame = frame
        self.settings = settings
        # The camera hides what lies behind it, in a model of its own that the rays of a lidar do not see.
        self._model = copy.copy(model)
        self._groups = model.geom_group.copy()
        self._static = np.flatnonzero(model.geom_bodyid == 0)
        self._id = self._model.camera(frame).id
        width, height = settings.oversampling * settings.width, settings.oversampling * settings.height
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
        """The image ``[height, width, 3]`` uint8 RGB of the present state, whose kinematics are up to date."""
        self._hide_what_lies_behind(data)
        self._renderer.update_scene(data, self.frame, self._options)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_FOG] = 1
        for flag in ("SHADOW", "REFLECTION", "CULL_FACE"):
            flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        pixels = self._renderer.render()
        size = (self.settings.width, self.settings.height)
        return pixels if self.settings.oversampling == 1 else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

    def close(self) -> None:
        """Free the graphics library."""
        self._renderer.close()

    def _hide_what_lies_behind(self, data: mujoco.MjData) -> None:
        position, axes = data.cam_xpos[self._id], data.cam_xmat[self._id].reshape(3, 3)
        centres = data.geom_xpos[self._static] - position
        radii = self._model.geom_rbound[self._static]
        forward = -axes[:, 2]
        along = centres @ forward
        across = np.linalg.norm(centres - along[:, None] * forward, axis=1)
        # Outside the cone around the image's corners by more than the bounding sphere's radius.
        half_diagonal = math.atan(
            math.tan(self.settings.field_of_view / 2) * math.hypot(1, self.settings.height / self.settings.width)
        )
        outside = across * math.cos(half_diagonal) - along * math.sin(half_diagonal) > radii
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
    """A spinning lidar whose clouds are corrected for its own motion: all points of a turn belong to one instant.

    Attributes:
        rings: rays above each other.
        columns: rays around.
        lowest: angle of the lowest ring [rad].
        highest: angle of the highest ring [rad].
        minimum_range: [m].
        maximum_range: [m].
        rate: turns per second [Hz].
        range_noise: standard deviation [m].
        step: coordinates are rounded to this [m], as lidar drivers do.
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

    def scan(self, data: mujoco.MjData, base_pose: np.ndarray) -> np.ndarray:
        """Points ``[n, 3]`` float32 [m] in the lidar's frame, ring by ring; rays without an echo are left out.

        Args:
            data: the state, whose kinematics are up to date.
            base_pose: ``[4, 4]``, world ← base.
        """
        pose = base_pose @ self._pose
        count = len(self._rays)
        hits, ranges = np.empty(count, np.int32), np.empty(count)
        mujoco.mj_multiRay(
            self._model, data, pose[:3, 3].copy(), (self._rays @ pose[:3, :3].T).ravel(), self._groups, True, -1,
            hits, ranges, None, count, self.settings.maximum_range,
        )  # fmt: skip
        noise = self._random.normal(0.0, self.settings.range_noise, count)
        echo = (ranges >= self.settings.minimum_range) & (ranges <= self.settings.maximum_range)
        points = self._rays[echo] * (ranges + noise)[echo, None]
        if self.settings.step > 0.0:
            points = np.round(points / self.settings.step) * self.settings.step
        return points.astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class ImuSettings:
    """An inertial unit without bias.

    Attributes:
        rate: [Hz].
        acceleration_noise: standard deviation [m/s²].
        rate_noise: standard deviation of the turning rate [rad/s].
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
    """Averages specific force and turning rate since its last reading, as real units do."""

    def __init__(self, settings: ImuSettings, random: np.random.Generator):
        self.settings = settings
        self._random = random
        self._sum = np.zeros(6)
        self._count = 0

    def add(self, data: mujoco.MjData) -> None:
        """Take in a simulation step."""
        self._sum += data.sensordata[:6]
        self._count += 1

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Turning rate ``[3]`` [rad/s] and specific force ``[3]`` [m/s²] in the IMU's frame since the last reading."""
        mean = self._sum / max(self._count, 1)
        self._sum, self._count = np.zeros(6), 0
        turning = mean[3:] + self._random.normal(0.0, self.settings.rate_noise, 3)
        return turning, mean[:3] + self._random.normal(0.0, self.settings.acceleration_noise, 3)
