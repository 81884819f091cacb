"""Judgement: errors of an encoder's maps on samples, next to those of level ground at the height of the wheels."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

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
BAND_SHARE, BAND = 0.9, float(np.log(10.0))
"""Share that a band is to hold, and its half-width for a Laplace distribution, in units of its scale."""
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
    support_inside: float
    """Share of known H_t within their predicted 90 % band."""
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
        "predicted", "measured", "band", "support", "found", "support band", "predicted obstacle", "obstacle"
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
        both = torch.hypot(entry.maps.geometric_spread, entry.maps.decrease_spread)
        columns["support band"].append(BAND * both[touched])
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
        correlation=float(torch.corrcoef(torch.stack([predicted, measured]))[0, 1]) if len(error) > 1 else float("nan"),
        inside=_mean(error.abs() < band),
        band=_median(band),
        support_level=_median(joined["found"].abs()),
        support=_median(wrong := (joined["support"] - joined["found"]).abs()),
        support_inside=_mean(wrong < joined["support band"]),
        obstacles=_mean(hit[obstacle]),
        clear=_mean(~hit[~obstacle]),
    )


def calibrated(encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS) -> Encoder:
    """A copy of an encoder whose 90 % bands of H_g and H_d hold 90 % of the measured values.

    With images alone some scenes are off as a whole, so that bands that hold 90 % of all cells hold far less there.
    Where there are recordings of at least nine scenes, bands from images are made to hold 90 % of the cells of 90 % of
    the scenes (:func:`scene_factor`); fewer leave ``image_spread_factor`` as it is. That of H_d, which comes from one
    place, ends.

    Args:
        encoder: the encoder.
        recordings: recordings that it was not trained on.
        sensors: sensors that the bands are to hold for; more sensors make them conservative.
    """
    ratios = [band_ratios(encoder, [recording], sensors) for recording in recordings]
    config = encoder.config
    by_images = sensors.sweep_share == 0.0
    alone = config.image_spread_factor if by_images else 1.0
    geometric = _quantile([alone * entry.geometric for entry in ratios])
    deeper = config.image_decrease_spread_factor if by_images else 1.0
    decrease = _quantile([deeper * entry.decrease for entry in ratios])
    factors = {
        "geometric_spread_factor": config.geometric_spread_factor * geometric,
        "decrease_spread_factor": config.decrease_spread_factor * decrease,
        "image_decrease_spread_factor": 1.0,
    }
    if by_images:
        scenes = [_quantile([alone * entry.geometric]) / geometric for entry in ratios if len(entry.geometric)]
        factors["image_spread_factor"] = scene_factor(scenes) or config.image_spread_factor
    return _with_factors(encoder, factors)


def scene_factor(factors: Sequence[float]) -> float | None:
    """Factor with which bands hold as many cells as they say in nine of ten scenes, at least 1.

    By conformal prediction with scenes as the exchangeable units (Dunn, Wasserman and Ramdas, "Distribution-free
    prediction sets for two-layer hierarchical models", 2023): the ⌈0.9 (n + 1)⌉-th smallest of the factors that n
    scenes need, each for 90 % of its own cells. It holds for a further scene of the same kind with a probability of
    90 %.

    Returns:
        None for fewer than nine scenes, which do not tell.
    """
    rank = math.ceil(BAND_SHARE * (len(factors) + 1))
    return max(1.0, sorted(factors)[rank - 1]) if rank <= len(factors) else None


def widened(encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS) -> Encoder:
    """A copy of an encoder whose 90 % bands hold 90 % of what was measured in a robot's own recordings, and which are
    nowhere narrower than before: one place does not show how wrong it is elsewhere.

    Without a lidar what the wheels traced decides, and widens H_g and H_d alike. Bands of a sweep stay where images
    alone were judged.
    """
    ratios = [band_ratios(encoder, [recording], sensors) for recording in recordings]
    surface, below = (_quantile([getattr(entry, name) for entry in ratios]) for name in ("geometric", "decrease"))
    if not any(len(entry.geometric) for entry in ratios):
        surface = below = _quantile([entry.support for entry in ratios])
    # A sweep's own bands need not be as wide as those of images.
    judged = ("image_spread_factor", "image_decrease_spread_factor")
    if sensors.sweep_share != 0.0:
        judged = ("geometric_spread_factor", "decrease_spread_factor")
    wider = dict(zip(judged, (surface, below), strict=True))
    return _with_factors(
        encoder, {name: getattr(encoder.config, name) * max(1.0, factor) for name, factor in wider.items()}
    )


def sample_errors(
    encoder: Encoder, recording: RecordingSamples, sensors: Augmentation = CAMERAS
) -> dict[str, np.ndarray]:
    """Median error of each sample of a recording ``[n]`` [m], of the visible surface (``surface``) and of the ground
    under the wheels (``support``); NaN where a sample has none."""
    found: dict[str, list[float]] = {"surface": [], "support": []}
    for entry in judged_maps(encoder, [recording], sensors):
        ground = entry.batch.ground[:, None, None]
        for name, heights, targets, mask in (
            ("surface", entry.maps.geometric_height, entry.targets.geometric, entry.targets.observed),
            ("support", entry.maps.height, entry.targets.supporting, entry.targets.contact_mask),
        ):
            above = [(values - ground).clamp(LOWEST, HIGHEST) for values in (heights, targets)]
            error, known = (above[0] - above[1]).abs(), mask & entry.maps.covered
            found[name] += [_median(error[i][known[i]]) for i in range(len(error))]
    return {name: np.array(values) for name, values in found.items()}


@dataclass(frozen=True)
class BandRatios:
    """Absolute errors divided by the half-width of their 90 % band, of single cells ``[n]``."""

    geometric: np.ndarray
    """Of H_g where a lidar measured it."""
    decrease: np.ndarray
    """Of H_d where both surfaces were measured."""
    support: np.ndarray
    """Of H_t where it is known."""


def band_ratios(
    encoder: Encoder, recordings: Sequence[RecordingSamples], sensors: Augmentation = CAMERAS
) -> BandRatios:
    """Errors relative to the bands that an encoder predicts for them, over all samples of recordings."""
    columns: dict[str, list[Tensor]] = {"geometric": [], "decrease": [], "support": []}
    for entry in judged_maps(encoder, recordings, sensors):
        maps, targets, ground = entry.maps, entry.targets, entry.batch.ground[:, None, None]

        def error(found: Tensor, wanted: Tensor, ground: Tensor = ground) -> Tensor:
            return ((found - ground).clamp(LOWEST, HIGHEST) - (wanted - ground).clamp(LOWEST, HIGHEST)).abs()

        known, touched = targets.observed & maps.covered, targets.contact_mask & maps.covered
        of_surface = error(maps.geometric_height, targets.geometric) / (BAND * maps.geometric_spread)
        columns["geometric"].append(of_surface[known])
        depth = (targets.geometric - targets.supporting).clamp(0.0, HIGHEST)
        of_depth = (maps.decrease - depth).abs() / (BAND * maps.decrease_spread)
        columns["decrease"].append(of_depth[known & touched])
        both = torch.hypot(maps.geometric_spread, maps.decrease_spread)
        columns["support"].append((error(maps.height, targets.supporting) / (BAND * both))[touched])
    return BandRatios(**{name: torch.cat(parts).cpu().numpy() for name, parts in columns.items()})


def _quantile(parts: Sequence[np.ndarray]) -> float:
    """Factor on bands with which they hold 90 %; 1 without any ratio."""
    joined = np.concatenate([np.zeros(0), *parts])
    return float(np.quantile(joined, BAND_SHARE)) if len(joined) else 1.0


def _with_factors(encoder: Encoder, factors: dict[str, float]) -> Encoder:
    result = copy.deepcopy(encoder)
    limited: dict[str, Any] = {name: min(max(factor, 0.01), 100.0) for name, factor in factors.items()}
    result.config = replace(encoder.config, **limited)
    return result


def _median(values: Tensor) -> float:
    return float(values.median()) if len(values) else float("nan")


def _mean(values: Tensor) -> float:
    return float(values.float().mean()) if len(values) else float("nan")
