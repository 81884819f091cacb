"""Separate stretches: poses of a localisation that starts anew after each gap, laid apart so that each has its ground.

Some recordings consist of short runs, each localised from its own first pose. Ground that is traced along all of them
in one frame would be a pile of different places.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monoforce_ros.bags import SmoothedMotion

_CELL = 0.5
"""Size of the places that are compared [m]: half a robot's length."""
_FEWEST = 10
"""Places that several stretches passed, for a comparison."""
_AGREES = 0.5
"""Share of the heights' variance that belongs to the places if they are the same ones: most of it, by definition."""


def height_agreement(smoothed: SmoothedMotion) -> float | None:
    """Share of the variance of heights that belongs to the places which several stretches passed.

    It is the intraclass correlation (Fisher 1925): one if every stretch passes a place at the same height, zero or less
    if heights at one place differ as much as those of different places.

    Returns:
        None where fewer than ten places were passed by several stretches.
    """
    cells, heights = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for stretch in smoothed.stretches:
        positions = smoothed.motion.positions[stretch]
        places, visit = np.unique(np.floor(positions[:, :2] / _CELL).astype(np.int64), axis=0, return_inverse=True)
        cells.append(places)
        heights.append(np.bincount(visit.ravel(), positions[:, 2]) / np.bincount(visit.ravel()))
    _, place, visits = np.unique(np.concatenate(cells), axis=0, return_inverse=True, return_counts=True)
    again = visits[place.ravel()] > 1
    height = np.concatenate(heights)[again]
    _, place, visits = np.unique(place.ravel()[again], return_inverse=True, return_counts=True)
    if len(visits) < _FEWEST:
        return None
    means = np.bincount(place, height) / visits
    within = float(((height - means[place]) ** 2).sum() / (len(height) - len(visits)))
    total = float(np.var(height, ddof=1))
    return 1.0 - within / total if total > 0 else 1.0


def starts_anew(smoothed: SmoothedMotion) -> bool:
    """Whether heights say that stretches do not share a frame: most of their variance is not that of the places."""
    agreement = height_agreement(smoothed)
    return agreement is not None and agreement < _AGREES


def laid_apart(smoothed: SmoothedMotion, margin: float) -> SmoothedMotion:
    """The motion with its stretches side by side, in rows, at least twice ``margin`` [m] apart.

    Motion within a stretch stays the same, and so do heights. Poses between stretches go with the one before.
    """
    stretches = smoothed.stretches
    if len(stretches) < 2:
        return smoothed
    positions = smoothed.motion.positions.copy()
    lows = np.array([positions[stretch, :2].min(axis=0) for stretch in stretches])
    sizes = np.array([positions[stretch, :2].max(axis=0) for stretch in stretches]) - lows + 2.0 * margin
    shifts = _packed(sizes) + margin - lows
    begins = np.array([stretch.start for stretch in stretches])
    owner = np.maximum(np.searchsorted(begins, np.arange(len(positions)), side="right") - 1, 0)
    positions[:, :2] += shifts[owner]
    return replace(smoothed, motion=replace(smoothed.motion, positions=positions))


def _packed(sizes: np.ndarray) -> np.ndarray:
    """Lower corners of rectangles ``[n, 2]`` [m] in rows of about the same width and height, ``[n, 2]``."""
    order = np.argsort(-sizes[:, 1], kind="stable")
    width = max(float(np.sqrt(sizes.prod(axis=1).sum())), float(sizes[:, 0].max()))
    corners = np.zeros_like(sizes)
    x = y = tallest = 0.0
    for number in order:
        if x > 0 and x + sizes[number, 0] > width:
            x, y, tallest = 0.0, y + tallest, 0.0
        corners[number] = x, y
        x, tallest = x + sizes[number, 0], max(tallest, float(sizes[number, 1]))
    return corners
