"""Imaging: exposure, white balance, noise, blur, vignetting and dirt of a camera."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np

_LEVELS = np.arange(256)
_NOISE_MARGIN = 64
# Automatic exposure: brightness that it aims at [levels of 255], its range of gains, and its change per image.
_TARGET, _GAINS, _ADAPTATION = 105.0, (0.6, 3.5), 0.08
_METERED = 8
_GREY = (0.299, 0.587, 0.114)


class Imaging:
    """What a camera does to its images; everything that is constant is computed once.

    Args:
        drawn: drawn values of :class:`monoforce_ros.synthetic.varied.settings.ImagingSettings`.
        width, height: of the images [pixels].
        random: generator of dirt and noise.
    """

    def __init__(self, drawn: SimpleNamespace, width: int, height: int, random: np.random.Generator):
        self.quality = drawn.quality
        self._random = random
        self._balance = np.array([drawn.red, 1.0, drawn.blue])
        self._compensation, self._gamma = 2.0**drawn.exposure, drawn.gamma
        self._gain: float | None = None
        grey = np.tile(np.array(_GREY), (3, 1))
        self._saturation = (drawn.saturation * np.eye(3) + (1.0 - drawn.saturation) * grey).astype(np.float32)
        self._shade, self._veil = self._lens(drawn, width, height, random)
        self._blur = drawn.blur
        self._streak = _streak(drawn.motion_blur, random)
        shape = (height + _NOISE_MARGIN, width + _NOISE_MARGIN, 3)
        # The sensor's noise is partly common to the channels after demosaicing.
        grain = 0.7 * random.standard_normal(shape, np.float32) + 0.7 * random.standard_normal(shape[:2])[..., None]
        self._noise = np.clip(np.round(drawn.noise * grain), -127, 127).astype(np.int16)

    @staticmethod
    def _lens(
        drawn: SimpleNamespace, width: int, height: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Factor ``[h, w, 3]`` and additive veil ``[h, w, 3]`` of vignetting and dirt, float32."""
        y, x = np.mgrid[:height, :width]
        radius = np.hypot(x - width / 2, y - height / 2) / np.hypot(width / 2, height / 2)
        shade = (1.0 - drawn.vignetting * radius**2.5).astype(np.float32)
        veil = np.zeros((height, width), np.float32)
        for _ in range(drawn.dirt):
            spot = np.zeros((height, width), np.float32)
            centre = (int(random.uniform(0, width)), int(random.uniform(0, height)))
            axes = (max(1, int(width * random.uniform(0.005, 0.06))), max(1, int(width * random.uniform(0.005, 0.06))))
            cv2.ellipse(spot, centre, axes, random.uniform(0, 180), 0, 360, 1.0, -1)
            blurred = cv2.GaussianBlur(spot, (0, 0), max(0.6, 0.35 * min(axes)))
            opacity = random.uniform(0.15, 0.8)
            shade *= 1.0 - opacity * blurred
            # Drops and dust scatter light, mud does not.
            veil += blurred * opacity * random.choice([10.0, 60.0, 130.0])
        return np.repeat(shade[..., None], 3, axis=2), np.repeat(veil[..., None], 3, axis=2)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The spoiled image ``[h, w, 3]`` uint8 of a perfect one."""
        if self._blur > 0.25:
            image = cv2.GaussianBlur(image, (0, 0), self._blur)
        if self._streak is not None:
            image = cv2.filter2D(image, -1, self._streak)
        image = cv2.transform(image, self._saturation)
        image = cv2.multiply(image, self._shade, dtype=cv2.CV_8U)
        image = cv2.add(image, self._veil, dtype=cv2.CV_8U)
        image = cv2.LUT(image, self._curve(image))
        top, left = self._random.integers(0, _NOISE_MARGIN, 2)
        noise = self._noise[top : top + image.shape[0], left : left + image.shape[1]]
        return cv2.add(image, noise, dtype=cv2.CV_8U)

    def _curve(self, image: np.ndarray) -> np.ndarray:
        """Response ``[1, 256, 3]`` uint8 of automatic exposure, which follows the scene slowly."""
        # The root weakens bright skies, as the metering of most cameras does.
        brightness = float(np.sqrt(image[::_METERED, ::_METERED].astype(np.float32)).mean()) ** 2
        wanted = float(np.clip(_TARGET / max(brightness, 1.0), *_GAINS))
        self._gain = wanted if self._gain is None else self._gain + _ADAPTATION * (wanted - self._gain)
        gains = self._gain * self._compensation * self._balance
        curve = np.clip(gains[None] * _LEVELS[:, None] / 255.0, 0.0, 1.0) ** self._gamma
        return np.round(255.0 * curve).astype(np.uint8)[None]


def _streak(length: float, random: np.random.Generator) -> np.ndarray | None:
    """Kernel of a blur along a line of ``length`` pixels; None below 1.5 pixels."""
    angle = random.uniform(0.0, np.pi)
    if length < 1.5:
        return None
    size = 2 * int(np.ceil(length / 2)) + 1
    kernel = np.zeros((size, size), np.float32)
    middle = size // 2
    for share in np.linspace(-0.5, 0.5, 4 * size):
        row = middle + round(share * length * np.sin(angle))
        column = middle + round(share * length * np.cos(angle))
        kernel[row, column] += 1.0
    return kernel / kernel.sum()
