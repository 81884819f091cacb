"""Textures: noise-based colours, and shadows of the sun that are painted once instead of rendered per frame."""

from __future__ import annotations

import cv2
import numpy as np

from monoforce_ros.synthetic.paint import Light, Paint
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.scenery import Scenery

TO_SUN = np.array([0.36, 0.62, 0.70]) / np.linalg.norm([0.36, 0.62, 0.70])
"""Unit vector towards the sun, in world coordinates."""
HAZE_COLOUR = (0.80, 0.86, 0.91)

_GROUND_PIXELS = 4096
_MARKS = 260_000
_SOIL = np.array([0.46, 0.35, 0.23], np.float32)
_DRY = np.array([0.66, 0.60, 0.36], np.float32)
_MEADOW = np.array([0.37, 0.50, 0.19], np.float32)
_MOSS = np.array([0.22, 0.35, 0.12], np.float32)
_MUD = np.array([0.20, 0.15, 0.11], np.float32)
_GRAVEL = np.array([0.55, 0.55, 0.56], np.float32)
_SAND = np.array([0.70, 0.58, 0.42], np.float32)


def noise(pixels: int, coarsest: int, random: np.random.Generator, fall_off: float = 0.6) -> np.ndarray:
    """Fractal noise of about -1..1, ``[pixels, pixels]``; its largest features span 1 / ``coarsest`` of the image."""
    total, weight, cells = np.zeros((pixels, pixels), np.float32), 1.0, coarsest
    while cells <= pixels:
        layer = random.standard_normal((cells, cells), np.float32)
        total += weight * cv2.resize(layer, (pixels, pixels), interpolation=cv2.INTER_CUBIC)
        weight, cells = weight * fall_off, 2 * cells
    return total / (2.0 * total.std())


def nature(scenery: Scenery, seed: int) -> Paint:
    """Colours of a world of :func:`monoforce_ros.synthetic.scenery.build_scenery`."""
    ground, turf = paint_ground(scenery, random_stream(seed, "ground colours"))
    materials = {
        "ground": ground,
        "rock": rock_texture(random_stream(seed, "rock colours")),
        "wall": wall_texture(random_stream(seed, "wall colours")),
        "bark": bark_texture(random_stream(seed, "bark colours")),
        "grass": grass_palette(),
        "broad": leaf_palette(),
        "conifer": needle_palette(),
    }
    light = Light(TO_SUN, (0.86, 0.80, 0.70), (0.40, 0.43, 0.47), HAZE_COLOUR, 8.0, 75.0)
    return Paint(turf, materials, sky_texture(random_stream(seed, "sky colours")), light)


def paint_ground(scenery: Scenery, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Paint the ground, from the worn path along the route to meadow.

    Returns:
        colours ``[row = y, column = x, rgb]`` uint8 over the whole height field, and the share of short grass in
        0..1 ``[rows, columns]`` on a coarser grid of the same extent.
    """
    count = _GROUND_PIXELS // 4
    field = scenery.ground
    steps = (np.arange(count, dtype=np.float32) + 0.5) / count * 2 * field.half_size
    x, y = np.meshgrid(field.origin[0] + steps, field.origin[1] + steps)
    fine, broad = noise(count, 128, random, 0.75), noise(count, 12, random, 0.55)

    # Vegetation is sparse along the worn path and where the broad noise is high.
    distance = scenery.route.distance(np.stack([x, y], axis=-1)).astype(np.float32)
    rut = np.exp(-(((distance - 0.29) / 0.13) ** 2))
    bare = _step(0.55 * broad + 0.25 * fine + 0.95 * np.exp(-((distance / 0.75) ** 2)) + 0.25 * rut, 0.45, 0.95)
    dry = _step(noise(count, 20, random, 0.6) + 0.3 * fine, -0.1, 0.9)
    moss = _step(noise(count, 30, random, 0.6) + 0.3 * fine, 0.3, 0.8)
    colours = np.broadcast_to(_MEADOW, (count, count, 3)).copy()
    colours = _blend(colours, _DRY, dry)
    colours = _blend(colours, _MOSS, 0.6 * moss)
    colours = _blend(colours, _SOIL * (1.0 + 0.16 * broad[..., None]), bare)
    if scenery.ramp is not None:
        built = _step(scenery.ramp.height_at(x, y) + 0.03 * fine, 0.0, 0.07)
        colours = _blend(colours, _SAND, 0.9 * built)
        bare = np.maximum(bare, built)
    for patch in scenery.patches:
        inside = _step(patch.area.edge_distance(x, y).astype(np.float32) + 0.12 * fine, -0.05, 0.12)
        colours = _blend(colours, _MUD if patch.kind == "mud" else _GRAVEL * (1.0 + 0.08 * fine[..., None]), inside)
        bare = np.maximum(bare, inside)
    colours = _blend(colours, 0.75 * _MOSS, np.clip(_resized(scenery.grass.canopy.heights, count) / 0.25, 0.0, 1.0))
    colours *= ((1.0 - 0.52 * shadows(scenery, 2 * count, TO_SUN)[::2, ::2]) * (1.0 + 0.15 * fine))[..., None]

    coarse = np.clip(255 * colours, 0, 255).astype(np.uint8)
    image = cv2.resize(coarse, (_GROUND_PIXELS, _GROUND_PIXELS), interpolation=cv2.INTER_CUBIC)
    _scatter_marks(image, bare, random)
    return cv2.GaussianBlur(image, (0, 0), 0.6), 1.0 - bare


def _scatter_marks(image: np.ndarray, bare: np.ndarray, random: np.random.Generator) -> None:
    """Draw close-up details into ``image``: pebbles on soil, blades and litter on meadow."""
    places = random.integers(8, _GROUND_PIXELS - 8, (_MARKS, 2))
    on_soil = bare[places[:, 1] // 4, places[:, 0] // 4] > random.uniform(0.2, 0.8, _MARKS)
    reach = random.integers(-6, 7, (_MARKS, 2))
    shades = random.choice([0.78, 0.88, 1.12, 1.22], _MARKS)
    colours = image[places[:, 1], places[:, 0]] * shades[:, None]
    sizes = random.integers(0, 3, _MARKS)
    marks = zip(places.tolist(), on_soil.tolist(), reach.tolist(), colours.tolist(), sizes.tolist(), strict=True)
    for (column, row), is_pebble, (right, down), colour, size in marks:
        if is_pebble:
            cv2.circle(image, (column, row), size, colour, -1)
        else:
            cv2.line(image, (column, row), (column + right, row + down), colour, 1)


def rock_texture(random: np.random.Generator) -> np.ndarray:
    """Grey stone with lichen, ``[512, 512, 3]`` uint8."""
    grain, stain = noise(512, 16, random, 0.8), noise(512, 4, random, 0.6)
    colours = np.array([0.60, 0.585, 0.56]) * (1.0 + 0.20 * grain + 0.14 * stain)[..., None]
    lichen = _step(noise(512, 10, random, 0.75), 0.55, 0.8)[..., None]
    colours += 0.45 * lichen * (np.array([0.62, 0.62, 0.42]) - colours)
    return np.clip(255 * colours, 0, 255).astype(np.uint8)


def wall_texture(random: np.random.Generator) -> np.ndarray:
    """Courses of bricks, ``[512, 512, 3]`` uint8."""
    row = np.arange(512)[:, None] // 64
    column = (np.arange(512)[None] + 64 * (row % 2)) // 128
    tone = random.uniform(0.75, 1.15, (8, 5))[row, column]
    mortar = (np.arange(512)[:, None] % 64 < 7) | ((np.arange(512)[None] + 64 * (row % 2)) % 128 < 7)
    colours = np.array([0.55, 0.29, 0.21]) * (tone * (1.0 + 0.12 * noise(512, 32, random, 0.8)))[..., None]
    colours = np.where(mortar[..., None], np.array([0.62, 0.60, 0.56]), colours)
    return np.clip(255 * colours, 0, 255).astype(np.uint8)


def bark_texture(random: np.random.Generator) -> np.ndarray:
    """Brown bark with upright furrows, ``[256, 256, 3]`` uint8."""
    furrows = cv2.resize(random.standard_normal((8, 48)).astype(np.float32), (256, 256), interpolation=cv2.INTER_CUBIC)
    colours = np.array([0.40, 0.29, 0.20]) * (1.0 + 0.22 * furrows + 0.12 * noise(256, 32, random, 0.8))[..., None]
    return np.clip(255 * colours, 0, 255).astype(np.uint8)


def tone_palette(tones: np.ndarray, dark: float, bright: float) -> np.ndarray:
    """A colour palette: tones ``[k, 3]`` from left to right, dark (top) to bright, uint8."""
    places = np.linspace(0, 1, len(tones))
    columns = np.stack([np.interp(np.linspace(0, 1, 64), places, tones[:, channel]) for channel in range(3)], axis=-1)
    levels = np.linspace(dark, bright, 16)[:, None, None]
    # Shaded colours are cooler.
    tint = 1.0 + (1.0 - np.linspace(0, 1, 16))[:, None, None] * np.array([-0.10, 0.0, 0.06])
    return np.clip(255 * columns * levels * tint, 0, 255).astype(np.uint8)


def grass_palette() -> np.ndarray:
    """Colours of blades from root to tip."""
    return tone_palette(
        np.array([[0.36, 0.56, 0.14], [0.50, 0.66, 0.20], [0.66, 0.72, 0.28], [0.84, 0.78, 0.42]]), 0.34, 1.05
    )


def leaf_palette() -> np.ndarray:
    """Colours of broad leaves from dark to bright."""
    return tone_palette(np.array([[0.25, 0.46, 0.12], [0.34, 0.56, 0.16], [0.50, 0.62, 0.20]]), 0.45, 1.15)


def needle_palette() -> np.ndarray:
    """Colours of conifers from dark to bright."""
    return tone_palette(np.array([[0.12, 0.31, 0.16], [0.18, 0.40, 0.19], [0.28, 0.46, 0.20]]), 0.45, 1.2)


def sky_texture(random: np.random.Generator, pixels: int = 256) -> np.ndarray:
    """Six faces of a sky with thin clouds, stacked ``[6 * pixels, pixels, 3]`` uint8, in MuJoCo's order."""
    across, down = np.meshgrid((np.arange(pixels) + 0.5) / pixels * 2 - 1, (np.arange(pixels) + 0.5) / pixels * 2 - 1)
    one = np.ones_like(across)
    # OpenGL's cube: right, left, up, down, front, back, with y upwards.
    faces = [
        (one, -down, -across),
        (-one, -down, across),
        (across, one, down),
        (across, -one, -down),
        (across, -down, one),
        (-across, -down, -one),
    ]
    clouds = noise(1024, 8, random, 0.62)
    images = []
    for face in faces:
        direction = np.stack(face, axis=-1) / np.linalg.norm(np.stack(face, axis=-1), axis=-1, keepdims=True)
        rise = np.clip(direction[..., 1], 0.0, 1.0)
        colour = np.array(HAZE_COLOUR) + (rise**0.55)[..., None] * (np.array([0.27, 0.50, 0.82]) - HAZE_COLOUR)
        # Clouds lie in a plane above the viewer and fade towards the horizon.
        scale = 90.0 / (rise + 0.25)
        u, v = (512 + scale * direction[..., axis] for axis in (0, 2))
        cover = cv2.remap(
            clouds, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        cover = 0.85 * _step(cover, 0.05, 1.0) * np.clip(rise * 6.0, 0.0, 1.0)
        images.append(colour + cover[..., None] * (np.array([0.98, 0.98, 0.99]) - colour))
    return np.clip(255 * np.concatenate(images), 0, 255).astype(np.uint8)


def shadows(scenery: Scenery, count: int, to_sun: np.ndarray) -> np.ndarray:
    """Shadow on the ground, 0 (lit) to 1 (dark), ``[count, count]``; ``to_sun`` is the unit vector towards the sun."""
    field = scenery.ground
    shift = -to_sun[:2] / to_sun[2]
    scale = count / (2 * field.half_size)
    shade = np.zeros((count, count), np.float32)

    def polygon(vertices: np.ndarray, level: float, target: np.ndarray) -> None:
        cast = vertices[:, :2] + shift * (vertices[:, 2:] - level)
        pixels = np.round((cast - field.origin) * scale).astype(np.int32)
        cv2.fillConvexPoly(target, cv2.convexHull(pixels), 1.0)

    for rock in scenery.rocks:
        level = float(field.height_at(rock.vertices[:, :2].mean(axis=0)))
        polygon(rock.vertices[rock.vertices[:, 2] > level - 0.02], level, shade)
    for tree in scenery.trees:
        polygon(tree.stem.vertices, float(tree.base[2]), shade)
    for obstacle in scenery.obstacles:
        for part in obstacle.parts:
            if part.is_solid and part.is_visible:
                polygon(part.shape.vertices, float(field.height_at(obstacle.position)), shade)
    crowns = np.zeros_like(shade)
    for tree in scenery.trees:
        leaves = tree.crown.vertices
        cast = leaves[:, :2] + shift * (leaves[:, 2:] - tree.base[2])
        pixels = np.round((cast - field.origin) * scale).astype(np.int32).reshape(-1, 4, 2)
        for leaf in pixels:
            cv2.fillConvexPoly(crowns, leaf, 1.0)
    # Shadows of leaves are blurred by their height; those of stones are sharp.
    shade = np.maximum(cv2.GaussianBlur(shade, (0, 0), 0.02 * scale), cv2.GaussianBlur(crowns, (0, 0), 0.05 * scale))
    canopy = _resized(scenery.grass.canopy.heights, count)
    ahead = shift * 0.2 * scale
    moved = cv2.warpAffine(canopy, np.array([[1, 0, ahead[0]], [0, 1, ahead[1]]], np.float32), (count, count))
    return np.clip(np.maximum(shade, 0.8 * np.clip(moved / 0.3, 0, 1)), 0.0, 1.0)


def _blend(colours: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    return colours + share[..., None].astype(np.float32) * (other - colours)


def _resized(grid: np.ndarray, count: int) -> np.ndarray:
    return cv2.resize(grid.astype(np.float32), (count, count), interpolation=cv2.INTER_LINEAR)


def _step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
