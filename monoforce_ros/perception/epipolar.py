"""Epipolar pair: two images of a moving camera, resampled so that a point differs by its parallax alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from monoforce_ros.core import CameraModel

_EDGE = 320
"""Longest edge of the images that are matched [px]."""
_CELLS = 24_000
"""Most cells of a resampled image, about a third of the image's pixels: the time of matching is in proportion."""
_BORDER = 3
"""Pixels beside the edge of what a lens shows that are left out: half a window."""
_NEAR_AXIS = 10.0
"""Distance from the direction of motion within which parallax places no obstacle, and a third of all cells would lie
[px]."""
_SIDEWAYS = math.radians(120.0)
"""Greatest angle from straight down about the direction of motion [rad], if that lies in the image: what is above it is
above the camera, and has its foot below."""
_IN_FRONT = 0.05
"""Least cosine of the angle between a ray and the optical axis: 87°."""


@dataclass(frozen=True)
class PinholeImage:
    """A grey image without distortion."""

    pixels: np.ndarray
    """``[height, width]`` uint8."""
    seen: np.ndarray
    """255 where the lens shows something, 0 elsewhere, uint8 ``[height, width]``."""
    matrix: np.ndarray
    """Camera matrix ``[3, 3]`` [px]."""

    @property
    def pixel(self) -> float:
        """Angle of a pixel on the optical axis [rad]."""
        return float(1.0 / self.matrix[0, 0])


def pinhole_image(image: np.ndarray, camera: CameraModel) -> PinholeImage:
    """An image ``[height, width, 3]`` uint8 as a smaller grey one, as a camera of the same matrix without distortion
    would see it; what that leaves out of a fisheye's image lies more than 60° off its axis."""
    scale = min(1.0, _EDGE / max(camera.width, camera.height))
    size = max(16, round(camera.width * scale)), max(16, round(camera.height * scale))
    small = image if size == (camera.width, camera.height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(np.ascontiguousarray(small), cv2.COLOR_RGB2GRAY)
    resized = camera.resized(*size)
    bends = camera.is_distorted or camera.distortion_model == "equidistant" or camera.matrix[0, 1] != 0.0
    if not bends:
        return PinholeImage(grey, np.full(grey.shape, 255, np.uint8), resized.matrix)
    key = (resized.matrix.tobytes(), np.asarray(resized.distortion, np.float64).tobytes(), resized.distortion_model)
    matrix, places, seen = _undistortion(*size, *key)
    return PinholeImage(cv2.remap(grey, places[..., 0], places[..., 1], cv2.INTER_LINEAR), seen, matrix)


@lru_cache(maxsize=32)
def _undistortion(
    width: int, height: int, matrix: bytes, distortion: bytes, model: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix of the pinhole camera, where its pixels lie in the image ``[height, width, 2]``, and which it shows."""
    camera = CameraModel(width, height, np.frombuffer(matrix).reshape(3, 3), np.frombuffer(distortion), model)
    straight = camera.matrix.copy()
    straight[0, 1] = 0.0
    x, y = np.meshgrid((np.arange(width) - straight[0, 2]) / straight[0, 0],
                       (np.arange(height) - straight[1, 2]) / straight[1, 1])  # fmt: skip
    pixels, inside = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    places = np.where(inside[:, None], pixels, -10.0).astype(np.float32).reshape(height, width, 2)
    return straight, places, (255 * inside.reshape(height, width)).astype(np.uint8)


class EpipolarPair:
    """The newest image and an earlier one over angles about the direction of motion.

    Rows are angles θ about that direction, columns are u = ln tan(φ / 2) of the angle φ from it: Mercator's projection
    of the sphere with its poles in the direction of motion. It keeps angles, so that windows keep their shape, and a
    point at the range ρ is displaced by about baseline / ρ along a row, wherever in the image it is. A surface across
    the way has one displacement in the middle of the image and at its edge, and what comes nearer does not grow: scale
    is a displacement, too.

    Args:
        newest, earlier: the images.
        rotation: ``[3, 3]``, axes of the earlier camera ← axes of the newest.
        translation: from the earlier camera to the newest one in axes of the newest ``[3]`` [m].
        down: direction of gravity in these axes ``[3]``; rows begin and end opposite to it.
        nearest: least range that displacements allow for [m].

    Raises:
        ValueError: the camera sees no direction in which there is a parallax.
    """

    def __init__(
        self,
        newest: PinholeImage,
        earlier: PinholeImage,
        rotation: np.ndarray,
        translation: np.ndarray,
        down: np.ndarray,
        nearest: float,
    ):
        self.newest, self.earlier, self.rotation = newest, earlier, rotation
        self.baseline = float(np.linalg.norm(translation))
        """Distance of the two cameras [m]."""
        self.axes = _axes(translation / self.baseline, down)
        """Directions of θ = 0, of θ = 90° and of the motion in axes of the newest camera ``[3, 3]``, by rows."""
        low, high, first, last = self._bounds()
        self.step = max(newest.pixel, math.sqrt((high - low) * (last - first) / _CELLS))
        """Edge of a cell in θ and u."""
        reach = math.log1p(self.baseline / nearest) / self.step
        self.displacements = int(np.clip(16 * math.ceil(reach / 16), 16, 96))
        """Number of displacements that are tried, a multiple of 16."""
        # The matcher leaves out as many columns at the left.
        self.u = np.arange(low - self.displacements * self.step, high, self.step)
        self.theta = np.arange(first, last, self.step)
        self.phi = 2.0 * np.arctan(np.exp(self.u))
        self._sine, self._cosine = np.sin(self.phi), np.cos(self.phi)
        self.places = self._places(newest, np.eye(3))
        """Pixels of the newest image, x and y, each ``[rows, columns]`` float32."""
        earlier_places = self._places(earlier, rotation)
        self.images = tuple(
            cv2.remap(image.pixels, *places, cv2.INTER_LINEAR)
            for image, places in ((newest, self.places), (earlier, earlier_places))
        )
        """The newest and the earlier image, resampled, uint8 ``[rows, columns]``."""
        self.seen = _shown(newest, self.places)
        """Whether a cell of the newest image can be matched (bool)."""
        self.seen[:, : self.displacements] = False
        self.earlier_seen = _shown(earlier, earlier_places)

    def _bounds(self) -> tuple[float, float, float, float]:
        """Least and largest u and θ that the newest image contains."""
        height, width = self.newest.pixels.shape
        matrix = self.newest.matrix
        x, y = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 13))
        shown = self.newest.seen[np.rint(y).astype(int), np.rint(x).astype(int)] > 0
        if not shown.any():
            raise ValueError("the camera's lens shows nothing")
        rays = np.stack([(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones_like(x)], -1)
        directions = rays[shown] / np.linalg.norm(rays[shown], axis=1, keepdims=True) @ self.axes.T
        theta = np.arctan2(directions[:, 1], directions[:, 0])
        margin = _NEAR_AXIS * self.newest.pixel
        phi = np.clip(np.arccos(np.clip(directions[:, 2], -1.0, 1.0)), margin, math.pi - margin)
        low, high = float(phi.min()), float(phi.max())
        first, last = float(theta.min()), float(theta.max())
        axis = matrix @ self.axes[2]
        if abs(axis[2]) > 1e-6:
            place = axis[:2] / axis[2]
            if (place >= 0.0).all() and (place < [width, height]).all():
                # The direction of motion, or the opposite one, lies in the image.
                first, last = -_SIDEWAYS, _SIDEWAYS
                low, high = (margin, high) if axis[2] > 0.0 else (low, math.pi - margin)
        if not (high > low and last > first):
            raise ValueError("the camera sees no direction with a parallax")
        return math.log(math.tan(low / 2)), math.log(math.tan(high / 2)), first, last

    def _places(self, image: PinholeImage, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels x and y of all cells in an image, each ``[rows, columns]`` float32; far outside where it has none."""
        x, y, depth = (self.along(row) for row in image.matrix @ rotation)
        ahead = depth > _IN_FRONT
        scale = 1.0 / np.where(ahead, depth, 1.0)
        return np.where(ahead, x * scale, -100.0), np.where(ahead, y * scale, -100.0)

    def along(self, vector: np.ndarray) -> np.ndarray:
        """Component of all cells' unit vectors along a vector ``[3]`` in axes of the newest camera, ``[rows, columns]``
        float32."""
        first, second, third = (self.axes @ vector).tolist()
        across = (first * np.cos(self.theta) + second * np.sin(self.theta)).astype(np.float32)
        return np.outer(across, self._sine.astype(np.float32)) + (third * self._cosine).astype(np.float32)

    def directions(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Unit vectors ``[n, 3]`` towards cells ``[n]`` in axes of the newest camera."""
        theta, sine = self.theta[rows], self._sine[columns]
        own = np.stack([sine * np.cos(theta), sine * np.sin(theta), self._cosine[columns]], axis=1)
        return own @ self.axes

    def ranges(self, columns: np.ndarray, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Range of cells ``[n]`` displaced by ``[n]`` cells, and by how much it changes with the angle at which the
        earlier camera saw them [m], [m/rad].

        In the triangle of the two cameras and the point the angles are φ' at the earlier camera and φ - φ' at the
        point: ρ = b sin φ' / sin(φ - φ'), and dρ / dφ' = b sin φ / sin²(φ - φ').
        """
        earlier = 2.0 * np.arctan(np.exp(self.u[columns] - displacement * self.step))
        parallax = np.maximum(np.sin(self.phi[columns] - earlier), 1e-9)
        return (
            self.baseline * np.sin(earlier) / parallax,
            self.baseline * self._sine[columns] / parallax**2,
        )

    def displacement(self, ranges: np.ndarray) -> np.ndarray:
        """Displacement of points at ranges ``[rows, columns]`` [m], in cells."""
        # ln tan(φ' / 2) = -arsinh(cot φ'), and cot φ' is the distance along the motion over that across it.
        cot = (self._cosine / self._sine).astype(np.float32) + np.float32(self.baseline) / (
            ranges * self._sine.astype(np.float32)
        )
        return (self.u.astype(np.float32) + np.arcsinh(cot)) / np.float32(self.step)


def _axes(motion: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Right-handed axes ``[3, 3]`` by rows: as far down as possible, its perpendicular, and the direction of motion."""
    first = down - (down @ motion) * motion
    if np.linalg.norm(first) < 1e-3:  # straight up or down
        first = np.cross(motion, [1.0, 0.0, 0.0] if abs(motion[0]) < 0.7 else [0.0, 1.0, 0.0])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(motion, first), motion])


def _shown(image: PinholeImage, places: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Cells whose pixels, and those around them, the lens shows (bool)."""
    x, y = places
    height, width = image.pixels.shape
    inside = (x > _BORDER) & (x < width - 1 - _BORDER) & (y > _BORDER) & (y < height - 1 - _BORDER)
    if image.seen.all():
        return inside
    eroded = cv2.erode(image.seen, np.ones((2 * _BORDER + 1, 2 * _BORDER + 1), np.uint8))
    return inside & (cv2.remap(eroded, x, y, cv2.INTER_NEAREST) > 0)
