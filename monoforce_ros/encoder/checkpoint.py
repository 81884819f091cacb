"""Checkpoints: an encoder's weights as safetensors, with its configuration as JSON in the same folder."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch.nn import functional

from monoforce_ros.core import atomic_path, share_directory, write_text
from monoforce_ros.encoder.config import HEIGHT_CHANNELS, EncoderConfig
from monoforce_ros.encoder.lidar_encoder import LidarEncoder
from monoforce_ros.encoder.terrain_encoder import TerrainEncoder

Encoder = TerrainEncoder | LidarEncoder

MAXIMUM_BYTES = 2_000_000_000
_HOW_TO_GET_ONE = (
    "a checkpoint is a file NAME.safetensors with NAME.json in the same folder, as written by training; "
    "set `checkpoint` to its path, leave it empty for the shipped encoder, or use the terrain source "
    "`lidar_interpolation`"
)


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged or of a different network. There is no fallback to random weights."""


def shipped_checkpoint() -> Path:
    """Path of the encoder shipped with the package, trained on synthetic worlds only (docs/training.md)."""
    return share_directory() / "models" / "terrain_encoder.safetensors"


def new_encoder(config: EncoderConfig) -> Encoder:
    """An untrained encoder for the configuration's sensor."""
    return TerrainEncoder(config) if config.takes_images else LidarEncoder(config)


def save_encoder(encoder: Encoder, path: str | Path) -> None:
    """Write the weights to ``path`` (.safetensors) and the configuration (.json); each file is replaced atomically."""
    path = Path(path)
    with atomic_path(path) as unfinished:
        save_file({name: value.contiguous() for name, value in encoder.state_dict().items()}, str(unfinished))
        # safetensors creates files readable by the owner only; the node may run as another user.
        unfinished.chmod(0o644)
        # Configuration first: alone it is no checkpoint, whereas weights without one would look like a damaged one.
        write_text(path.with_suffix(".json"), json.dumps(asdict(encoder.config), indent=2))


def load_encoder(path: str | Path, sensor: str | None = None) -> Encoder:
    """Read an encoder.

    Args:
        path: path of the weights; the configuration is in the same folder. Empty for the shipped encoder.
        sensor: required input, ``camera`` or ``lidar``; any if None. An encoder of both serves either.

    Raises:
        CheckpointError: a file is missing, too large, damaged, or does not match its configuration; the message names
            the file and says how to get a working one.
    """
    path = Path(path).expanduser() if str(path) else shipped_checkpoint()
    description = path.with_suffix(".json")
    for file in (path, description):
        if not file.is_file():
            raise CheckpointError(f"encoder checkpoint {file} does not exist: {_HOW_TO_GET_ONE}")
        if file.stat().st_size > MAXIMUM_BYTES:
            raise CheckpointError(f"{file}: got {file.stat().st_size} bytes, expected at most {MAXIMUM_BYTES}")
    try:
        # Files of the first format do not name it, those of networks without scatter not their channels.
        entries = {"format": 1, "sweep_channels": HEIGHT_CHANNELS} | json.loads(description.read_text(encoding="utf-8"))
        unknown = sorted(set(entries) - {field.name for field in fields(EncoderConfig)})
        config = EncoderConfig(**{name: value for name, value in entries.items() if name not in unknown})
    except OSError as error:
        raise CheckpointError(f"{description}: cannot be read: {error}") from error
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{description}: not an encoder configuration: {error}") from error
    if unknown:
        raise CheckpointError(
            f"{description}: got the settings {', '.join(unknown)}, which this release does not know; was it written "
            "by a newer one? Use that, or train again"
        )
    if sensor is not None and sensor not in config.sensor.split("_"):
        raise CheckpointError(f"{path}: got an encoder for {config.sensor}, expected one for {sensor}")
    encoder = new_encoder(config)
    try:
        weights = load_file(str(path))
        encoder.load_state_dict(weights)
    except (SafetensorError, RuntimeError, OSError) as error:
        raise CheckpointError(
            f"{path}: damaged, or the weights do not match the network in {description.name}: {error}"
        ) from error
    if any(not value.isfinite().all() for value in weights.values() if value.is_floating_point()):
        raise CheckpointError(f"{path}: some weights are not finite; the training that wrote it diverged")
    return encoder.eval()


def extended(encoder: Encoder, config: EncoderConfig) -> Encoder:
    """An encoder of ``config`` with the weights of another one.

    Bins of relative depth and features of a sweep that the other one lacks add nothing until they are trained. But
    heights that a sweep measured are believed from the start where the other one predicted all heights anew: that has
    to be trained. Without a sweep predictions stay as they were. All else that determines weights must be equal.
    """
    fresh = new_encoder(config)
    weights, own = encoder.state_dict(), fresh.state_dict()
    for name in ("heads.weight", "heads.bias"):
        weights[name] = torch.cat([weights[name], own[name][len(weights[name]) :]])
    first = "bird.enter.0.weight"
    # The sweep's features are the last inputs, or the first ones if there are no images.
    old = weights[first].shape[1] if config.takes_images else encoder.config.sweep_channels
    before, after = weights[first][:, :old], weights[first][:, old:]
    added = own[first].shape[1] - weights[first].shape[1]
    weights[first] = torch.cat([functional.pad(before, (0, 0, 0, 0, 0, added)), after], dim=1)
    fresh.load_state_dict(own | weights)
    return fresh
