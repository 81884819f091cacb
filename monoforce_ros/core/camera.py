"""CameraModel: a calibrated camera that projects points to pixels and pixels to rays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_MOST_OBLIQUE = np.tan(np.radians(80.0))
"""Slope of a ray that a perspective image without fisheye can begin at: beyond it a pixel spans several degrees."""
_SAME_PIXEL = 2.0
"""Largest distance [px] between a pixel and the projection of its own ray."""
_MOST_DISTORTED = 10.0
"""Largest factor by which distortion may move a pixel away from the centre or towards it: at half of a field of view of
160°, a perspective image is 4 times as far from its centre as that of an equidistant lens."""
_CONSISTENT = 0.5
"""Smallest share of the image, or of 60° of a fisheye, in which pixels and rays have to agree: calibrations fit the
centre, and a polynomial may fold in the corners of a wide lens."""
_WIDEST_RAY, _FISHEYE_STEPS = np.radians(80.0), 1601
"""Angle off a fisheye's axis up to which its pixels have rays: beyond, a lens shows nothing that a map could use; and
the number of angles at which its polynomial is tabulated."""
_FISHEYE_ANGLE = np.radians(60.0)
_OFF_CENTRE = 0.15
"""Share of both edges by which a principal point is off the middle if the matrix is that of an image of another size:
lenses are mounted to a few per cent of the edge, and common sizes are at least 4/3 of each other."""
_MOUNTED = 0.06
"""Difference of both shares that lenses off the middle by a few per cent of each edge may make."""
_FAR_OFF = 0.35
"""Share of an edge by which the axis of a region is off its middle if it lies in a corner of the region."""
_MOST_OBLONG = 3.0
"""Largest ratio of the focal lengths in pixels: a binned or anamorphic image is up to twice as wide."""
_SHORTEST, _LONGEST = 0.05, 60.0
"""Focal length over the image's shorter and longer edge: fields of view of 169° and 1° for a perspective camera; a
circular fisheye of 220° has about 0.25."""


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
        # Some drivers pad the four coefficients with zeros.
        if self.distortion_model == "equidistant" and np.any(self.distortion[4:] != 0.0):
            raise ValueError(
                f"distortion: got {self.distortion.tolist()} with distortion model 'equidistant', expected 4 "
                "coefficients: are they of another model?"
            )

    @property
    def _skew(self) -> float:
        """Columns by which a pixel lies further to the right for each row below the principal point."""
        return float(self.matrix[0, 1] / self.matrix[1, 1])

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return bool(np.any(self.distortion != 0.0))

    def same(self, other: CameraModel) -> bool:
        """Whether another calibration has the same values."""
        return (
            (self.width, self.height, self.distortion_model) == (other.width, other.height, other.distortion_model)
            and np.array_equal(self.matrix, other.matrix)
            and np.array_equal(self.distortion, other.distortion)
        )

    def check(self) -> None:
        """Raise ``ValueError`` if no lens has these values.

        The matrix has a camera's form and field of view; a perspective camera looks along its optical axis; and
        where distortion is defined, pixels have rays that lead back to them, within an order of magnitude of the ideal
        lens.
        """
        self._check_matrix()
        seen = self._consistent_fisheye() if self.distortion_model == "equidistant" else self._consistent_pixels()
        if seen < _CONSISTENT:
            raise ValueError(
                f"distortion: got {self.distortion.tolist()}, with which a lens would show only {100 * seen:.0f} % "
                f"of its field of view, expected at least {100 * _CONSISTENT:.0f} %: are they of another model "
                f"than {self.distortion_model!r}, or of another image size?"
            )

    def check_image(self, image: np.ndarray) -> None:
        """Raise ``ValueError`` if an image ``[height, width, ...]`` is not of this camera's size."""
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"images are {image.shape[1]} × {image.shape[0]} px, but CameraInfo says {self.width} × "
                f"{self.height} px"
            )

    def _check_matrix(self) -> None:
        matrix, size = self.matrix, np.array([self.width, self.height])
        focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if np.any(matrix[[1, 2, 2], [0, 0, 1]] != 0.0) or matrix[2, 2] != 1.0:
            raise ValueError(f"camera matrix: got {matrix.tolist()}, expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
        if not 1.0 / _MOST_OBLONG <= focal[0] / focal[1] <= _MOST_OBLONG:
            raise ValueError(
                f"camera matrix: got focal lengths {focal[0]:g} and {focal[1]:g} px, expected a ratio of at most "
                f"{_MOST_OBLONG:g}"
            )
        if not _SHORTEST * size.min() <= focal.min() <= focal.max() <= _LONGEST * size.max():
            raise ValueError(
                f"camera matrix: got focal lengths {focal[0]:g} and {focal[1]:g} px for {size[0]} × {size[1]} px, "
                f"expected {_SHORTEST:g} to {_LONGEST:g} times its edge: are they in pixels?"
            )
        off = (centre + 0.5) / size - 0.5
        # A region of an image may lie beside the optical axis; of another size, both shares are the same, or so large
        # that hardly any region is meant.
        scaled = abs(off[0] - off[1]) < _MOUNTED or np.abs(off).max() > _FAR_OFF
        if scaled and ((off > _OFF_CENTRE).all() or (off < -_OFF_CENTRE).all()):
            raise ValueError(
                f"camera matrix: got the principal point ({centre[0]:g}, {centre[1]:g}) px of an image of "
                f"{size[0]} × {size[1]} px, expected one near its middle: is the matrix that of a "
                f"{'larger' if off[0] > 0 else 'smaller'} image? If the image is a region of a larger one, give its "
                "place as `roi` of CameraInfo"
            )
        if self.distortion_model == "equidistant":
            return
        outside = np.maximum(0.0, np.maximum(-centre, centre - size + 1.0))
        if (slope := float(np.linalg.norm(outside / focal))) > _MOST_OBLIQUE:
            raise ValueError(
                f"camera matrix: got the principal point ({centre[0]:g}, {centre[1]:g}) px of an image of "
                f"{size[0]} × {size[1]} px, expected one in the image or near it: the whole image would lie more than "
                f"{np.degrees(np.arctan(slope)):.0f}° beside the optical axis"
            )

    def _consistent_fisheye(self) -> float:
        """Share of 60° in which the angles of an equidistant lens grow with the distance from the centre."""
        angles = np.linspace(0.0, _FISHEYE_ANGLE, 121)[1:]
        coefficients = self._fisheye()
        radii = angles * (1.0 + sum(k * angles ** (2 * n + 2) for n, k in enumerate(coefficients)))
        grows = (np.diff(radii, prepend=0.0) > 0.0) & (radii < _MOST_DISTORTED * angles)
        grows &= radii > angles / _MOST_DISTORTED
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]]) - self.matrix[:2, 2]
        # What lies beyond the image does not matter.
        grows |= radii > np.linalg.norm(corners / self.matrix[[0, 1], [0, 1]], axis=1).max()
        return float(np.logical_and.accumulate(grows).mean())

    def _consistent_pixels(self) -> float:
        """Share of the image of a perspective camera whose rays lead back to their pixels."""
        u, v = np.meshgrid(*(np.linspace(0.0, size - 1.0, 9) for size in (self.width, self.height)))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        with np.errstate(all="ignore"):
            rays = self.rays(pixels)
            seen = np.isfinite(rays).all(axis=1) & (np.abs(rays) < 1e6).all(axis=1)
            back = np.full(pixels.shape, np.inf)
            if seen.any():
                back[seen] = self._projected(rays[seen])
            straight = np.linalg.norm((pixels - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]], axis=1)
            bent = np.linalg.norm(rays[:, :2], axis=1)
            factor = np.maximum(straight, 1e-9) / np.maximum(bent, 1e-9)
            alike = (factor < _MOST_DISTORTED) & (factor > 1.0 / _MOST_DISTORTED)
            return float((alike & (np.linalg.norm(back - pixels, axis=1) < _SAME_PIXEL)).mean())

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
        visible = (points[:, 2] > 0.05) & (self._slope(points) <= self._largest_slope())
        if visible.any():
            pixels[visible] = self._projected(points[visible])
        inside = (pixels >= -0.5).all(axis=1) & (pixels[:, 0] < self.width - 0.5) & (pixels[:, 1] < self.height - 0.5)
        pixels[~inside] = np.nan
        return pixels, inside

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Undistorted ray directions of pixels in the camera frame.

        Args:
            pixels: ``[..., 2]`` (u, v); the centre of the first pixel is (0, 0).

        Returns:
            ``[..., 3]`` with z = 1, so that a ray times a depth is a point. NaN where a fisheye shows what lies 80° off
            its axis and more, or where its polynomial is not monotone.
        """
        pixels = np.asarray(pixels, np.float64)
        flat = pixels.reshape(-1, 1, 2)
        if self._skew:
            # OpenCV's functions leave out the matrix's skew.
            flat = flat - np.array([self._skew, 0.0]) * (flat[..., 1:] - self.matrix[1, 2])
        if not self.is_distorted and self.distortion_model != "equidistant":
            normalised = (flat[:, 0] - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        elif self.distortion_model == "equidistant":
            normalised = self._fisheye_rays((flat[:, 0] - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]])
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
        matrix[0, :2] *= scale[0]
        matrix[1, 1] *= scale[1]
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
        return CameraModel(width, height, matrix, self.distortion, self.distortion_model, self.frame_id)

    def _projected(self, points: np.ndarray) -> np.ndarray:
        """Pixels ``[n, 2]`` of points ``[n, 3]`` in front of the camera."""
        zero = np.zeros(3)
        if self.distortion_model == "equidistant":
            projected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, self.matrix, self._fisheye())
        else:
            projected, _ = cv2.projectPoints(points[:, None], zero, zero, self.matrix, self.distortion)
        projected = projected.reshape(-1, 2)
        if self._skew:
            projected = projected + np.array([self._skew, 0.0]) * (projected[:, 1:] - self.matrix[1, 2])
        return projected

    def _fisheye_angles(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles off the axis [rad], as far as the image's radius grows with them, and these radii at focal length 1.

        ``cv2.fisheye.undistortPoints`` clips radii at 90°, beyond which pixels get rays to the opposite side.
        """
        angles = np.linspace(0.0, _WIDEST_RAY, _FISHEYE_STEPS)
        radii = angles * (1.0 + sum(k * angles ** (2 * n + 2) for n, k in enumerate(self._fisheye())))
        falling = np.flatnonzero(np.diff(radii) <= 0.0)
        stop = int(falling[0]) + 1 if len(falling) else len(angles)
        return angles[:stop], radii[:stop]

    def _fisheye_rays(self, distorted: np.ndarray) -> np.ndarray:
        """Undistorted image coordinates ``[n, 2]`` of distorted ones, both at focal length 1."""
        angles, radii = self._fisheye_angles()
        radius = np.linalg.norm(distorted, axis=1)
        if len(angles) < 2:
            return np.where(radius[:, None] == 0.0, distorted, np.nan)
        angle = np.interp(radius, radii, angles, right=np.nan)
        for _ in range(2):
            # Newton's steps: the table's spacing leaves errors of 1e-7.
            value, slope = angle.copy(), np.ones_like(angle)
            for n, k in enumerate(self._fisheye()):
                value += k * angle ** (2 * n + 3)
                slope += (2 * n + 3) * k * angle ** (2 * n + 2)
            angle = angle - np.where(slope > 0.1, (value - radius) / np.maximum(slope, 0.1), 0.0)
        factor = np.divide(np.tan(angle), radius, out=np.ones_like(radius), where=radius > 1e-9)
        return distorted * factor[:, None]

    def _fisheye(self) -> np.ndarray:
        return self.distortion[:4] if self.distortion.size else np.zeros(4)

    @staticmethod
    def _slope(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[:, :2], axis=1) / np.maximum(points[:, 2], 1e-9)

    def _largest_slope(self) -> float:
        """Largest ratio of distance from the optical axis and depth that is seen, a little beyond the image's corners.

        Of a fisheye that is the largest angle with a ray.

        Where the distortion folds within the image no ray leads to its border. Beyond the largest that does, points
        would get the pixels of nearer ones.
        """
        if self.distortion_model == "equidistant":
            return float(np.tan(self._fisheye_angles()[0][-1]))
        across, down = (np.linspace(0.0, size - 1.0, 9) for size in (self.width, self.height))
        rows = [np.c_[across, np.full(9, v)] for v in down[[0, -1]]]
        columns = [np.c_[np.full(9, u), down] for u in across[[0, -1]]]
        border = np.concatenate([*rows, *columns])
        with np.errstate(all="ignore"):
            rays = self.rays(border)
            slopes = self._slope(rays)
            led_back = np.isfinite(slopes) & (slopes < 1e6)
            if led_back.any():
                apart = np.linalg.norm(self._projected(rays[led_back]) - border[led_back], axis=1)
                led_back[led_back] = apart < _SAME_PIXEL
        largest = float(slopes[led_back].max(initial=0.1))
        return largest * 1.05 if led_back.all() else largest
