"""Samples: network input and targets for one image, with data augmentation that preserves the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from monoforce_ros.core import CameraModel, homogeneous, transform_points
from monoforce_ros.encoder import EncoderConfig, EncoderInput, assemble, feature_rays, letterbox
from monoforce_ros.training.recording_samples import RecordingSamples, Segment

MIRROR = np.diag([1.0, -1.0, 1.0])


_LUMINANCE = 0.299, 0.587, 0.114
"""Shares of red, green and blue in the brightness of a colour (ITU-R BT.601)."""
_LARGEST_NOISE = 0.03
"""Standard deviation of the ranges of common lidars (data sheets of spinning ones: up to ±3 cm) [m]."""


@dataclass(frozen=True)
class Augmentation:
    """Data augmentation of a sample that stays consistent with the calibration.

    The whole scene is mirrored or rotated about the robot; images are cropped and tilted together with their rays, and
    their colours change.
    """

    mirrored: bool = False
    turn: float = 0.0
    """Rotation of the map about the robot [rad]."""
    zoom: float = 1.0
    """Of the image crop, at least 1."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Position of the crop in the image, each -1 to 1."""
    tilt: float = 0.0
    """Rotation of the image about its centre [rad]."""
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Of red, green and blue."""
    contrast: float = 1.0
    saturation: float = 1.0
    """Share of the colours that is kept; 0 for a grey image. Beyond 1 they become more vivid."""
    exposure: float = 1.0
    """Exponent of the brightness: below 1 shadows become brighter, above 1 darker."""
    blur: float = 0.0
    """Standard deviation of the Gaussian blur [px]."""
    noise: float = 0.0
    """Standard deviation of the noise of the brightness, of 255."""
    cameras: tuple[float, ...] = ()
    """Random numbers 0..1, one for each camera; see :attr:`camera_share`."""
    camera_share: float = 1.0
    """Cameras whose number exceeds this are left out."""
    blank: bool = False
    """Whether the images show nothing: their pixels are replaced by one colour or by noise."""
    sweep_share: float = 1.0
    """Share of the sweep's points that is kept; 0 for no sweep."""
    sweep_noise: float = 0.0
    """Standard deviation of ranges beyond that of the recording [m]: lidars differ."""
    traced: bool = True
    """Whether the ground that the robot drove over is known."""
    seed: int = 0
    """Of the noise, and of which points of a sweep are kept."""

    @classmethod
    def draw(cls, random: np.random.Generator, sensor_shares: Sequence[float] | None = None) -> Augmentation:
        """A random augmentation.

        Args:
            random: source of random numbers.
            sensor_shares: shares of samples with images alone, with both and with a sweep alone, for encoders of both;
                by default nothing is left out.
        """
        sensors = {} if sensor_shares is None else _drawn_sensors(random, sensor_shares)
        brightness = random.uniform(0.7, 1.35)
        return cls(
            mirrored=bool(random.integers(2)),
            turn=random.uniform(-0.35, 0.35),
            zoom=random.uniform(1.0, 1.25),
            shift=(random.uniform(-1, 1), random.uniform(-1, 1)),
            tilt=random.uniform(-0.04, 0.04),
            gain=tuple(brightness * random.uniform(0.9, 1.1, 3)),
            contrast=random.uniform(0.75, 1.3),
            blur=max(0.0, random.uniform(-1.0, 0.9)),
            **sensors,
            saturation=random.uniform(0.2, 1.2),
            exposure=float(np.exp(random.uniform(-0.4, 0.4))),
            noise=max(0.0, random.uniform(-4.0, 6.0)),
            seed=int(random.integers(2**31)),
        )

    def image_from_view(self) -> np.ndarray:
        """Affine map ``[2, 3]`` from the augmented image to the original one, both in 0..1."""
        cosine, sine = np.cos(self.tilt), np.sin(self.tilt)
        # A tilted crop must be smaller by this factor to stay within the image.
        inner = max(0.0, 1.0 - abs(sine) - (1.0 - cosine)) if self.tilt else 1.0
        size = inner / self.zoom
        free = (1.0 - size * (cosine + abs(sine))) / 2
        middle = 0.5 + np.array(self.shift) * max(0.0, free)
        linear = size * np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([-1.0 if self.mirrored else 1.0, 1.0])
        return np.column_stack([linear, middle - linear @ np.array([0.5, 0.5])])

    def image(self, image: np.ndarray) -> np.ndarray:
        """The augmented image."""
        if self.is_none:
            return image
        if self.blank:
            return self._blank_image(image)
        height, width = image.shape[:2]
        # Pixel p lies at (p + 1/2) / size.
        scale, half = np.array([width, height], float), 0.5
        affine = self.image_from_view()
        linear = affine[:, :2] * scale[:, None] / scale[None]
        offset = scale * affine[:, 2] + linear @ np.array([half, half]) - half
        matrix = np.column_stack([linear, offset])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(image, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        if self.blur > 0.05:
            image = cv2.GaussianBlur(image, (0, 0), self.blur)
        if self.exposure != 1.0:
            image = cv2.LUT(image, (255.0 * np.linspace(0.0, 1.0, 256) ** self.exposure).round().astype(np.uint8))
        colours = image.astype(np.float32)
        brightness = colours @ np.array(_LUMINANCE, np.float32)
        offset = (1.0 - self.saturation) * brightness
        if self.noise:
            random = np.random.default_rng(self.seed)
            offset = offset + np.float32(self.noise) * random.standard_normal(offset.shape, np.float32)
        colours = (self.saturation * colours + offset[..., None] - 127.5) * self.contrast + 127.5
        return np.clip(colours * np.array(self.gain, np.float32), 0.0, 255.0).astype(np.uint8)

    def _blank_image(self, image: np.ndarray) -> np.ndarray:
        """An image of a covered, blinded or broken camera: one colour with noise."""
        random = np.random.default_rng(self.seed)
        noise = random.normal(0.0, random.choice([0.0, 4.0, 40.0]), image.shape)
        return np.clip(random.uniform(0.0, 255.0) * np.array(self.gain) + noise, 0.0, 255.0).astype(np.uint8)

    def shows(self, camera: int) -> bool:
        """Whether a camera, by its index, is kept."""
        return not self.cameras or self.cameras[camera % len(self.cameras)] <= self.camera_share

    def thinned(self, points: np.ndarray, sensor: np.ndarray) -> np.ndarray:
        """Kept points ``[n, 3]`` of a sweep measured from ``sensor`` ``[3]``, with noise: some rings, some points of
        each."""
        if self.sweep_share >= 1.0 or not len(points):
            return points
        random = np.random.default_rng(self.seed)
        offset = points - sensor
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        noise = self.sweep_noise * random.standard_normal((len(points), 1))
        points = points + offset / np.maximum(distance, 0.1) * noise
        elevation = np.degrees(np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1])))
        # Lidars have rings 1 to 8 degrees apart, or points without such an order.
        spacing, phase = random.uniform(1.0, 8.0), random.uniform(0.0, 1.0)
        ring = np.abs((elevation / spacing + phase) % 1.0 - 0.5) < 0.5 * min(1.0, 1.2 / spacing)
        if random.uniform() < 0.3:
            ring = np.ones(len(points), bool)
        return points[ring & (random.uniform(size=len(points)) < self.sweep_share)]

    @property
    def is_none(self) -> bool:
        """Whether the augmentation is the identity."""
        return self == Augmentation()


def _drawn_sensors(random: np.random.Generator, shares: Sequence[float]) -> dict[str, Any]:
    """Sensors of one sample; of images alone, some cameras or rarely all are left out."""
    kind = random.choice(["images", "both", "sweep"], p=np.array(shares) / sum(shares))
    share = {"images": 1.0, "both": 1.0, "sweep": -1.0}[str(kind)]
    return {
        "cameras": tuple(random.uniform(size=6)),
        "camera_share": share if random.uniform() < 0.7 else min(share, random.uniform(0.2, 1.0)),
        "blank": bool(random.uniform() < 0.06),
        "sweep_share": 0.0 if kind == "images" else random.uniform(0.2, 1.0),
        "sweep_noise": random.uniform(0.0, _LARGEST_NOISE),
        "traced": bool(random.uniform() < 0.5),
    }


@dataclass(frozen=True)
class Targets:
    """Target maps of a batch of ``B`` samples and the measured motion on them, in the augmented terrain frames."""

    geometric: Tensor
    """H_g* ``[B, rows, columns]`` [m]."""
    observed: Tensor
    """Cells measured by the lidar (bool)."""
    supporting: Tensor
    """H_t* [m]."""
    contact_mask: Tensor
    """Cells that wheels or tracks touched (bool), where H_t* is known."""
    friction: Tensor
    """Logarithm of the friction relative to ordinary ground [-], NaN where it is unknown."""
    depth: Tensor
    """Depth that the lidar measured along the ray of each feature of the images ``[N, feature rows, feature columns]``
    [m]; 0 where it measured none."""
    map_of: Tensor
    """Index of the map of each of the ``W`` chunks of motion."""
    positions: Tensor
    """``[W, K, 3]`` [m]."""
    rotations: Tensor
    """``[W, K, 3, 3]``."""
    velocity: Tensor
    """At the start, in terrain axes ``[W, 3]`` [m/s]."""
    angular_velocity: Tensor
    """At the start, in terrain axes ``[W, 3]`` [rad/s]."""
    twists: Tensor
    """Commands ``[W, history + T, 2]`` [m/s, rad/s]."""

    def to(self, device: torch.device | str) -> Targets:
        """The same on another device."""
        return Targets(**{f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)})

    @classmethod
    def stack(cls, targets: Sequence[Targets]) -> Targets:
        """Concatenate several batches."""
        moving = [t for t in targets if len(t.map_of)] or targets[:1]
        joined = {
            f.name: torch.cat([getattr(t, f.name) for t in (moving if f.name in _MOTION else targets)])
            for f in fields(cls)
            if f.name != "map_of"
        }
        starts = np.cumsum([0, *(len(t.geometric) for t in targets[:-1])])
        map_of = torch.cat([t.map_of + int(start) for t, start in zip(targets, starts, strict=True)])
        return cls(**joined, map_of=map_of)


_MOTION = ("positions", "rotations", "velocity", "angular_velocity", "twists")


def sample(
    recording: RecordingSamples,
    index: int,
    config: EncoderConfig,
    augmentation: Augmentation = Augmentation(),
    *,
    chunks: int = 4,
    horizon: float = 5.0,
) -> tuple[EncoderInput, Targets]:
    """Input and targets of one sample of a recording.

    Args:
        recording: its samples.
        index: index of the sample.
        config: configuration of the encoder.
        augmentation: augmentation of the sample.
        chunks: largest number of chunks of motion to roll out.
        horizon: time after the image over which they are spread [s].
    """
    terrain_from_odometry = np.linalg.inv(_odometry_from_terrain(recording, index, augmentation))
    affine = None if augmentation.is_none else augmentation.image_from_view()
    everything = transform_points(terrain_from_odometry, recording.sweep(index))
    rays, origins, images, depths = [], [], [], []
    shape = (config.feature_rows, config.feature_columns)
    for number, camera in enumerate(recording.cameras if config.takes_images else ()):
        if not augmentation.shows(number) or not np.isfinite(recording.odometry_from_cameras[index, number]).all():
            continue
        placed = terrain_from_odometry @ recording.odometry_from_cameras[index, number]
        directions = feature_rays(camera, *shape, affine) @ placed[:3, :3].T
        rays.append(directions)
        origins.append(placed[:3, 3])
        images.append(augmentation.image(recording.images[index, number].numpy()))
        depths.append(measured_depth(everything, camera, placed, shape, affine))
    support = transform_points(terrain_from_odometry, recording.support[index])
    sweep, trace = None, None
    if config.takes_sweeps and augmentation.sweep_share > 0.0:
        # The height of the lidar is not recorded; half a metre above the base is near enough to tell rings apart.
        sweep = augmentation.thinned(everything, np.array([0.0, 0.0, 0.5]))
    if augmentation.traced:
        trace = transform_points(terrain_from_odometry, recording.trace(index))
    batch = assemble(images, rays, origins, support, config, sweep=sweep, trace=trace)
    found = targets(recording, index, config, augmentation, chunks=chunks, horizon=horizon)
    depth = np.stack(depths) if depths else np.zeros((0, *shape), np.float32)
    return batch, replace(found, depth=torch.from_numpy(depth))


def measured_depth(
    points: np.ndarray,
    camera: CameraModel,
    terrain_from_camera: np.ndarray,
    shape: tuple[int, int],
    view_from_crop: np.ndarray | None = None,
) -> np.ndarray:
    """Smallest depth of lidar points that project into each feature of an image.

    Args:
        points: ``[n, 3]`` in the terrain frame [m].
        camera: model of the original image.
        terrain_from_camera: pose ``[4, 4]`` of the camera; left-handed if the scene is mirrored.
        shape: rows and columns of the features.
        view_from_crop: crop of the letterboxed image; see :func:`monoforce_ros.encoder.feature_rays`.

    Returns:
        ``[rows, columns]`` float32 [m] along the optical axis; 0 without a point.
    """
    rows, columns = shape
    local = transform_points(np.linalg.inv(terrain_from_camera), points)
    pixels, visible = camera.project(local)
    depth = np.full(rows * columns, np.inf, np.float32)
    if visible.any():
        place = (pixels[visible] + 0.5) / [camera.width, camera.height]
        for affine in (letterbox(camera.width, camera.height, columns / rows), view_from_crop):
            if affine is not None:
                place = np.linalg.solve(affine[:, :2], (place - affine[:, 2]).T).T
        column, row = np.floor(place[:, 0] * columns).astype(int), np.floor(place[:, 1] * rows).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        np.minimum.at(depth, (row * columns + column)[inside], local[visible][inside, 2].astype(np.float32))
    return np.where(np.isfinite(depth), depth, 0.0).reshape(rows, columns)


def targets(
    recording: RecordingSamples,
    index: int,
    config: EncoderConfig,
    augmentation: Augmentation = Augmentation(),
    *,
    chunks: int = 4,
    horizon: float = 5.0,
) -> Targets:
    """Targets of one sample, without its images; see :func:`sample`."""
    pose = _odometry_from_terrain(recording, index, augmentation)
    maps = _maps(recording.segments[recording.segment_of[index]], pose, config)
    motion = _motion(recording, index, np.linalg.inv(pose), augmentation.mirrored, chunks, horizon)
    no_depth = {"depth": np.zeros((0, config.feature_rows, config.feature_columns), np.float32)}
    return Targets(**{name: torch.from_numpy(value) for name, value in (maps | motion | no_depth).items()})


def _odometry_from_terrain(recording: RecordingSamples, index: int, augmentation: Augmentation) -> np.ndarray:
    """Pose of a sample's augmented terrain frame ``[4, 4]``, left-handed if the scene is mirrored."""
    base = recording.odometry_from_base[index]
    heading = np.arctan2(base[1, 0], base[0, 0]) + augmentation.turn
    cosine, sine = np.cos(heading), np.sin(heading)
    mirror = MIRROR if augmentation.mirrored else np.eye(3)
    level = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return homogeneous(level @ mirror, base[:3, 3])


def _maps(segment: Segment, odometry_from_terrain: np.ndarray, config: EncoderConfig) -> dict[str, np.ndarray]:
    """The segment's maps resampled on the sample's grid."""
    grid = config.grid
    x, y = np.meshgrid(grid.x, grid.y)
    centres = np.stack([x, y, np.zeros_like(x)], axis=-1)
    turn = np.linalg.inv(segment.odometry_from_map) @ odometry_from_terrain
    in_segment = transform_points(turn, centres)
    columns = ((in_segment[..., 0] - segment.grid.origin[0]) / segment.grid.resolution).astype(np.float32)
    rows = ((in_segment[..., 1] - segment.grid.origin[1]) / segment.grid.resolution).astype(np.float32)

    def heights(values: np.ndarray) -> np.ndarray:
        resampled = cv2.remap(values, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return (resampled - turn[2, 3]).astype(np.float32)[None]

    def mask(values: np.ndarray) -> np.ndarray:
        resampled = cv2.remap(
            values.astype(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        return (resampled > 0)[None]

    def nearest(values: np.ndarray) -> np.ndarray:
        return cv2.remap(
            values.astype(np.float32), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )  # fmt: skip

    return {
        "geometric": heights(segment.geometric),
        "observed": mask(segment.observed),
        "supporting": heights(segment.supporting),
        "contact_mask": mask(segment.contact_mask),
        "friction": np.log(nearest(segment.friction)).astype(np.float32)[None],
    }


def _motion(
    recording: RecordingSamples,
    index: int,
    terrain_from_odometry: np.ndarray,
    mirrored: bool,
    count: int,
    horizon: float,
) -> dict[str, np.ndarray]:
    """Chunks of motion after the image, in the augmented frame."""
    chunks = recording.chunks
    after = (chunks.stamps - recording.stamps[index]) * 1e-9
    usable = np.flatnonzero((after >= 0) & (after <= horizon - chunks.times[-1]))
    if len(usable) > count:
        usable = usable[np.linspace(0, len(usable) - 1, count).round().astype(int)]
    turn, mirror = terrain_from_odometry[:3, :3], MIRROR if mirrored else np.eye(3)
    rotations = turn @ chunks.rotations[usable] @ mirror
    # Angular velocity is a pseudovector: a reflection also flips its sign.
    handedness = -1.0 if mirrored else 1.0
    # A mirror image turns the other way, and moves to the other side.
    mirrored_twist = np.array([1.0, handedness, handedness], np.float32)
    angular_velocities = chunks.angular_velocities[usable] @ mirror * handedness
    return {
        "map_of": np.zeros(len(usable), np.int64),
        "positions": transform_points(terrain_from_odometry, chunks.positions[usable]).astype(np.float32),
        "rotations": rotations.astype(np.float32),
        "velocity": np.einsum("wij,wj->wi", rotations[:, 0], chunks.velocities[usable] @ mirror).astype(np.float32),
        "angular_velocity": np.einsum("wij,wj->wi", rotations[:, 0], angular_velocities).astype(np.float32),
        "twists": chunks.twists[usable] * mirrored_twist[: chunks.twists.shape[-1]],
    }
