"""Palette: colours of a randomised world, natural ones with variations or any."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.synthetic.varied.settings import PaletteSettings

BRICK_COLOURS = ((0.55, 0.29, 0.21), (0.66, 0.45, 0.32), (0.72, 0.66, 0.55), (0.45, 0.42, 0.40), (0.38, 0.20, 0.17))
STONE_COLOURS = ((0.60, 0.585, 0.56), (0.42, 0.41, 0.40), (0.70, 0.64, 0.53), (0.50, 0.40, 0.34), (0.30, 0.31, 0.33))
WOOD_COLOURS = ((0.52, 0.38, 0.24), (0.66, 0.53, 0.36), (0.40, 0.29, 0.20), (0.55, 0.53, 0.50), (0.30, 0.20, 0.13))
PAINT_COLOURS = (
    (0.85, 0.85, 0.83), (0.70, 0.12, 0.10), (0.10, 0.24, 0.50), (0.12, 0.35, 0.18), (0.88, 0.72, 0.12),
    (0.10, 0.10, 0.11), (0.45, 0.47, 0.49), (0.82, 0.42, 0.10), (0.55, 0.60, 0.66),
)  # fmt: skip
CONCRETE_COLOURS = ((0.62, 0.61, 0.59), (0.50, 0.50, 0.49), (0.72, 0.70, 0.66), (0.40, 0.41, 0.42))


class Palette:
    """Draws colours.

    Args:
        settings: shares of natural colours and textures, drawn once for the world.
        random: generator of the colours.
    """

    def __init__(self, settings: PaletteSettings, random: np.random.Generator):
        self.drawn = settings.draw(random)
        self._random = random

    def colour(self, natural: tuple[tuple[float, float, float], ...]) -> np.ndarray:
        """A colour ``[3]`` in 0..1: one of the natural ones, shifted, or any."""
        random = self._random
        if random.random() < self.drawn.natural:
            return self.shifted(np.array(natural[int(random.integers(len(natural)))]))
        return from_hsv(random.random(), random.uniform(0.1, 0.95), random.uniform(0.12, 0.95))

    def shifted(self, colour: np.ndarray) -> np.ndarray:
        """Colours ``[..., 3]`` with another hue, saturation and brightness."""
        random, shift = self._random, self.drawn.shift
        factors = 1.0 + shift * random.uniform(-0.6, 0.6, 3)
        return np.clip(colour * factors * (1.0 + shift * random.uniform(-1.0, 0.8)), 0.02, 0.98)

    def has_random_pattern(self) -> bool:
        """Whether a surface has a pattern that its material would not have."""
        return bool(self._random.random() < self.drawn.textures)


def from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """RGB ``[3]`` of a hue, a saturation and a brightness, all in 0..1."""
    pixel = np.array([[[360.0 * (hue % 1.0), saturation, value]]], np.float32)
    return cv2.cvtColor(pixel, cv2.COLOR_HSV2RGB)[0, 0].astype(float)


def varied_hue(colours: np.ndarray, hue: float) -> np.ndarray:
    """Colours ``[n, 3]`` turned by ``hue`` in 0..1 around the grey axis."""
    hsv = cv2.cvtColor(np.asarray(colours, np.float32)[None], cv2.COLOR_RGB2HSV)[0]
    hsv[:, 0] = (hsv[:, 0] + 360.0 * hue) % 360.0
    return cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].astype(float)
