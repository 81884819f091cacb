"""How far bands of heights from images alone are to be trusted in a scene that nobody has seen.

    scripts/run.sh python benchmarks/image_bands.py [--encoder FILE] [--worlds 24] [--json FILE] [--write]

Errors within a scene go together: bands that hold 90 % of all cells hold far less in some scenes. For each of the
randomised worlds this prints the factor with which its 90 % bands would hold 90 % of its cells, and the factor that
does so in nine of ten further worlds (`scene_factor`), which `--write` puts into the encoder's JSON as
`image_spread_factor`. The worlds have seeds for choosing (docs/protocol.md), and nothing else is calibrated on them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.encoder import load_encoder
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.training.judgement import BAND_SHARE, band_ratios, scene_factor
from monoforce_ros.training.recording_samples import read_samples
from monoforce_ros.training.world_samples import world_samples

FIRST_WORLD = 436_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", type=Path, metavar="FILE", help="checkpoint (default: the shipped encoder)")
    parser.add_argument("--worlds", type=int, default=24, metavar="N", help="(%(default)s)")
    parser.add_argument("--places", type=int, default=4, metavar="N", help="places in each world (%(default)s)")
    parser.add_argument("--samples", type=Path, default=Path("out/image_bands"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="PyTorch threads (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--write", action="store_true", help="write the factor into the encoder's JSON")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    path = options.encoder or shipped_checkpoint()
    encoder = load_encoder(path, "camera")
    encoder.config = replace(encoder.config, image_spread_factor=1.0)
    factors, held = {}, []
    for seed in range(FIRST_WORLD, FIRST_WORLD + options.worlds):
        world = read_samples(world_samples(seed, encoder.config, options.samples, places=options.places))
        ratios = band_ratios(encoder, [world]).geometric
        factors[seed] = float(np.quantile(ratios, BAND_SHARE))
        held.append(ratios)
        print(f"world {seed}: bands hold {np.mean(ratios < 1.0):.0%}, factor {factors[seed]:.2f}", flush=True)
    found = scene_factor(list(factors.values()))
    cells = np.concatenate(held)
    print(f"all cells: bands hold {np.mean(cells < 1.0):.0%}, factor {np.quantile(cells, BAND_SHARE):.2f}")
    if found is None:
        raise SystemExit(f"{options.worlds} worlds do not tell what nine of ten scenes need, expected 9 or more")
    print(f"nine of ten worlds: factor {found:.2f}, with which {np.mean(cells < found):.0%} of all cells are held")
    if options.json:
        write_text(options.json, json.dumps({"factor": found, "worlds": factors}, indent=1) + "\n")
    if options.write:
        config = replace(encoder.config, image_spread_factor=round(found, 3))
        write_text(path.with_suffix(".json"), json.dumps(asdict(config), indent=2))


if __name__ == "__main__":
    main()
