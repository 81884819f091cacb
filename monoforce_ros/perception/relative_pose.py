"""Relative pose of two images: odometry's estimate, corrected by what the images show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from monoforce_ros.perception.epipolar import EpipolarPair

_MATCHING_ERROR = 0.35
"""Standard deviation of where a corner is found in the other image [px]; see docs/training.md."""
GREY_NOISE = 3.0
"""Standard deviation of a grey level: of the camera, and of JPEG."""
_ROTATION_ERROR, _DIRECTION_ERROR = 0.01, 0.017
"""Standard deviations of what odometry says of the rotation between two images, about each axis [rad], and of the
direction of the translation [rad]: half a degree for each of two noisy attitudes, and a centimetre or two across a
baseline of three or four decimetres."""
_CORNERS, _APART, _QUALITY = 240, 5, 0.002
"""Most corners that are tracked; least distance of two [cells]; and least response, relative to the largest one, of
which the sky's edge often is."""
_WINDOW, _CONTRAST, _GAIN = (11, 11), (21, 21), 40.0
"""Squares that are tracked, and in which contrast is normalised [cells]; grey levels of its standard deviation."""
_RETURNED = 0.5
"""How far from its start a corner may end that is tracked there and back [cells]."""
_FEWEST, _LEAST_SHARE = 20, 0.65
"""Corners that must obey one motion: in number, four for each of its five unknowns, and as a share of those tracked.
Of corners tracked to random places some tenth comes as near to its line as three standard deviations."""
_OUTLIER = 3.0
"""Standard deviations from which a corner counts as moving by itself, or as mistaken."""
_ITERATIONS = 8


@dataclass(frozen=True)
class RelativePose:
    """How a camera moved between two images."""

    rotation: np.ndarray
    """``[3, 3]``, axes of the earlier camera ← axes of the newest."""
    translation: np.ndarray
    """From the earlier camera to the newest in axes of the newest ``[3]`` [m]."""
    rotation_error: float = 0.0
    """Standard deviation of the rotation across the direction of motion, about one axis [rad]."""
    direction_error: float = 0.0
    """Standard deviation of the direction of the translation [rad]."""


def refined(pair: EpipolarPair, expected: np.ndarray) -> RelativePose | None:
    """The relative pose of a pair of images, corrected so that corners lie on each other's epipolar lines.

    Points of all ranges stay in their row of the pair if the pose is right. An error ω of the rotation and τ of the
    direction of motion, in axes of the pair, moves a point at θ from its row by

        δθ = ω₃ - cot φ' (ω₁ cos θ + ω₂ sin θ) + (cot φ' - cot φ) (τ₂ cos θ - τ₁ sin θ),

    linear in the five unknowns, which are estimated by iteratively reweighted least squares with odometry's errors as
    a prior. The length of the translation, which no image tells, is odometry's.

    Args:
        pair: images resampled with odometry's relative pose.
        expected: displacement that is expected of each cell, where the search begins ``[rows, columns]`` [cells].

    Returns:
        None if too few corners obey one motion.
    """
    newest, earlier = (_normalised(image) for image in pair.images)
    found = cv2.goodFeaturesToTrack(
        newest, _CORNERS, _QUALITY, _APART, mask=pair.seen.astype(np.uint8) * 255, blockSize=3
    )
    if found is None or len(found) < _FEWEST:
        return None
    start = found.reshape(-1, 2)
    guess = start.copy()
    guess[:, 0] -= expected[np.rint(start[:, 1]).astype(int), np.rint(start[:, 0]).astype(int)]
    end, there = _tracked(newest, earlier, start, guess, 2)
    back, again = _tracked(earlier, newest, end, start.copy(), 1)
    kept = there & again & (np.linalg.norm(back - start, axis=1) < _RETURNED)
    if int(kept.sum()) < _FEWEST:
        return None
    start, end = start[kept].astype(float), end[kept].astype(float)
    theta = pair.theta[0] + start[:, 1] * pair.step
    offset = (end[:, 1] - start[:, 1]) * pair.step
    phi, phi_earlier = (2.0 * np.arctan(np.exp(pair.u[0] + x * pair.step)) for x in (start[:, 0], end[:, 0]))
    cot, cot_earlier = 1.0 / np.tan(phi), 1.0 / np.tan(phi_earlier)
    sine, cosine = np.sin(theta), np.cos(theta)
    nearness = cot_earlier - cot
    moves = np.stack(
        [-cot_earlier * cosine, -cot_earlier * sine, np.ones_like(sine), -nearness * sine, nearness * cosine], axis=1
    )
    error = np.hypot(
        _MATCHING_ERROR * pair.newest.pixel / np.sin(phi_earlier), pair.step * _doubt(pair.images[0], start)
    )
    prior = np.diag([_ROTATION_ERROR**-2] * 3 + [_DIRECTION_ERROR**-2] * 2)
    unknowns, scale = np.zeros(5), 4.0
    for _ in range(_ITERATIONS):
        off = (offset - moves @ unknowns) / error
        # Cauchy's weights, from a scale that lets every corner count to that of their errors.
        weights = 1.0 / (1.0 + (off / scale) ** 2) / error**2
        information = (moves * weights[:, None]).T @ moves + prior
        unknowns = np.linalg.solve(information, (moves * weights[:, None]).T @ offset)
        scale = max(1.0, 0.6 * scale)
    obeys = np.abs(offset - moves @ unknowns) < _OUTLIER * error
    if int(obeys.sum()) < _FEWEST or obeys.mean() < _LEAST_SHARE:
        return None
    covariance = np.linalg.inv(information)
    turn, _ = cv2.Rodrigues(pair.axes.T @ unknowns[:3])
    motion = pair.axes[2] + pair.axes.T @ np.array([unknowns[3], unknowns[4], 0.0])
    return RelativePose(
        rotation=pair.rotation @ turn,
        translation=pair.baseline * motion / np.linalg.norm(motion),
        rotation_error=float(np.sqrt(np.trace(covariance[:2, :2]) / 2.0)),
        direction_error=float(np.sqrt(np.trace(covariance[3:, 3:]) / 2.0)),
    )


def _tracked(
    newest: np.ndarray, earlier: np.ndarray, start: np.ndarray, guess: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where corners ``[n, 2]`` of one image are in another ``[n, 2]``, sought from a guess, and which were found."""
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        newest, earlier, start, guess, winSize=_WINDOW, maxLevel=levels, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02),
    )  # fmt: skip
    return np.asarray(end), np.asarray(found).ravel() > 0


def _doubt(image: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Standard deviation across the rows with which noise lets corners ``[n, 2]`` be found ``[n]`` [cells]: the bound
    of Cramér and Rao for windows with a noise in both images."""
    across, along = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1.0 / 8.0) for order in ((0, 1), (1, 0)))
    column, row = np.rint(corners).astype(int).T
    yy, xx, xy = (
        cv2.boxFilter(product, -1, _WINDOW, normalize=False)[row, column]
        for product in (across**2, along**2, across * along)
    )
    return math.sqrt(2.0) * GREY_NOISE * np.sqrt(xx / np.maximum(xx * yy - xy**2, 1e-6))


def _normalised(image: np.ndarray) -> np.ndarray:
    """An image with the same contrast everywhere, uint8: cameras adjust their exposure, and the edge of the sky is no
    better a corner than the ground's texture."""
    values = image.astype(np.float32)
    mean = cv2.blur(values, _CONTRAST)
    spread = np.sqrt(np.maximum(cv2.blur(values**2, _CONTRAST) - mean**2, 0.0)) + GREY_NOISE
    return np.clip(128.0 + _GAIN * (values - mean) / spread, 0.0, 255.0).astype(np.uint8)
