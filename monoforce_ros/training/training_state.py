"""The state of an interrupted training: weights, the optimiser's moments, and what they belong to."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from monoforce_ros.core import atomic_path
from monoforce_ros.encoder import HEIGHT_CHANNELS, Encoder


class TrainingError(RuntimeError):
    """Training cannot start or continue; the message gives the reason."""


def save_state(file: Path, encoder: Encoder, optimiser: torch.optim.Optimizer, description: dict) -> None:
    """Write a state; it appears complete or not at all.

    Args:
        file: path of the state (.safetensors).
        encoder: its weights.
        optimiser: its moments.
        description: settings, configuration and step, as JSON.
    """
    tensors = {f"encoder.{name}": value for name, value in encoder.state_dict().items()}
    names: dict[Tensor, str] = {parameter: name for name, parameter in encoder.named_parameters()}
    for parameter, moments in optimiser.state.items():
        for key, value in moments.items():
            tensors[f"optimiser.{names[parameter]}.{key}"] = torch.as_tensor(value)
    with atomic_path(file) as unfinished:
        save_file(
            {name: value.detach().cpu().contiguous() for name, value in tensors.items()}, str(unfinished),
            metadata={"training": json.dumps(description)},
        )  # fmt: skip


def read_state(
    file: Path, encoder: Encoder, optimiser: torch.optim.Optimizer, settings: dict, data: str = ""
) -> dict | None:
    """Load a state into an encoder and its optimiser.

    Args:
        file: path of the state.
        encoder: receives the weights.
        optimiser: receives the moments.
        settings: that the state must have been saved with.
        data: fingerprint of what is trained on, which must be that of the state.

    Returns:
        the description; None if there is no such file.

    Raises:
        TrainingError: the state is damaged, or its network or settings differ.
    """
    if not file.is_file():
        return None
    try:
        with safe_open(str(file), framework="pt") as content:
            description = json.loads((content.metadata() or {})["training"])
        tensors = load_file(str(file))
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise TrainingError(f"{file}: damaged ({error}); delete {file.parent} to start over") from error
    expected, saved = json.loads(json.dumps(settings)), _renamed(description["settings"])
    different = [name for name, value in expected.items() if saved.get(name) != value]
    # States of earlier releases do not name bins of relative depth, nor the channels of a sweep.
    config = {"relative_bins": 0, "sweep_channels": HEIGHT_CHANNELS} | description["config"]
    if not encoder.config.takes_sweeps:
        config["sweep_channels"] = encoder.config.sweep_channels
    if config != asdict(encoder.config):
        different.append("network configuration")
    # States of earlier releases do not say.
    if data and description.get("data", data) != data:
        different.append("samples or robot")
    if different:
        raise TrainingError(
            f"{file}: saved with different {', '.join(different)}; use the same options, or another --out"
        )
    encoder.load_state_dict(
        {name.removeprefix("encoder."): v for name, v in tensors.items() if name.startswith("encoder.")}
    )
    for name, parameter in encoder.named_parameters():
        prefix = f"optimiser.{name}."
        moments = {key.removeprefix(prefix): v for key, v in tensors.items() if key.startswith(prefix)}
        if moments:
            optimiser.state[parameter] = {
                key: v if key == "step" else v.to(parameter.device) for key, v in moments.items()
            }
    return description


RENAMED_WEIGHTS = {"standing": "prominence", "standing_decrease": "prominent_decrease"}
"""Loss weights by the names of earlier releases."""


def _renamed(settings: dict) -> dict:
    """Saved settings of an earlier release under their names of today, and those that it did not have."""
    settings = {"augment" if name == "vary" else name: value for name, value in settings.items()}
    settings = {"sensor_shares": [0.55, 0.3, 0.15]} | settings
    weights = settings.get("weights")
    if isinstance(weights, dict):
        settings["weights"] = {RENAMED_WEIGHTS.get(name, name): value for name, value in weights.items()}
    return settings
