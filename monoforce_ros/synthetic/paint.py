"""Paint: colours, sky and light of a world, which only images need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Light:
    """Sun and air.

    Attributes:
        to_sun: unit vector towards the sun ``[3]``, world coordinates.
        sun: colour and brightness of the sun ``[3]``.
        ambient: colour and brightness of the shade ``[3]``.
        haze: colour of the haze ``[3]`` in 0..1.
        haze_start, haze_end: distances at which haze begins and hides everything [m].
    """

    to_sun: np.ndarray
    sun: tuple[float, float, float]
    ambient: tuple[float, float, float]
    haze: tuple[float, float, float]
    haze_start: float
    haze_end: float


@dataclass(frozen=True)
class Paint:
    """Images for a world's surfaces.

    Attributes:
        turf: share of short grass in 0..1 on a grid that covers the height field.
        materials: image ``[rows, columns, 3]`` uint8 of each material; ``ground`` covers the whole height field
            ``[row = y, column = x, rgb]``.
        sky: six faces ``[6 * n, n, 3]`` uint8 in MuJoCo's order.
        light: sun and air.
        surroundings: colour of the ground beyond the world ``[3]`` in 0..1; None draws nothing there.
    """

    turf: np.ndarray
    materials: Mapping[str, np.ndarray]
    sky: np.ndarray
    light: Light
    surroundings: tuple[float, float, float] | None = None
