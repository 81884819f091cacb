"""Sky: clouds, colours and silhouettes on the horizon of a randomised world."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np

from monoforce_ros.synthetic.paint import Light
from monoforce_ros.synthetic.textures import noise
from monoforce_ros.synthetic.varied.palette import from_hsv

_PIXELS = 192
# Zenith and horizon by kind of sky.
_COLOURS = {
    "day": ((0.22, 0.45, 0.80), (0.78, 0.85, 0.92)),
    "overcast": ((0.62, 0.65, 0.68), (0.80, 0.81, 0.82)),
    "sunset": ((0.30, 0.34, 0.55), (0.95, 0.66, 0.42)),
    "dusk": ((0.08, 0.11, 0.22), (0.32, 0.33, 0.42)),
}


def draw_light(drawn: SimpleNamespace, random: np.random.Generator) -> Light:
    """Sun and haze of the drawn settings of :class:`monoforce_ros.synthetic.varied.settings.LightSettings`."""
    flat = np.cos(drawn.sun_elevation)
    to_sun = np.array([flat * np.cos(drawn.sun_azimuth), flat * np.sin(drawn.sun_azimuth), np.sin(drawn.sun_elevation)])
    _, horizon = sky_colours(drawn.sky, random)
    dim = {"dusk": 0.45, "overcast": 0.7}.get(drawn.sky, 1.0)
    warm = np.array([1.0 + 0.12 * drawn.warmth, 1.0, 1.0 - 0.2 * drawn.warmth])
    # Without visible shadows the sun is behind clouds.
    share = 1.0 if drawn.shadows else 0.45
    sun = np.clip(share * dim * drawn.sun * warm, 0.0, 1.2)
    ambient = np.clip((drawn.ambient + (0.25 if not drawn.shadows else 0.0)) * max(dim, 0.6) / warm, 0.0, 1.0)
    end = drawn.visibility
    return Light(to_sun, tuple(sun), tuple(ambient), tuple(horizon), 0.15 * end, end)


def sky_colours(kind: str, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Colours ``[3]`` of the zenith and of the horizon."""
    if kind == "odd":
        return (
            from_hsv(random.random(), random.uniform(0.1, 0.9), random.uniform(0.1, 1.0)),
            from_hsv(random.random(), random.uniform(0.0, 0.6), random.uniform(0.4, 1.0)),
        )
    zenith, horizon = (np.array(colour) for colour in _COLOURS[kind])
    shift = random.uniform(0.85, 1.15, 3)
    return np.clip(zenith * shift, 0, 1), np.clip(horizon * shift, 0, 1)


def paint_sky(drawn: SimpleNamespace, light: Light, random: np.random.Generator) -> np.ndarray:
    """Six faces of the sky ``[6 * n, n, 3]`` uint8 in MuJoCo's order."""
    zenith, _ = sky_colours(drawn.sky, random)
    horizon = np.array(light.haze)
    middle = (np.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1
    across, down = np.meshgrid(middle, middle)
    one = np.ones_like(across)
    # OpenGL's cube: right, left, up, down, front, back, with y upwards.
    faces = [
        (one, -down, -across), (-one, -down, across), (across, one, down), (across, -one, -down), (across, -down, one),
        (-across, -down, -one),
    ]  # fmt: skip
    clouds, hills = noise(512, 8, random, 0.62), noise(256, 6, random, 0.6)
    sharp = random.random() < 0.4
    distant = horizon * random.uniform(0.45, 0.95)
    steepness = random.uniform(0.3, 0.9)
    images = []
    for face in faces:
        direction = np.stack(face, axis=-1)
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        rise = np.clip(direction[..., 1], 0.0, 1.0)
        colour = horizon + (rise**steepness)[..., None] * (zenith - horizon)
        scale = 60.0 / (rise + 0.25)
        u, v = (256 + scale * direction[..., axis] for axis in (0, 2))
        cover = cv2.remap(
            clouds, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        cover = np.clip((cover - 1.0 + 1.6 * drawn.cloudiness) * 1.2, 0.0, 1.0) * np.clip(rise * 6.0, 0.0, 1.0)
        white = np.clip(1.15 * horizon + 0.1, 0, 1)
        colour = colour + 0.9 * cover[..., None] * (white - colour)
        # MuJoCo's sky has y upwards and the world's y axis along -z.
        to_sun = np.array([light.to_sun[0], light.to_sun[2], -light.to_sun[1]])
        glow = np.clip(direction @ to_sun, 0, 1)
        strength = 1.0 if drawn.shadows else 0.25
        colour = colour + strength * (0.35 * glow**40 + 1.0 * glow**900)[..., None] * np.array([1.0, 0.95, 0.85])
        bearing = np.arctan2(direction[..., 2], direction[..., 0]) / (2 * np.pi) * 256 % 256
        profile = hills[128] + 0.5 * (hills[64] if not sharp else np.round(2 * hills[64]))
        top = drawn.horizon * np.clip(0.5 + profile, 0.0, 2.0)
        height = np.interp(bearing, np.arange(257), np.append(top, top[0]))
        below = direction[..., 1] < np.sin(height)
        colour[below] = distant
        images.append(colour)
    return np.clip(255 * np.concatenate(images), 0, 255).astype(np.uint8)
