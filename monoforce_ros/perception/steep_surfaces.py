"""Steep surfaces: which parts of the measured surfaces rise more steeply than any ground that a robot drives on."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

SECTORS = 240
"""Directions around a camera: 1.5°, a cell at 4 m."""
_LEVEL = math.radians(0.75)
"""Spacing of elevations, as height per distance: half a direction."""
_LOWEST, _HIGHEST = -2.0, 0.9
"""Elevations that are looked at, as height per distance: below, distances within a level differ more than steepness;
above, a surface of 45° leans away from the ray."""
_SIZES = (3, 4, 6, 8, 12, 16, 24, 32)
"""Heights of the ranges of elevations that are tested [levels]: from what has three values to a wall nearby."""
_BESIDE = 5
"""Directions to either side whose steepness is averaged: what is wide is more certain than each of its directions."""
_STEEP = 1.0
"""Rise per distance from which a surface is an obstacle: 45°, which no wheel climbs at a friction below 1."""
_CERTAIN = 3.0
"""Standard deviations by which a surface is steeper than that."""
_SCATTER = 2.0
"""Largest mean square of the normalised residuals: 1 if errors are as large as they say. Leaves of
grass and hedges lie behind each other, and so do an obstacle's edge and its background."""
_FEWEST, _FEWEST_OWN = 3.0, 1.0
"""Windows that were matched independently of each other: in all directions together, and in one with its neighbours."""
_FILLED = 0.8
"""Least spread of the elevations in a range, relative to that of evenly distributed ones."""
_LEAST_VARIANCE = 1e-9


@dataclass(frozen=True)
class SteepSurfaces:
    """Parts of steep surfaces around a camera, each array ``[n]``."""

    direction: np.ndarray
    """Number of its direction."""
    distance: np.ndarray
    """Horizontal distance [m]."""
    foot: np.ndarray
    """Height of its lower end above the ground [m]."""
    top: np.ndarray
    """Height of its upper end above the ground [m]."""
    spread: np.ndarray
    """Standard deviation of the distance of one matched window [m]."""
    windows: np.ndarray
    """Windows that were matched independently of each other."""

    def chosen(self, which: np.ndarray) -> SteepSurfaces:
        """Those where ``which [n]`` says so."""
        return SteepSurfaces(*(getattr(self, entry.name)[which] for entry in fields(self)))


def directions(offsets: np.ndarray) -> np.ndarray:
    """Number of the direction of each offset ``[n, 2 or more]``."""
    angle = np.arctan2(offsets[:, 1], offsets[:, 0])
    return np.floor((angle + math.pi) / (2.0 * math.pi) * SECTORS).astype(int) % SECTORS


def steep_surfaces(
    offsets: np.ndarray, errors: np.ndarray, shared: np.ndarray, windows: np.ndarray, height: float
) -> SteepSurfaces:
    """Parts of surfaces that are certainly steeper than ground.

    In a vertical plane through the camera let e be the height that a ray gains per distance, and q the inverse of the
    horizontal distance at which it ends. On a surface that rises by s per distance dq/de = -q / (s - e): zero on a
    wall, and the flatter the larger, whatever the height of the surface. Rays are exact, and the error of q hardly
    depends on the distance: the slope of a regression of q on e tells steep surfaces from ground, with a known error.
    That of the camera's motion bends all of q together and counts in full.

    All rays of a range of elevations count, whatever their distance: points of something far away whose distances were
    measured too small do not make an obstacle of themselves.

    Args:
        offsets: points relative to the camera, in terrain axes ``[n, 3]`` [m].
        errors, shared, windows: of :class:`monoforce_ros.perception.motion_stereo.MeasuredPoints`.
        height: of the camera above the ground [m].
    """
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-3)
    elevation = offsets[:, 2] / distance
    looked_at = (elevation >= _LOWEST) & (elevation < _HIGHEST)
    found: list[list[np.ndarray]] = []
    if looked_at.any():
        distance, elevation, windows = distance[looked_at], elevation[looked_at], windows[looked_at]
        ranges = np.linalg.norm(offsets[looked_at], axis=1)
        own = np.sqrt(np.maximum(errors[looked_at] ** 2 - shared[looked_at] ** 2, 1e-12))
        # Standard deviations of q: relative errors of the range are those of the distance.
        own, common = own / ranges / distance, shared[looked_at] / ranges / distance
        sums, first, lowest = _summed(directions(offsets[looked_at]), elevation, 1.0 / distance, own, common, windows)
        for size in _SIZES:
            if size < sums.shape[2]:
                found += _steep(sums[:, :, size:] - sums[:, :, :-size], first, lowest, size, height)
    if not found:
        return SteepSurfaces(np.zeros(0, int), *np.zeros((5, 0)))
    return SteepSurfaces(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _summed(
    direction: np.ndarray, e: np.ndarray, q: np.ndarray, own: np.ndarray, common: np.ndarray, windows: np.ndarray
) -> tuple[np.ndarray, int, int]:
    """Sums of the regression over each direction with those beside it ``[9, directions, levels + 1]``, cumulated over
    levels of elevation, the number of the first direction, and that of the lowest level."""
    # Counted from the middle one: a camera that looks back sees both ends of the circle.
    start = direction[0] - SECTORS // 2
    start += int(np.median((direction - start) % SECTORS)) - SECTORS // 2
    row = (direction - start) % SECTORS
    level = np.floor((e - _LOWEST) / _LEVEL).astype(int)
    first, lowest = int(row.min()) - 1, int(level.min())
    rows, columns = int(row.max()) - first + 2, int(level.max()) - lowest + 1
    index = (row - first) * columns + level - lowest
    weight = windows / own**2
    sums = np.zeros((9, rows, columns + 1))
    products = (windows, weight, weight * e, weight * e**2, weight * q, weight * e * q, weight * q**2, weight * common,
                weight * e * common)  # fmt: skip
    for summed, values in zip(sums, products, strict=True):
        single = np.bincount(index, values, rows * columns).reshape(rows, columns)
        single[1:-1] = single[:-2] + single[1:-1] + single[2:]
        np.cumsum(single, axis=1, out=summed[:, 1:])
    return sums, first + start, lowest


def _steep(sums: np.ndarray, first: int, lowest: int, size: int, height: float) -> list[list[np.ndarray]]:
    """Fields of :class:`SteepSurfaces`, of each direction by itself and with those to either side.

    Args:
        sums: of the regression over ranges of elevations ``[9, directions, ranges]``.
        first, lowest: numbers of the first direction and of the lowest level.
        size: height of a range [levels].
        height: of the camera above the ground [m].
    """
    n, w, we, wee, wq, weq, wqq, wc, wec = sums
    w = np.maximum(w, 1e-9)
    mean_e, mean_q = we / w, wq / w
    variance = np.maximum(wee / w - mean_e**2, _LEAST_VARIANCE)
    covariance = weq / w - mean_e * mean_q
    residual = np.maximum(wqq - w * (mean_q**2 + covariance**2 / variance), 0.0)
    filled = (n >= _FEWEST_OWN) & (variance > (_FILLED * size * _LEVEL) ** 2 / 12.0)
    parts = np.stack([n, w * variance, w * covariance, wec - mean_e * wc, residual, wq, w])
    parts[:, ~filled] = 0.0
    total = np.concatenate([np.zeros_like(parts[:, :1]), np.cumsum(parts, axis=1)], axis=1)
    row = np.arange(parts.shape[1])
    around = total[:, np.minimum(row + _BESIDE + 1, len(row))] - total[:, np.maximum(row - _BESIDE, 0)]
    lower_end = _LOWEST + _LEVEL * (lowest + np.arange(n.shape[1]))
    found = []
    # Each direction has its own mean: a wall may be oblique. Directions overlap by three.
    for counted in (parts, around / 3.0):
        rows, columns = np.nonzero((counted[0] >= _FEWEST) & filled)
        count, spread_e, together, bent, scatter, sum_q, sum_w = counted[:, rows, columns]
        q = sum_q / sum_w
        scatter = scatter / count
        slope = together / spread_e
        error = np.sqrt(np.maximum(scatter, 1.0) / spread_e + (bent / spread_e) ** 2)
        steep = np.abs(slope) + _CERTAIN * error < q / (_STEEP - mean_e[rows, columns])
        steep &= scatter < _SCATTER
        rows, columns = rows[steep], columns[steep]
        place = 1.0 / mean_q[rows, columns]
        foot = height + lower_end[columns] * place
        found.append(
            [
                (rows + first) % SECTORS, place, foot, foot + size * _LEVEL * place,
                np.sqrt(n[rows, columns] / w[rows, columns]) * place**2, n[rows, columns],
            ]
        )  # fmt: skip
    return found
