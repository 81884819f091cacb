"""Judgement: errors of an encoder's maps on samples, next to those of level ground at the height of the wheels."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.encoder import EncodedMaps, Encoder, EncoderInput
from monoforce_ros.training.losses import HIGHEST, LOWEST
from monoforce_ros.training.recording_samples import RecordingSamples
from monoforce_ros.training.samples import Augmentation, Targets, sample

CAMERAS = Augmentation(sweep_share=0.0)
"""Images and the ground that was driven over, no sweep."""
SWEEP = Augmentation(cameras=(1.0,) * 64, camera_share=-1.0)
"""A sweep and the ground that was driven over, no images."""
BOTH = Augmentation()
BAND = float(np.log(10.0))
"""Half-width of the 90 % band of a Laplace distribution, in units of its scale."""
_OBSTACLE, _FOUND, _REACH = 0.3, 0.15, 5.0
"""Height over the robot's ground from which a cell is an obstacle, from which a predicted one stops a robot, and the
distance up to which they count [m]."""


@dataclass(frozen=True)
class Judgement:
    """Errors over cells that were measured and lie in the sensors' view."""

    cells: int
    level: float
    """Median error of level ground [m]."""
    median: float
    """Median error of H_g [m]."""
    bias: float
    """Median of predicted minus measured H_g [m]."""
    correlation: float
    """Of predicted and measured H_g."""
    inside: float
    """Share of measured H_g within the predicted 90 % band."""
    band: float
    """Median half-width of that band [m]."""
    support_level: float
    """Median error of level ground where H_t is known [m]; NaN without such cells."""
    support: float
    """Median error of H_t there [m]."""
    obstacles: float
    """Share of cells that carry an obstacle within 5 m whose H_t is predicted to be one; NaN where H_t is not known."""
    clear: float
    """Share of cells without an obstacle within 5 m in which none is predicted."""


@dataclass(frozen=True)
class JudgedMaps:
    """Maps of one batch."""

    batch: EncoderInput
    targets: Targets
    maps: EncodedMaps


@torch.no_grad()
def judged_maps(
    encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS, *, size: int = 8
) -> list[JudgedMaps]:
    """Predictions for all samples of recordings.

    Args:
        encoder: the encoder; put into evaluation mode.
        recordings: recordings with any number of samples.
        sensors: :data:`CAMERAS`, :data:`SWEEP` or :data:`BOTH`.
        size: largest number of samples in a batch.
    """
    encoder.eval()
    device = next(encoder.parameters()).device
    found = []
    for recording in recordings:
        for start in range(0, len(recording), size):
            indices = range(start, min(start + size, len(recording)))
            samples = [sample(recording, i, encoder.config, sensors, chunks=1) for i in indices]
            batch = EncoderInput.stack([s[0] for s in samples]).to(device)
            targets = Targets.stack([s[1] for s in samples]).to(device)
            found.append(JudgedMaps(batch, targets, encoder(batch)))
    return found


def judge(encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS) -> Judgement:
    """Errors over all samples of recordings; heights are clamped as in training."""
    columns: dict[str, list[Tensor]] = {name: [] for name in (
        "predicted", "measured", "band", "support", "found", "predicted obstacle", "obstacle"
    )}  # fmt: skip
    for entry in judged_maps(encoder, recordings, sensors):
        ground = entry.batch.ground[:, None, None]

        def above(heights: Tensor, ground: Tensor = ground) -> Tensor:
            return (heights - ground).clamp(LOWEST, HIGHEST)

        known = entry.targets.observed & entry.maps.covered
        columns["predicted"].append(above(entry.maps.geometric_height)[known])
        columns["measured"].append(above(entry.targets.geometric)[known])
        columns["band"].append(BAND * entry.maps.geometric_spread[known])
        touched = entry.targets.contact_mask & entry.maps.covered
        columns["support"].append(above(entry.maps.height)[touched])
        columns["found"].append(above(entry.targets.supporting)[touched])
        grid = encoder.config.grid
        near = torch.from_numpy(np.hypot(*np.meshgrid(grid.x, grid.y)) < _REACH).to(touched.device)
        columns["predicted obstacle"].append(above(entry.maps.height)[touched & near] > _FOUND)
        columns["obstacle"].append(above(entry.targets.supporting)[touched & near] > _OBSTACLE)
    joined = {name: torch.cat(parts).cpu() for name, parts in columns.items()}
    predicted, measured, band = joined["predicted"], joined["measured"], joined["band"]
    error, hit, obstacle = predicted - measured, joined["predicted obstacle"], joined["obstacle"]
    return Judgement(
        cells=len(error),
        level=_median(measured.abs()),
        median=_median(error.abs()),
        bias=_median(error),
        correlation=float(torch.corrcoef(torch.stack([predicted, measured]))[0, 1]),
        inside=_mean(error.abs() < band),
        band=_median(band),
        support_level=_median(joined["found"].abs()),
        support=_median((joined["support"] - joined["found"]).abs()),
        obstacles=_mean(hit[obstacle]),
        clear=_mean(~hit[~obstacle]),
    )


def calibrated(encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS) -> Encoder:
    """A copy of an encoder whose 90 % bands of H_g and H_d hold 90 % of the measured values.

    Args:
        encoder: the encoder.
        recordings: recordings that it was not trained on.
        sensors: sensors that the bands are to hold for; more sensors make them conservative.
    """
    ratios: dict[str, list[Tensor]] = {"geometric": [], "decrease": []}
    for entry in judged_maps(encoder, recordings, sensors):
        maps, targets, ground = entry.maps, entry.targets, entry.batch.ground[:, None, None]
        error = (maps.geometric_height - ground).clamp(LOWEST, HIGHEST) - (targets.geometric - ground).clamp(
            LOWEST, HIGHEST
        )
        known = targets.observed & maps.covered
        ratios["geometric"].append((error.abs() / (BAND * maps.geometric_spread))[known])
        depth = (targets.geometric - targets.supporting).clamp(0.0, HIGHEST)
        both = known & targets.contact_mask
        ratios["decrease"].append(((maps.decrease - depth).abs() / (BAND * maps.decrease_spread))[both])
    factors = {}
    for name, parts in ratios.items():
        joined = torch.cat(parts)
        old = getattr(encoder.config, f"{name}_spread_factor")
        share = float(np.quantile(joined.cpu().numpy(), 0.9)) if len(joined) else 1.0
        factors[f"{name}_spread_factor"] = min(max(old * share, 0.01), 100.0)
    result = copy.deepcopy(encoder)
    result.config = replace(encoder.config, **factors)
    return result


def _median(values: Tensor) -> float:
    return float(values.median()) if len(values) else float("nan")


def _mean(values: Tensor) -> float:
    return float(values.float().mean()) if len(values) else float("nan")
