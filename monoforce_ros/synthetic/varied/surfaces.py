"""Surfaces: images of walls, boxes, vehicles, rocks and trunks."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from monoforce_ros.synthetic.textures import noise
from monoforce_ros.synthetic.varied import palette
from monoforce_ros.synthetic.varied.palette import Palette

PIXELS = 256

Painter = Callable[[Palette, np.random.Generator], np.ndarray]


def surface(material: str, colours: Palette, random: np.random.Generator) -> np.ndarray:
    """An image ``[256, 256, 3]`` uint8 of a metre of a material, or of a random pattern instead.

    Args:
        material: one of :data:`MATERIALS`.
        colours: colours of the world.
        random: generator of the pattern.
    """
    choices = MATERIALS[material]
    if colours.has_random_pattern():
        choices = tuple(PATTERNS)
    pattern = PATTERNS[choices[int(random.integers(len(choices)))]]
    image = pattern(colours, random)
    # Dirt and weather differ between objects of one material.
    image = image * (1.0 + random.uniform(0.0, 0.22) * noise(PIXELS, 3, random))[..., None]
    if random.random() < 0.25:
        moss = _step(noise(PIXELS, 5, random, 0.7), 0.4, 0.8)[..., None]
        image = image + random.uniform(0.2, 0.7) * moss * (np.array([0.25, 0.33, 0.14]) - image)
    return np.clip(255 * image, 0, 255).astype(np.uint8)


def _plain(colours: Palette, random: np.random.Generator) -> np.ndarray:
    return np.broadcast_to(colours.colour(palette.PAINT_COLOURS), (PIXELS, PIXELS, 3)).copy()


def _plaster(colours: Palette, random: np.random.Generator) -> np.ndarray:
    grain = noise(PIXELS, 32, random, 0.85) * random.uniform(0.03, 0.15)
    return colours.colour(palette.CONCRETE_COLOURS) * (1.0 + grain)[..., None]


def _courses(rows: int, columns: int, stagger: float, joint: float, random: np.random.Generator) -> tuple:
    """Tone of the brick at each pixel ``[n, n]``, and the joints' mask."""
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS
    row = np.floor(y * rows).astype(int) % rows
    across = x * columns + stagger * (row % 2)
    column = np.floor(across).astype(int) % (columns + 1)
    tone = random.uniform(0.78, 1.18, (rows, columns + 1))[row, column]
    joints = ((y * rows) % 1.0 < joint) | (across % 1.0 < joint * columns / rows)
    return tone, joints


def _bricks(colours: Palette, random: np.random.Generator) -> np.ndarray:
    rows = int(random.choice([6, 8, 12]))
    tone, joints = _courses(rows, max(2, rows // 2), 0.5, random.uniform(0.06, 0.16), random)
    image = colours.colour(palette.BRICK_COLOURS) * (tone * (1.0 + 0.1 * noise(PIXELS, 32, random, 0.8)))[..., None]
    return np.where(joints[..., None], colours.colour(palette.CONCRETE_COLOURS), image)


def _blocks(colours: Palette, random: np.random.Generator) -> np.ndarray:
    rows = int(random.choice([2, 3, 4]))
    tone, joints = _courses(rows, max(1, rows - 1), float(random.choice([0.0, 0.5])), 0.05, random)
    image = colours.colour(palette.CONCRETE_COLOURS) * (tone * (1.0 + 0.12 * noise(PIXELS, 16, random, 0.8)))[..., None]
    return np.where(joints[..., None], 0.6 * image, image)


def _stones(colours: Palette, random: np.random.Generator) -> np.ndarray:
    """Irregular stones with joints between them (a Voronoi pattern)."""
    count = int(random.integers(12, 60))
    seeds = random.integers(0, PIXELS, (count, 2))
    # The image repeats, so the stones' seeds do.
    free = np.ones((2 * PIXELS, 2 * PIXELS), np.uint8)
    for row in (0, PIXELS):
        for column in (0, PIXELS):
            free[seeds[:, 1] + row, seeds[:, 0] + column] = 0
    _, labels = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    window = np.s_[PIXELS // 2 : 3 * PIXELS // 2, PIXELS // 2 : 3 * PIXELS // 2]
    labels = labels[window]
    tone = random.uniform(0.7, 1.25, int(labels.max()) + 1)[labels]
    edges = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    image = colours.colour(palette.STONE_COLOURS) * tone[..., None]
    image = np.where(edges[..., None], 0.45 * image, image)
    return image * (1.0 + 0.12 * noise(PIXELS, 32, random, 0.8))[..., None]


def _planks(colours: Palette, random: np.random.Generator) -> np.ndarray:
    count = int(random.integers(4, 12))
    across = np.arange(PIXELS) * count // PIXELS
    tone = random.uniform(0.75, 1.2, count)[across]
    grain = cv2.resize(random.standard_normal((6, 128)).astype(np.float32), (PIXELS, PIXELS))
    image = colours.colour(palette.WOOD_COLOURS) * (tone[None] * (1.0 + 0.12 * grain))[..., None]
    image[:, (np.arange(PIXELS) * count) % PIXELS < 1.2 * count] *= 0.45
    return np.rot90(image).copy() if random.random() < 0.5 else image


def _corrugated(colours: Palette, random: np.random.Generator) -> np.ndarray:
    waves = 1.0 + 0.28 * np.sin(np.arange(PIXELS) / PIXELS * 2 * np.pi * int(random.integers(5, 16)))
    image = colours.colour(palette.PAINT_COLOURS) * np.ones((PIXELS, 1, 1)) * waves[None, :, None]
    rust = _step(noise(PIXELS, 6, random, 0.75), random.uniform(0.3, 1.2), 1.6)[..., None]
    return image + rust * (np.array([0.42, 0.22, 0.11]) - image)


def _stripes(colours: Palette, random: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS
    angle = random.choice([0.0, 0.25, 0.5, 0.75]) * np.pi
    phase = (x * np.cos(angle) + y * np.sin(angle)) * int(random.integers(2, 9))
    first, second = colours.colour(palette.PAINT_COLOURS), colours.colour(palette.PAINT_COLOURS)
    return np.where((phase % 1.0 < random.uniform(0.25, 0.75))[..., None], first, second)


def _checker(colours: Palette, random: np.random.Generator) -> np.ndarray:
    count = int(random.integers(2, 9))
    y, x = np.mgrid[:PIXELS, :PIXELS] * count // PIXELS
    first, second = colours.colour(palette.PAINT_COLOURS), colours.colour(palette.PAINT_COLOURS)
    return np.where(((x + y) % 2 == 0)[..., None], first, second)


def _blotches(colours: Palette, random: np.random.Generator) -> np.ndarray:
    """Camouflage, rust, graffiti: areas of two to four colours with irregular borders."""
    image = np.broadcast_to(colours.colour(palette.STONE_COLOURS), (PIXELS, PIXELS, 3)).copy()
    for _ in range(int(random.integers(1, 4))):
        area = noise(PIXELS, int(random.choice([3, 6, 12])), random, 0.6) > random.uniform(-0.1, 0.5)
        image[area] = colours.colour(palette.PAINT_COLOURS)
    return image


def _rough_stone(colours: Palette, random: np.random.Generator) -> np.ndarray:
    grain, stain = noise(PIXELS, 16, random, 0.8), noise(PIXELS, 4, random, 0.6)
    image = colours.colour(palette.STONE_COLOURS) * (1.0 + 0.2 * grain + 0.15 * stain)[..., None]
    lichen = _step(noise(PIXELS, 10, random, 0.75), 0.55, 0.8)[..., None]
    return image + 0.45 * lichen * (np.array([0.62, 0.62, 0.42]) - image)


def _bark(colours: Palette, random: np.random.Generator) -> np.ndarray:
    furrows = cv2.resize(random.standard_normal((8, 48)).astype(np.float32), (PIXELS, PIXELS))
    grain = 0.22 * furrows + 0.12 * noise(PIXELS, 32, random, 0.8)
    return colours.colour(palette.WOOD_COLOURS) * (1.0 + grain)[..., None]


def _foliage(colours: Palette, random: np.random.Generator) -> np.ndarray:
    """Ivy or a painted hedge: leaves in several greens, dark between them."""
    green = colours.colour(((0.28, 0.44, 0.14), (0.40, 0.48, 0.18), (0.55, 0.45, 0.18)))
    image = np.broadcast_to(0.3 * green, (PIXELS, PIXELS, 3)).astype(np.float32).copy()
    for x, y, tone, turn in random.uniform(0, 1, (700, 4)):
        centre = (int(x * PIXELS), int(y * PIXELS))
        colour = tuple(float(v) for v in green * (0.5 + 0.8 * tone))
        cv2.ellipse(image, centre, (9, 5), 360.0 * turn, 0, 360, colour, -1)
    return image


PATTERNS: dict[str, Painter] = {
    "plain": _plain, "plaster": _plaster, "bricks": _bricks, "blocks": _blocks, "stones": _stones, "planks": _planks,
    "corrugated": _corrugated, "stripes": _stripes, "checker": _checker, "blotches": _blotches, "stone": _rough_stone,
    "bark": _bark, "foliage": _foliage,
}  # fmt: skip
MATERIALS: dict[str, tuple[str, ...]] = {
    "wall": ("bricks", "blocks", "stones", "plaster", "planks", "plain", "corrugated", "foliage"),
    "kerb": ("plaster", "blocks", "stone", "stripes"),
    "fence": ("planks", "plain", "bark"),
    "post": ("plain", "stripes", "bark", "planks", "plaster", "stone"),
    "rock": ("stone", "stone", "blotches"),
    "wood": ("bark", "planks"),
    "box": ("planks", "plain", "corrugated", "blotches", "checker", "plaster"),
    "vehicle": ("plain", "plain", "blotches", "corrugated"),
    "any": tuple(PATTERNS),
}
"""Patterns that a material may have."""


def _step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
