"""CameraModel: a calibrated camera that projects points to pixels and pixels to rays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of a camera as in ``sensor_msgs/CameraInfo`` (before rectification).

    ``plumb_bob`` and ``rational_polynomial`` are OpenCV's model with 4, 5, 8, 12 or 14 coefficients, ``equidistant`` is
    its fisheye model. Camera axes: z forward, x right, y down (REP 103).
    """

    width: int
    height: int
    matrix: np.ndarray
    """Camera matrix K ``[3, 3]`` [px]."""
    distortion: np.ndarray
    """Distortion coefficients ``[n]``."""
    distortion_model: str = "plumb_bob"
    frame_id: str = ""

    def __post_init__(self):
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size: got {self.width} × {self.height}, expected at least one pixel")
        if self.matrix.shape != (3, 3) or not np.isfinite(self.matrix).all():
            raise ValueError(f"camera matrix: got {self.matrix.tolist()}, expected 3 × 3 finite numbers")
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0:
            raise ValueError(
                f"camera matrix: got focal lengths {self.matrix[0, 0]:g} and {self.matrix[1, 1]:g} px, expected "
                "positive ones: the camera is not calibrated (CameraInfo with K = 0)"
            )
        if self.distortion_model not in DISTORTION_MODELS:
            raise ValueError(f"distortion model: got {self.distortion_model!r}, expected one of {DISTORTION_MODELS}")
        if self.distortion.size not in (0, 4, 5, 8, 12, 14) or not np.isfinite(self.distortion).all():
            raise ValueError(
                f"distortion: got {self.distortion.tolist()}, expected 0, 4, 5, 8, 12 or 14 finite coefficients"
            )

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return bool(np.any(self.distortion != 0.0))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of points in the camera frame.

        Args:
            points: ``[n, 3]`` [m].

        Returns:
            pixels ``[n, 2]`` (u, v) and a mask ``[n]`` of the points that lie in front of the camera and inside the
            image. Pixels of masked-out points are NaN.
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        pixels = np.full((len(points), 2), np.nan)
        # Far outside the field of view the distortion polynomial folds back into the image, so only points within the
        # angle of the image's corners are projected.
        visible = (points[:, 2] > 0.05) & (self._slope(points) <= self._corner_slope() * 1.05)
        if visible.any():
            zero = np.zeros(3)
            if self.distortion_model == "equidistant":
                projected, _ = cv2.fisheye.projectPoints(
                    points[visible][:, None], zero, zero, self.matrix, self._fisheye()
                )
            else:
                projected, _ = cv2.projectPoints(points[visible][:, None], zero, zero, self.matrix, self.distortion)
            pixels[visible] = projected.reshape(-1, 2)
        inside = (pixels >= -0.5).all(axis=1) & (pixels[:, 0] < self.width - 0.5) & (pixels[:, 1] < self.height - 0.5)
        pixels[~inside] = np.nan
        return pixels, inside

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Undistorted ray directions of pixels in the camera frame.

        Args:
            pixels: ``[..., 2]`` (u, v); the centre of the first pixel is (0, 0).

        Returns:
            ``[..., 3]`` with z = 1, so that a ray times a depth is a point.
        """
        pixels = np.asarray(pixels, np.float64)
        flat = pixels.reshape(-1, 1, 2)
        if not self.is_distorted and self.distortion_model != "equidistant":
            normalised = (flat[:, 0] - self.matrix[:2, 2]) / np.array([self.matrix[0, 0], self.matrix[1, 1]])
        elif self.distortion_model == "equidistant":
            normalised = cv2.fisheye.undistortPoints(flat, self.matrix, self._fisheye())[:, 0]
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
            # The function with termination criteria has different names in OpenCV 4 and 5.
            undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
            normalised = undistort(flat, self.matrix, self.distortion, R=None, P=None, criteria=criteria)[:, 0]
        return np.concatenate([normalised, np.ones((len(normalised), 1))], axis=1).reshape(*pixels.shape[:-1], 3)

    def resized(self, width: int, height: int) -> CameraModel:
        """The camera after resizing its image to ``width`` × ``height`` pixels (pixel centres kept aligned)."""
        scale = np.array([width / self.width, height / self.height])
        matrix = self.matrix.copy()
        matrix[0, 0] *= scale[0]
        matrix[1, 1] *= scale[1]
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
        return CameraModel(width, height, matrix, self.distortion, self.distortion_model, self.frame_id)

    def _fisheye(self) -> np.ndarray:
        return self.distortion[:4] if self.distortion.size else np.zeros(4)

    @staticmethod
    def _slope(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[:, :2], axis=1) / np.maximum(points[:, 2], 1e-9)

    def _corner_slope(self) -> float:
        u, v = self.width - 1, self.height - 1
        border = np.array([[0, 0], [u, 0], [0, v], [u, v], [u / 2, 0], [u / 2, v], [0, v / 2], [u, v / 2]], float)
        slopes = self._slope(self.rays(border))
        return float(slopes[np.isfinite(slopes)].max(initial=0.1))
