"""Checkpoints: an encoder's weights as safetensors, its configuration as JSON beside them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from monoforce_ros.core import atomic_path, share_directory, write_text
from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.lidar_encoder import LidarEncoder
from monoforce_ros.encoder.terrain_encoder import TerrainEncoder

Encoder = TerrainEncoder | LidarEncoder

MAXIMUM_BYTES = 2_000_000_000
_HOW_TO_GET_ONE = (
    "a checkpoint is a NAME.safetensors file with NAME.json beside it, as save_encoder writes them after training; "
    "give its path as `checkpoint`, give none for the shipped one, or use the terrain source `lidar`"
)


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, or of another network; predictions never run on random weights."""


def shipped_checkpoint() -> Path:
    """The encoder that comes with the package, trained on synthetic worlds; docs/training.md says how."""
    return share_directory() / "models" / "terrain_encoder.safetensors"


def new_encoder(config: EncoderConfig) -> Encoder:
    """An untrained encoder for the configuration's sensor."""
    return TerrainEncoder(config) if config.sensor == "camera" else LidarEncoder(config)


def save_encoder(encoder: Encoder, path: str | Path) -> None:
    """Write ``path`` (.safetensors) and its configuration (.json); both appear complete or not at all."""
    path = Path(path)
    with atomic_path(path) as unfinished:
        save_file({name: value.contiguous() for name, value in encoder.state_dict().items()}, str(unfinished))
        # safetensors writes for its owner alone; a checkpoint is to be read by whoever runs the node.
        unfinished.chmod(0o644)
        # The description first: weights without one are refused, a description without weights is none.
        write_text(path.with_suffix(".json"), json.dumps(asdict(encoder.config), indent=2))


def load_encoder(path: str | Path, sensor: str | None = None) -> Encoder:
    """Read an encoder.

    Args:
        path: of the weights; the configuration lies beside them. Empty for the shipped encoder.
        sensor: that it must be for, ``camera`` or ``lidar``.

    Raises:
        CheckpointError: a file is missing, too large, damaged, or does not fit its configuration; the message says
            which and how to get a working one.
    """
    path = Path(path).expanduser() if str(path) else shipped_checkpoint()
    description = path.with_suffix(".json")
    for file in (path, description):
        if not file.is_file():
            raise CheckpointError(f"encoder checkpoint {file} does not exist: {_HOW_TO_GET_ONE}")
        if file.stat().st_size > MAXIMUM_BYTES:
            raise CheckpointError(f"encoder checkpoint {file}: {file.stat().st_size} bytes, at most {MAXIMUM_BYTES}")
    try:
        config = EncoderConfig(**json.loads(description.read_text(encoding="utf-8")))
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{description}: not the configuration of an encoder: {error}") from error
    if sensor is not None and config.sensor != sensor:
        raise CheckpointError(f"{path}: is an encoder for {config.sensor}, expected one for {sensor}")
    encoder = new_encoder(config)
    try:
        weights = load_file(str(path))
        encoder.load_state_dict(weights)
    except (SafetensorError, RuntimeError, OSError) as error:
        raise CheckpointError(
            f"{path}: damaged, or not the weights of the network in {description.name}: {error}"
        ) from error
    if any(not value.isfinite().all() for value in weights.values() if value.is_floating_point()):
        raise CheckpointError(f"{path}: some weights are not finite, the training that wrote it had diverged")
    return encoder.eval()


def averaged(paths: Sequence[str | Path], shares: Sequence[float]) -> Encoder:
    """The encoder whose weights are the mean of others', all trained on from the same start.

    Such encoders lie in one basin of the loss, and their mean is often better than each of them (Wortsman et al.,
    "Model soups", ICML 2022); of encoders trained apart it is worth nothing.

    Args:
        paths: of the checkpoints.
        shares: by how much each counts, above 0; they need not add up to 1.

    Raises:
        CheckpointError: a checkpoint cannot be read, or two are of different networks.
        ValueError: there are not as many shares as checkpoints, or a share is not a number above 0.
    """
    if len(paths) != len(shares) or not paths or not all(0.0 < share < float("inf") for share in shares):
        raise ValueError(f"shares of {len(paths)} encoders: got {list(shares)}, expected a number above 0 for each")
    encoders = [load_encoder(path) for path in paths]
    for path, encoder in zip(paths, encoders, strict=True):
        if encoder.config != encoders[0].config:
            raise CheckpointError(f"{path}: is of another network than {paths[0]}; only equal ones can be averaged")
    mean = new_encoder(encoders[0].config)
    states = [encoder.state_dict() for encoder in encoders]
    with torch.no_grad():
        for name, value in mean.state_dict().items():
            total = sum(share * state[name].double() for share, state in zip(shares, states, strict=True))
            value.copy_(total / sum(shares))
    return mean.eval()
