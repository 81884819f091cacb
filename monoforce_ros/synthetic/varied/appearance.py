"""Appearance: colours, textures, sky and light of a randomised world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import cv2
import numpy as np

from monoforce_ros.synthetic import textures
from monoforce_ros.synthetic.paint import Paint
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.textures import tone_palette
from monoforce_ros.synthetic.varied.ground_areas import GroundAreas
from monoforce_ros.synthetic.varied.ground_tiles import ground_tile
from monoforce_ros.synthetic.varied.palette import Palette, varied_hue
from monoforce_ros.synthetic.varied.settings import PaletteSettings
from monoforce_ros.synthetic.varied.sky import draw_light, paint_sky
from monoforce_ros.synthetic.varied.surfaces import surface

_GROUND_PIXELS = 4096
# Tones of plants from left to right of their palette, by season.
_TONES = {
    "spring": ((0.42, 0.62, 0.16), (0.52, 0.70, 0.22), (0.66, 0.76, 0.30)),
    "summer": ((0.36, 0.54, 0.14), (0.50, 0.62, 0.20), (0.72, 0.72, 0.34)),
    "autumn": ((0.66, 0.50, 0.18), (0.72, 0.40, 0.14), (0.55, 0.50, 0.22)),
    "winter": ((0.52, 0.46, 0.34), (0.62, 0.56, 0.44), (0.42, 0.36, 0.26)),
}
_CEREAL = ((0.78, 0.66, 0.34), (0.84, 0.74, 0.42), (0.66, 0.56, 0.30))
_HEATH = ((0.50, 0.26, 0.42), (0.30, 0.34, 0.18), (0.60, 0.36, 0.48))
_REED = ((0.56, 0.54, 0.30), (0.70, 0.62, 0.38), (0.45, 0.52, 0.24))
_NEEDLES = ((0.12, 0.31, 0.16), (0.18, 0.40, 0.19), (0.28, 0.46, 0.20))
_TURF_KINDS = {"meadow": 0.9, "forest": 0.3, "soil": 0.25}


@dataclass(frozen=True)
class VariedAppearance:
    """How a randomised world looks; painted when images are recorded.

    Attributes:
        seed: seed of the world.
        areas: what the ground is made of.
        surfaces: kind of material by its name, for obstacles.
        plants: kind of plant by the name of its palette.
        palette: shares of natural colours.
        light: drawn settings of light and sky.
    """

    seed: int
    areas: GroundAreas
    surfaces: Mapping[str, str]
    plants: Mapping[str, str]
    palette: PaletteSettings
    light: SimpleNamespace

    def paint(self, scenery: Scenery) -> Paint:
        """Colours, sky and light of the world."""
        light = draw_light(self.light, random_stream(self.seed, "varied light colours"))
        colours = Palette(self.palette, random_stream(self.seed, "varied palette"))
        random = random_stream(self.seed, "varied ground colours")
        tiles = [ground_tile(area.look, colours, random) for area in self.areas.areas]
        ground = self._ground(scenery, tiles, light.to_sun, random)
        materials = {"ground": ground}
        random = random_stream(self.seed, "varied surfaces")
        for name, kind in self.surfaces.items():
            materials[name] = surface(kind, colours, random)
        materials["bark"] = surface("wood", colours, random)
        random = random_stream(self.seed, "varied plants")
        for name, kind in ({"grass": "grass", "broad": "bush", "conifer": "conifer"} | dict(self.plants)).items():
            materials[name] = self._tones(kind, colours, random)
        turf = np.array([_TURF_KINDS.get(area.look, 0.0) for area in self.areas.areas])[self.areas.index]
        turf = turf * (1.0 - self.areas.path) if self.light.season != "winter" else 0.0 * turf
        surroundings = tiles[0].reshape(-1, 3).mean(axis=0) / 255.0
        sky = paint_sky(self.light, light, random_stream(self.seed, "varied sky"))
        return Paint(turf, materials, sky, light, tuple(surroundings))

    def _ground(
        self, scenery: Scenery, tiles: list[np.ndarray], to_sun: np.ndarray, random: np.random.Generator
    ) -> np.ndarray:
        """The ground's colours ``[4096, 4096, 3]`` uint8: tiles by area, shaded by shadows and large stains."""
        count = _GROUND_PIXELS
        image = np.tile(tiles[0], (count // tiles[0].shape[0], count // tiles[0].shape[1], 1))
        ragged = textures.noise(count // 4, 256, random, 0.8)
        for index in range(1, len(tiles)):
            weight = cv2.resize((self.areas.index == index).astype(np.float32), (count // 4, count // 4))
            mask = cv2.resize(weight + 0.25 * ragged, (count, count)) > 0.5
            if mask.any():
                tiled = np.tile(tiles[index], (count // tiles[index].shape[0], count // tiles[index].shape[1], 1))
                cv2.copyTo(tiled, mask.astype(np.uint8), image)
        coarse = count // 4
        stains = textures.noise(coarse, 10, random, 0.6)
        shade = 1.0 + random.uniform(0.0, 0.2) * stains
        worn = cv2.resize(self.areas.path.astype(np.float32), (coarse, coarse))
        shade *= 1.0 + random.uniform(-0.4, 0.35) * worn * np.clip(0.7 + 0.5 * ragged, 0.0, 1.0)
        grown = cv2.resize(scenery.grass.canopy.heights.astype(np.float32), (coarse, coarse))
        shade *= 1.0 - 0.4 * np.clip(grown / 0.25, 0.0, 1.0)
        if self.light.shadows:
            shade *= 1.0 - random.uniform(0.35, 0.65) * textures.shadows(scenery, coarse, to_sun)
        # In whole steps of 1/128, which is four times as fast as in floating point.
        steps = cv2.resize(np.clip(128.0 * shade, 0, 255).astype(np.uint8), (count, count))
        return cv2.multiply(image, cv2.merge([steps] * 3), scale=1.0 / 128.0)

    def _tones(self, kind: str, colours: Palette, random: np.random.Generator) -> np.ndarray:
        """Palette of a kind of plant."""
        tones = np.array({"cereal": _CEREAL, "heath": _HEATH, "reed": _REED, "conifer": _NEEDLES}.get(
            kind, _TONES[self.light.season]
        ))  # fmt: skip
        if random.random() > colours.drawn.natural:
            tones = varied_hue(tones, random.random())
        tones = np.clip(tones * random.uniform(0.75, 1.2) * (1.0 + 0.15 * random.standard_normal(3)), 0.02, 1.0)
        snowy = self.light.season == "winter" and random.random() < 0.3
        dark, bright = random.uniform(0.25, 0.55), random.uniform(0.9, 1.15)
        image = tone_palette(tones, dark, bright)
        if snowy:
            image[10:] = np.clip(0.25 * image[10:] + 0.75 * 235, 0, 255).astype(np.uint8)
        return image
