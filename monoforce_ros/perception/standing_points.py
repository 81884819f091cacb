"""Standing points: what measured points show to rise from the ground, by direction and distance from a camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from monoforce_ros.perception.motion_stereo import MeasuredPoints
from monoforce_ros.terrain import Grid

LEAST_RISE, _STEEPEST = 0.1, 0.026
"""Height from which something stands on the ground [m], a cell, and what is added to it per metre of distance: three
times an attitude that is half a degree off. At that distance a class of distances is also wide enough for ground of 15°
to rise as much within it."""
_CERTAIN = 3.0
"""Standard deviations by which a point is higher than the ground."""
_INFORMATIVE = 0.05
"""Largest standard deviation of an inverse range that places an obstacle [1/m]: of ranges from 0.6 m on, wrong matches
of two baselines agree within three standard deviations of their difference in a fifth of the cases at most."""
_SECTORS = 240
"""Directions around a camera: 1.5°, a cell at 4 m."""
_RATIO = 1.1
"""Ratio of the limits of distance classes."""
_FEWEST = 3.0
"""Windows that were matched independently of each other in a direction, a distance, and those beside them."""
_TOP, _FOOT = 0.8, 0.1
"""Quantiles of the heights of points that are top and foot of what stands: single points may be wrong."""
_EXTENT = 2.4
"""Distance of these quantiles in standard deviations, of heights that are evenly distributed."""
_STEP = 0.05
"""Spacing of distances along a direction [m]."""
_THICKNESS = 0.2
"""Depth of an obstacle of which only the front is seen [m]: two cells, so that it hides in no gap between cells."""


@dataclass(frozen=True)
class Standing:
    """What stands on the ground around a robot; each ``[rows, columns]``, above the ground under the robot [m]."""

    heights: np.ndarray
    """Top of what stands in a cell; NaN where nothing was found."""
    sight: np.ndarray
    """Height at which the lowest measured ray passes over a cell; NaN without any."""


def standing_on(
    measured: Sequence[MeasuredPoints], terrain_from_base: np.ndarray, ground: float, headroom: float, grid: Grid
) -> Standing:
    """What measured points show to stand on the ground.

    The error of a point is along its ray: its direction is exact, its distance is not. Points are therefore collected
    by direction and by distance in classes that widen with the distance. Something stands where enough points are above
    the ground and are spread in height more than on a slope: a hill does not stand on the ground, and an attitude that
    is a little off does not make one. Its place is the mean distance of its points, its top how high they are there.

    Args:
        measured: points of each camera.
        terrain_from_base: ``[4, 4]``.
        ground: height of the ground under the robot [m].
        headroom: height above the ground from which the robot passes below things [m].
        grid: cells of the map.
    """
    heights = np.full((grid.rows, grid.columns), np.nan)
    sight = heights.copy()
    turn = terrain_from_base[:3, :3]
    for seen in measured:
        camera = turn @ seen.origin + terrain_from_base[:3, 3]
        offsets = (seen.points - seen.origin) @ turn.T
        height = float(camera[2]) - ground
        low = offsets[:, 2] + height < headroom
        tops = _profile(offsets[low], seen.errors[low], seen.windows[low], height)
        heights = np.fmax(heights, _on_map(tops, camera, grid))
        sight = np.fmin(sight, _on_map(_lowest_rays(offsets, seen.errors, height), camera, grid))
    return Standing(heights, sight)


def _lowest_rays(offsets: np.ndarray, errors: np.ndarray, height: float) -> np.ndarray:
    """Height above the ground of the lowest ray that certainly goes on, by direction and distance [m], else NaN; see
    :func:`_profile`."""
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), _STEP)
    ranges = np.maximum(np.linalg.norm(offsets, axis=1), _STEP)
    reach = distance * (1.0 - _CERTAIN * errors / ranges)
    known = (errors < _INFORMATIVE * ranges**2) & (reach > _STEP)
    slopes = np.full((_SECTORS, math.ceil(reach[known].max(initial=0.0) / _STEP) + 1), np.inf)
    index = _sectors(offsets[known]), (reach[known] / _STEP).astype(int)
    np.minimum.at(slopes, index, offsets[known, 2] / distance[known])
    slopes = np.minimum.accumulate(slopes[:, ::-1], axis=1)[:, ::-1]
    return height + np.where(np.isfinite(slopes), slopes, np.nan) * _STEP * np.arange(slopes.shape[1])


def _sectors(offsets: np.ndarray) -> np.ndarray:
    """Number of the direction of each offset ``[n]``."""
    angle = np.arctan2(offsets[:, 1], offsets[:, 0])
    return np.floor((angle + math.pi) / (2.0 * math.pi) * _SECTORS).astype(int) % _SECTORS


def _profile(offsets: np.ndarray, errors: np.ndarray, windows: np.ndarray, height: float) -> np.ndarray:
    """Height above the ground of what stands there by direction and distance ``[sectors, distances]`` [m], else NaN.

    Args:
        offsets: points relative to the camera, in terrain axes ``[n, 3]`` [m].
        errors, windows: of :class:`MeasuredPoints`.
        height: of the camera above the ground [m].
    """
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), _STEP)
    lines = np.full((_SECTORS, math.ceil((distance.max(initial=0.0) * _RATIO + _THICKNESS) / _STEP) + 1), np.nan)
    if not len(distance):
        return lines
    ranges = np.maximum(np.linalg.norm(offsets, axis=1), 1e-6)
    sector = _sectors(offsets)
    number = np.floor(np.log(distance / _STEP) / math.log(_RATIO)).astype(int)
    classes = int(number.max()) + 2
    index, size = sector * classes + number, _SECTORS * classes

    def summed(values: np.ndarray) -> np.ndarray:
        """By direction and distance; points also belong to the directions beside their own."""
        sums = np.bincount(index, values, size).reshape(_SECTORS, classes)
        return sums + np.roll(sums, 1, 0) + np.roll(sums, -1, 0)

    rise = offsets[:, 2] + height
    least = np.maximum(LEAST_RISE + _STEEPEST * distance, _CERTAIN * errors * np.abs(offsets[:, 2]) / ranges)
    strong = (errors < _INFORMATIVE * ranges**2) & (rise > least)
    evidence = cv2.blur(summed(windows * strong), (3, 1), borderType=cv2.BORDER_CONSTANT) * 3.0
    enough = (evidence >= _FEWEST).ravel()
    if not enough.any():
        return lines
    weight = windows * (distance / errors) ** 2
    place = (summed(weight * distance) / np.maximum(summed(weight), 1e-12)).ravel()
    slope = offsets[:, 2] / distance
    members, rises, shares = [], [], []
    for beside in (-1, 0, 1):
        group = (sector + beside) % _SECTORS * classes + number
        kept = enough[group]
        members.append(group[kept])
        # A direction is exact, a distance is not: what counts is how high a point is at the place where it stands.
        rises.append(height + slope[kept] * place[group[kept]])
        shares.append(windows[kept])
    groups, heights, counts = (np.concatenate(parts) for parts in (members, rises, shares))
    foot, top = _quantiles(groups, heights, counts, size, (_FOOT, _TOP))
    extent = LEAST_RISE + _STEEPEST * place
    stands = enough & (top - foot > extent) & (top > extent)
    # What stands on a hill that the map does not show makes no step of the hill.
    top = np.where(foot > extent, top - foot, top)
    stands &= _spread_about_slope(summed, windows, distance, rise).ravel() > extent / _EXTENT
    spread = summed(weight * errors * distance / ranges).ravel() / np.maximum(summed(weight).ravel(), 1e-12)
    shape = (_SECTORS, classes)
    weights = evidence.reshape(shape)
    place, top, spread, stands = (values.reshape(shape) for values in (place, top, spread, stands))
    for direction in np.flatnonzero(stands.any(axis=1)):
        own = stands[direction]
        _draw(lines[direction], *_joined(*(v[direction, own] for v in (place, top, spread, weights))))
    return lines


def _spread_about_slope(
    summed: Callable[[np.ndarray], np.ndarray], windows: np.ndarray, distance: np.ndarray, rise: np.ndarray
) -> np.ndarray:
    """Standard deviation of heights about their regression on the distance, by direction and class with those before
    and behind it ``[sectors, classes]`` [m]: on a hill the further is the higher, on a wall it is not."""

    def around(values: np.ndarray) -> np.ndarray:
        return cv2.blur(summed(windows * values), (3, 1), borderType=cv2.BORDER_CONSTANT)

    total = np.maximum(around(np.ones_like(distance)), 1e-12)
    middle, height = around(distance) / total, around(rise) / total
    across = np.maximum(around(distance**2) / total - middle**2, 1e-6)
    along = around(distance * rise) / total - middle * height
    return np.sqrt(np.maximum(around(rise**2) / total - height**2 - along**2 / across, 0.0))


def _joined(
    places: np.ndarray, tops: np.ndarray, spreads: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places and tops in a direction, those of one obstacle as one.

    Of a wall far away points lie before and behind it: places that are no further apart than two standard deviations
    of a distance are one, their mean.
    """
    number = np.zeros(len(places), int)
    first = 0
    for index in range(1, len(places)):
        if places[index] - places[first] > 2.0 * spreads[first : index + 1].mean():
            first = index
            number[index:] += 1
    sums = np.bincount(number, weights)
    highest = np.zeros(len(sums))
    np.maximum.at(highest, number, tops)
    return np.bincount(number, weights * places) / sums, highest


def _quantiles(
    index: np.ndarray, values: np.ndarray, weights: np.ndarray, size: int, shares: tuple[float, ...]
) -> list[np.ndarray]:
    """Weighted quantiles of the values ``[n]`` of each group ``[size]``; 0 for one without any."""
    order = np.lexsort((values, index))
    sums = np.cumsum(weights[order])
    starts = np.searchsorted(index[order], np.arange(size + 1))
    before = np.concatenate([[0.0], sums])[starts]
    filled = np.flatnonzero(np.diff(starts))
    found = []
    for share in shares:
        wanted = before[filled] + share * (before[filled + 1] - before[filled])
        chosen = np.clip(np.searchsorted(sums, wanted), starts[filled], starts[filled + 1] - 1)
        result = np.zeros(size)
        result[filled] = values[order][chosen]
        found.append(result)
    return found


def _draw(line: np.ndarray, places: np.ndarray, tops: np.ndarray) -> None:
    """Enter what stands at some distances into the heights along a direction: between neighbouring classes it goes on,
    elsewhere it is as deep as an obstacle of unknown depth."""
    along = _STEP * np.arange(len(line))
    for index, (place, top) in enumerate(zip(places, tops, strict=True)):
        following = places[index + 1] if index + 1 < len(places) else math.inf
        last, end = (following, tops[index + 1]) if following < place * _RATIO**2 else (place + _THICKNESS, top)
        inside = (along >= place - _STEP) & (along <= last)
        share = np.clip((along[inside] - place) / max(last - place, _STEP), 0.0, 1.0)
        line[inside] = np.fmax(line[inside], top + share * (end - top))


def _on_map(profile: np.ndarray, camera: np.ndarray, grid: Grid) -> np.ndarray:
    """The profile at the cells of a map ``[rows, columns]`` [m]."""
    offsets = np.stack(np.meshgrid(grid.x - camera[0], grid.y - camera[1]), axis=-1).reshape(-1, 2)
    index = np.rint(np.hypot(offsets[:, 0], offsets[:, 1]) / _STEP).astype(int)
    values = profile[_sectors(offsets), np.minimum(index, profile.shape[1] - 1)]
    return np.where(index < profile.shape[1], values, np.nan).reshape(grid.rows, grid.columns)
