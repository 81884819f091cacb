"""Standing points: what measured points show to rise from the ground, by direction and distance from a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.perception.motion_stereo import MeasuredPoints
from monoforce_ros.perception.steep_surfaces import SECTORS, SteepSurfaces, directions, steep_surfaces
from monoforce_ros.terrain import Grid

LEAST_RISE, _STEEPEST = 0.1, 0.026
"""Height from which something stands on the ground [m], a cell, and what is added to it per metre of distance: three
times an attitude that is half a degree off."""
_CERTAIN = 3.0
"""Standard deviations by which a ray certainly goes on."""
_INFORMATIVE = 0.05
"""Largest standard deviation of an inverse range with which a ray is known to go on [1/m]: of ranges from 0.6 m on,
wrong matches of two baselines agree within three standard deviations of their difference in a fifth of the cases at
most."""
_FARTHEST = 8.0
"""Distance up to which obstacles are sought [m]."""
_RATIO = 1.1
"""Ratio of neighbouring distances between which an obstacle goes on."""
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

    Something stands where the measured surface is certainly steeper than ground (:func:`steep_surfaces`): a hill does
    not stand on the ground, and an attitude that is a little off does not make one. Its place is the mean distance of
    its points, its top how high their rays are there.

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
        surfaces = steep_surfaces(offsets, seen.errors, seen.shared, seen.windows, height)
        heights = np.fmax(heights, _on_map(_profile(surfaces, headroom), camera, grid))
        sight = np.fmin(sight, _on_map(_lowest_rays(offsets, seen.errors, height), camera, grid))
    return Standing(heights, sight)


def _lowest_rays(offsets: np.ndarray, errors: np.ndarray, height: float) -> np.ndarray:
    """Height above the ground of the lowest ray that certainly goes on, by direction and distance [m], else NaN; see
    :func:`_profile`."""
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), _STEP)
    ranges = np.maximum(np.linalg.norm(offsets, axis=1), _STEP)
    reach = distance * (1.0 - _CERTAIN * errors / ranges)
    known = (errors < _INFORMATIVE * ranges**2) & (reach > _STEP)
    slopes = np.full((SECTORS, math.ceil(reach[known].max(initial=0.0) / _STEP) + 1), np.inf)
    index = directions(offsets[known]), (reach[known] / _STEP).astype(int)
    np.minimum.at(slopes, index, offsets[known, 2] / distance[known])
    slopes = np.minimum.accumulate(slopes[:, ::-1], axis=1)[:, ::-1]
    return height + np.where(np.isfinite(slopes), slopes, np.nan) * _STEP * np.arange(slopes.shape[1])


def _profile(surfaces: SteepSurfaces, headroom: float) -> np.ndarray:
    """Height above the ground of what stands there by direction and distance ``[directions, distances]`` [m],
    else NaN."""
    top, foot, distance = surfaces.top, surfaces.foot, surfaces.distance
    least = LEAST_RISE + _STEEPEST * distance
    stands = (top - foot > LEAST_RISE) & (foot < headroom) & (top > least) & (distance < _FARTHEST)
    # What stands on a hill that the map does not show makes no step of the hill.
    surfaces = replace(surfaces, top=np.where(foot > least, top - foot, np.minimum(top, headroom))).chosen(stands)
    length = surfaces.distance.max(initial=0.0) + _THICKNESS
    lines = np.full((SECTORS, math.ceil(length / _STEP) + 1), np.nan)
    order = np.lexsort((surfaces.distance, surfaces.direction))
    values = np.stack([surfaces.distance, surfaces.top, surfaces.spread, surfaces.windows])[:, order]
    found, starts = np.unique(surfaces.direction[order], return_index=True)
    for direction, own in zip(found, np.split(values, starts[1:], axis=1), strict=False):
        _draw(lines[direction], *_joined(*own))
    return lines


def _joined(
    places: np.ndarray, tops: np.ndarray, spreads: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places and tops in a direction, those of one obstacle as one.

    Of a wall far away points lie before and behind it: places that are no further apart than two standard deviations
    of a distance are one, their mean.
    """
    number, group, count, total, first = [], -1, 0, 0.0, -math.inf
    for place, spread in zip(places.tolist(), spreads.tolist(), strict=True):
        count, total = count + 1, total + spread
        if (place - first) * count > 2.0 * total:
            group, count, total, first = group + 1, 1, spread, place
        number.append(group)
    sums = np.bincount(number, weights)
    highest = np.zeros(len(sums))
    np.maximum.at(highest, number, tops)
    return np.bincount(number, weights * places) / sums, highest


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
    values = profile[directions(offsets), np.minimum(index, profile.shape[1] - 1)]
    return np.where(index < profile.shape[1], values, np.nan).reshape(grid.rows, grid.columns)
