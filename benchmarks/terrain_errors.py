"""Errors of an encoder's heights: how far apart cells have to be for their errors to differ.

    scripts/run.sh python benchmarks/terrain_errors.py [--encoder FILE] [--worlds N] [--samples DIR] [--json FILE]

Correlation of the errors of H_g, divided by their predicted spread and clipped at four spreads, over distance, on
randomised worlds that are used for choosing (docs/protocol.md). `EnsembleSettings.correlation_length` is the distance
at which it has fallen to a half.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from monoforce_ros.core import write_text
from monoforce_ros.encoder import load_encoder
from monoforce_ros.training.judgement import CAMERAS, judged_maps
from monoforce_ros.training.recording_samples import read_samples
from monoforce_ros.training.world_samples import world_samples

CHOOSING = 430_000
_LARGEST = 4.0
"""Errors are clipped at so many spreads: few walls would decide otherwise."""


def correlation(errors: np.ndarray, known: np.ndarray, lags: int) -> np.ndarray:
    """Correlation of errors ``[N, rows, columns]`` along rows and columns, for lags of 0 to ``lags`` cells."""
    values = np.where(known, errors, 0.0)
    found = []
    for lag in range(lags + 1):
        product, count = 0.0, 0
        for axis in (1, 2):
            size = values.shape[axis] - lag
            first, second = (np.take(values, range(start, start + size), axis) for start in (0, lag))
            both = [np.take(known, range(start, start + size), axis) for start in (0, lag)]
            product += float((first * second).sum())
            count += int((both[0] & both[1]).sum())
        found.append(product / max(count, 1))
    return np.array(found) / found[0]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", default="", metavar="FILE", help="checkpoint (default: the shipped encoder)")
    parser.add_argument("--worlds", type=int, default=6, help="number of worlds (%(default)s)")
    parser.add_argument("--samples", type=Path, default=Path("out/worlds/choosing"), metavar="DIR", help="samples of "
                        "the worlds, kept (%(default)s)")  # fmt: skip
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    encoder = load_encoder(options.encoder, "camera")
    resolution = encoder.config.resolution
    lags = round(3.0 / resolution)
    curves = []
    for seed in tqdm(range(CHOOSING, CHOOSING + options.worlds), desc="worlds"):
        for entry in judged_maps(
            encoder, [read_samples(world_samples(seed, encoder.config, options.samples))], CAMERAS
        ):
            error = (entry.maps.geometric_height - entry.targets.geometric) / entry.maps.geometric_spread
            known = entry.targets.observed & entry.maps.covered
            curves.append(correlation(error.clamp(-_LARGEST, _LARGEST).numpy(), known.numpy(), lags))
    mean = np.mean(curves, axis=0)
    below = np.flatnonzero(mean < 0.5)
    half = float(below[0] * resolution) if len(below) else float("nan")
    for lag in range(0, lags + 1, max(1, round(0.3 / resolution))):
        print(f"{lag * resolution:.1f} m: {mean[lag]:.2f}")
    print(f"half at {half:.1f} m")
    if options.json:
        rows = {"resolution_m": resolution, "correlation": mean.tolist(), "half_at_m": half}
        write_text(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
