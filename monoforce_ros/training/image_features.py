"""ImageFeatures: what a frozen backbone says of training images, computed once and read many times."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from monoforce_ros.core import atomic_path
from monoforce_ros.encoder import EncoderInput, TerrainEncoder
from monoforce_ros.training.recording_samples import MAXIMUM_BYTES, RecordingSamples, SamplesError
from monoforce_ros.training.samples import Augmentation, Targets, sample

FEATURES_VERSION = 1
_BATCH = 4
"""Samples that pass the backbone together."""


@dataclass(frozen=True)
class ImageFeatures:
    """Features and measured depths of ``N`` images; 0.24 MB an image of 320 × 240 pixels."""

    fine: Tensor
    """Of the backbone at stride 8 ``[N, channels, rows, columns]`` bfloat16."""
    coarse: Tensor
    """Of the backbone at stride 16 ``[N, channels, rows / 2, columns / 2]`` bfloat16."""
    lifted: Tensor
    """That the encoder lifted into the map when these were computed ``[N, C, rows, columns]`` bfloat16."""
    rays: Tensor
    """``[N, rows, columns, 3]``, as in :class:`~monoforce_ros.encoder.EncoderInput`."""
    origins: Tensor
    """``[N, 3]`` [m], likewise."""
    depth: Tensor
    """Measured along each feature's ray ``[N, rows, columns]`` [m]; 0 where none was measured."""

    def __len__(self) -> int:
        return len(self.fine)

    def select(self, index: Tensor) -> ImageFeatures:
        """Some of the images, in float32."""
        return ImageFeatures(**{f.name: getattr(self, f.name)[index].float() for f in fields(self)})

    @classmethod
    def stack(cls, parts: Sequence[ImageFeatures]) -> ImageFeatures:
        """The images of all parts."""
        return cls(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)})


def image_features(
    encoder: TerrainEncoder,
    recordings: Sequence[RecordingSamples],
    folder: Path,
    *,
    variants: int = 1,
    seed: int = 1,
    report: Callable[[int], None] = lambda done: None,
) -> ImageFeatures:
    """Features of all images of recordings, each in a few augmented variants, read from ``folder`` where they are.

    A file of features holds for one recording, variant and encoder; others are computed anew.

    Args:
        encoder: its backbone computes the features; put into evaluation mode.
        recordings: recordings with images.
        folder: keeps the files.
        variants: number of variants of each image; 0 for the images as they are.
        seed: of the augmentations.
        report: called with the number of recordings that are done.

    Raises:
        SamplesError: a file is damaged, or there is no image.
    """
    encoder.eval()
    weights = _digest(encoder)
    parts = []
    for done, recording in enumerate(recordings, start=1):
        for variant in range(max(variants, 1)):
            content = [FEATURES_VERSION, recording.name, _content(recording), weights,
                       variant if variants else -1, seed if variants else -1]  # fmt: skip
            digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]
            file = folder / f"features-{digest}.safetensors"
            if not file.is_file():
                random = np.random.default_rng([seed, variant, *recording.name.encode()]) if variants else None
                _save(_computed(encoder, recording, random), file)
            parts.append(_read(file, encoder))
        report(done)
    if not sum(map(len, parts)):
        raise SamplesError(f"{len(recordings)} recordings: got no image, expected some to learn depth from")
    return ImageFeatures.stack(parts)


def _content(recording: RecordingSamples) -> str:
    """Hash of a recording's images, at a sixteenth of their size, of where its cameras and the ground were, and of the
    sweeps that depths are measured by."""
    found = hashlib.sha256(str(list(recording.images.shape)).encode())
    found.update(recording.images[..., ::16, ::16].contiguous().numpy().tobytes())
    for name in ("odometry_from_cameras", "odometry_from_base", "support", "sweeps", "sweep_ends"):
        found.update(np.ascontiguousarray(getattr(recording, name)).tobytes())
    found.update(repr(recording.cameras).encode())
    return found.hexdigest()


@torch.no_grad()
def _computed(
    encoder: TerrainEncoder, recording: RecordingSamples, random: np.random.Generator | None
) -> ImageFeatures:
    found: list[ImageFeatures] = []
    for start in range(0, len(recording), _BATCH):
        samples = [
            sample(recording, i, encoder.config, Augmentation() if random is None else Augmentation.draw(random),
                   chunks=1)
            for i in range(start, min(start + _BATCH, len(recording)))
        ]  # fmt: skip
        batch = EncoderInput.stack([entry[0] for entry in samples])
        depth = Targets.stack([entry[1] for entry in samples]).depth
        if not len(batch.images):
            continue
        fine, coarse = encoder.image_features(batch.images.contiguous(memory_format=torch.channels_last))
        _, lifted = encoder.lifted(fine, coarse, batch.rays, batch.origins)
        found.append(
            ImageFeatures(
                fine=fine.to(torch.bfloat16).contiguous(),
                coarse=coarse.to(torch.bfloat16).contiguous(),
                lifted=lifted.to(torch.bfloat16).contiguous(),
                rays=batch.rays,
                origins=batch.origins,
                # What a lens does not show has no depth.
                depth=torch.where(batch.seen, depth, 0.0),
            )
        )
    return ImageFeatures.stack(found) if found else _empty(encoder)


def _empty(encoder: TerrainEncoder) -> ImageFeatures:
    return ImageFeatures(**{name: torch.zeros(0, *shape) for name, shape in _shapes(encoder).items()})


def _shapes(encoder: TerrainEncoder) -> dict[str, tuple[int, ...]]:
    """Shape of each array for one image."""
    config = encoder.config
    rows, columns = config.feature_rows, config.feature_columns
    fine, coarse = encoder.backbone_channels
    return {
        "fine": (fine, rows, columns), "coarse": (coarse, rows // 2, columns // 2),
        "lifted": (config.image_features, rows, columns), "rays": (rows, columns, 3), "origins": (3,),
        "depth": (rows, columns),
    }  # fmt: skip


def _save(features: ImageFeatures, file: Path) -> None:
    with atomic_path(file) as unfinished:
        save_file({f.name: getattr(features, f.name).contiguous() for f in fields(features)}, str(unfinished))


def _read(file: Path, encoder: TerrainEncoder) -> ImageFeatures:
    if file.stat().st_size > MAXIMUM_BYTES:
        raise SamplesError(f"{file}: got {file.stat().st_size} bytes, expected at most {MAXIMUM_BYTES}")
    try:
        with safe_open(str(file), framework="pt") as content:
            found = ImageFeatures(**{f.name: content.get_tensor(f.name) for f in fields(ImageFeatures)})
    except (SafetensorError, OSError) as error:
        raise SamplesError(f"{file}: damaged ({error}); delete it to recreate it") from error
    for name, shape in _shapes(encoder).items():
        got = tuple(getattr(found, name).shape)
        if got != (len(found), *shape):
            raise SamplesError(f"{file}: {name}: got shape {got}, expected {shape} for each image; delete the file")
    return found


def _digest(encoder: TerrainEncoder) -> str:
    """Of an encoder's weights and of the size of its images."""
    found = hashlib.sha256(f"{encoder.config.image_width} {encoder.config.image_height}".encode())
    for value in encoder.state_dict().values():
        found.update(value.detach().contiguous().cpu().numpy().tobytes())
    return found.hexdigest()
