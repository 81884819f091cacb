"""Ground tiles: images of ten metres of meadow, gravel, snow, paving and other grounds."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.synthetic.textures import noise
from monoforce_ros.synthetic.varied.palette import Palette

PIXELS = 1024
"""A tile's edge; tiles repeat every ten metres on a world of 40 m."""

_COLOURS = {
    "meadow": ((0.37, 0.50, 0.19), (0.30, 0.42, 0.16), (0.50, 0.54, 0.24), (0.60, 0.55, 0.32)),
    "soil": ((0.46, 0.35, 0.23), (0.36, 0.26, 0.18), (0.55, 0.42, 0.30), (0.52, 0.32, 0.22)),
    "forest": ((0.30, 0.22, 0.14), (0.24, 0.21, 0.14), (0.38, 0.26, 0.14)),
    "gravel": ((0.55, 0.55, 0.56), (0.62, 0.58, 0.52), (0.42, 0.42, 0.44)),
    "sand": ((0.76, 0.66, 0.48), (0.70, 0.58, 0.42), (0.82, 0.76, 0.64)),
    "mud": ((0.22, 0.17, 0.12), (0.30, 0.24, 0.18), (0.18, 0.16, 0.14)),
    "snow": ((0.92, 0.94, 0.97), (0.86, 0.89, 0.93)),
    "ice": ((0.72, 0.80, 0.86), (0.60, 0.70, 0.78)),
    "asphalt": ((0.22, 0.22, 0.23), (0.32, 0.32, 0.33), (0.40, 0.39, 0.38)),
    "concrete": ((0.62, 0.61, 0.59), (0.52, 0.51, 0.49)),
    "paving": ((0.52, 0.50, 0.48), (0.58, 0.44, 0.36), (0.44, 0.44, 0.46)),
    "wet": ((0.22, 0.21, 0.20), (0.28, 0.25, 0.21), (0.20, 0.22, 0.24)),
    "odd": ((0.5, 0.5, 0.5),),
}


def ground_tile(kind: str, colours: Palette, random: np.random.Generator) -> np.ndarray:
    """An image ``[1024, 1024, 3]`` uint8 of a ground of :data:`settings.GROUND_KINDS`."""
    base = colours.colour(_COLOURS[kind])
    fine, broad = _grain(96, random), _grain(8, random)
    image = (base * (1.0 + 0.12 * broad + random.uniform(0.06, 0.16) * fine)[..., None]).astype(np.float32)
    detail = _DETAILS.get(kind)
    if detail is not None:
        image = detail(np.ascontiguousarray(image), base, colours, random)
    return np.clip(255 * image, 0, 255).astype(np.uint8)


def _grain(coarsest: int, random: np.random.Generator) -> np.ndarray:
    """Noise that repeats without a seam, ``[1024, 1024]``."""
    half = noise(PIXELS // 2, max(2, coarsest // 2), random, 0.75)
    return cv2.resize(np.block([[half, half[:, ::-1]], [half[::-1], half[::-1, ::-1]]]), (PIXELS, PIXELS))


def _marks(image: np.ndarray, count: int, reach: int, spread: tuple[float, float], random: np.random.Generator) -> None:
    """Draw short strokes such as blades and twigs, darker and brighter than the ground."""
    places = random.integers(0, PIXELS, (count, 2))
    ends = places + random.integers(-reach, reach + 1, (count, 2))
    tones = random.uniform(*spread, count)
    colours = image[places[:, 1], places[:, 0]] * tones[:, None]
    for start, end, colour in zip(places.tolist(), ends.tolist(), colours.tolist(), strict=True):
        cv2.line(image, start, end, colour, 1)


def _pebbles(
    image: np.ndarray, count: int, sizes: tuple[int, int], tint: np.ndarray, random: np.random.Generator
) -> None:
    places = random.integers(0, PIXELS, (count, 2)).tolist()
    radii = random.integers(*sizes, count).tolist()
    colours = (tint * random.uniform(0.6, 1.35, (count, 1)) * random.uniform(0.93, 1.07, (count, 3))).tolist()
    for place, radius, colour in zip(places, radii, colours, strict=True):
        cv2.circle(image, place, radius, colour, -1)


def _meadow(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    dry = np.clip(_grain(10, random) - 0.1, 0, 1)[..., None]
    image += 0.7 * dry * (colours.shifted(np.array([0.66, 0.60, 0.36])) - image).astype(np.float32)
    _marks(image, 9000, 7, (0.65, 1.35), random)
    if random.random() < 0.35:
        _pebbles(image, 700, (0, 2), colours.colour(((0.9, 0.85, 0.3), (0.9, 0.9, 0.92), (0.6, 0.4, 0.7))), random)
    return image


def _soil(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    _pebbles(image, int(random.integers(800, 6000)), (0, 4), base, random)
    return image


def _forest(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    leaf = colours.colour(((0.55, 0.33, 0.12), (0.45, 0.28, 0.12), (0.62, 0.48, 0.18), (0.35, 0.33, 0.15)))
    for x, y, turn, tone in random.random((9000, 4)):
        colour = (leaf * (0.5 + 0.9 * tone)).tolist()
        centre = (int(x * PIXELS), int(y * PIXELS))
        cv2.ellipse(image, centre, (5, 2), 360.0 * turn, 0, 360, colour, -1)
    _marks(image, 900, 18, (0.5, 0.8), random)
    return image


def _gravel(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    _pebbles(image, 22_000, (1, int(random.integers(3, 7))), base, random)
    return image


def _sand(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS * 2 * np.pi
    turn = int(random.integers(0, 3))
    ripples = np.sin(int(random.integers(20, 60)) * y + turn * x + 2.5 * _grain(4, random))
    return image * (1.0 + random.uniform(0.0, 0.1) * ripples[..., None]).astype(np.float32)


def _mud(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    glossy = np.clip(2.0 * _grain(16, random) - 0.9, 0, 1)[..., None]
    return image * 0.9 + (0.5 * glossy * np.array([0.55, 0.6, 0.66])).astype(np.float32)


def _snow(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    image = base.astype(np.float32) + 0.25 * (image - base.astype(np.float32))
    if random.random() < 0.4:
        bare = np.clip(2.5 * (_grain(14, random) - 0.6), 0, 1)[..., None]
        image = image + bare * (colours.shifted(np.array([0.4, 0.36, 0.24])) - image).astype(np.float32)
    return image.astype(np.float32)


def _ice(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    image = (base + 0.5 * (image - base)).astype(np.float32)
    _marks(image, 220, 90, (1.1, 1.3), random)
    return image


def _asphalt(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    _pebbles(image, 15_000, (0, 2), base, random)
    _marks(image, int(random.integers(0, 90)), 70, (0.4, 0.6), random)
    if random.random() < 0.4:
        image[:, 500:512] = colours.colour(((0.88, 0.87, 0.84), (0.85, 0.7, 0.2)))
    return image


def _slabs(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    edge = int(random.choice([102, 146, 205, 341]))
    count = -(-PIXELS // edge)
    tone = random.uniform(0.88, 1.1, (count, count))
    y, x = np.mgrid[:PIXELS, :PIXELS]
    image = image * tone[y // edge, x // edge][..., None].astype(np.float32)
    image[(y % edge < 3) | (x % edge < 3)] *= 0.6
    return image


def _paving(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    height = int(random.choice([8, 12, 20, 32]))
    length = int(height * random.choice([1, 2, 2]))
    y, x = np.mgrid[:PIXELS, :PIXELS]
    row = y // height
    across = x + (row % 2) * (length // 2)
    tone = random.uniform(0.75, 1.25, (PIXELS // height + 1, 2 * PIXELS // length + 2))[row, across // length]
    image = image * tone[..., None].astype(np.float32)
    image[(y % height < 2) | (across % length < 2)] *= 0.55
    return image


def _wet(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    """Dark ground with puddles that mirror the sky."""
    puddles = np.clip(6.0 * (_grain(8, random) - random.uniform(0.2, 0.6)), 0, 1)[..., None]
    sky = colours.shifted(np.array([0.55, 0.62, 0.70])).astype(np.float32)
    return (image + 0.85 * puddles * (sky - image)).astype(np.float32)


def _odd(image: np.ndarray, base: np.ndarray, colours: Palette, random: np.random.Generator) -> np.ndarray:
    """Areas, stripes and grain in colours that no ground has."""
    for _ in range(int(random.integers(1, 4))):
        kind = random.choice(["areas", "stripes", "dots"])
        other = colours.colour(((0.6, 0.5, 0.4), (0.3, 0.5, 0.3), (0.5, 0.5, 0.6)))
        if kind == "areas":
            area = _grain(int(random.choice([6, 16, 48])), random) > random.uniform(-0.2, 0.5)
            image[area] = image[area] * 0.3 + 0.7 * other
        elif kind == "stripes":
            y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS
            phase = int(random.integers(1, 30)) * x + int(random.integers(1, 30)) * y + 0.4 * _grain(6, random)
            image[phase % 1.0 < random.uniform(0.2, 0.6)] *= 0.5
        else:
            _pebbles(image, int(random.integers(300, 6000)), (2, int(random.integers(4, 20))), other, random)
    return image


_DETAILS = {
    "meadow": _meadow, "soil": _soil, "forest": _forest, "gravel": _gravel, "sand": _sand, "mud": _mud, "snow": _snow,
    "ice": _ice, "asphalt": _asphalt, "concrete": _slabs, "paving": _paving, "wet": _wet, "odd": _odd,
}  # fmt: skip
