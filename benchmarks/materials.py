"""What an encoder says of materials: the depth of vegetation (H_d) and friction, in worlds that nothing was trained on.

    scripts/run.sh python benchmarks/materials.py [--encoder FILE] [--worlds 12] [--places 4] [--json FILE]

Each world is drawn twice. In one drawing friction goes with the look of the ground (``tells``); in the other one every
part of it has that of a kind drawn anew (``lies``), where an encoder should not be further off
than a user's constant. Both have many patches, for in other worlds nearly all of the ground is of one kind. Printed for
images, a sweep and both, over cells in view: the correlation of H_d with the truth where vegetation is deeper than
10 cm and over all cells, the share of cells that 90 % bands of H_d hold, the correlation of the logarithm of friction,
and its median error beside that of the constant that is best for all of these worlds together.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.encoder import load_encoder
from monoforce_ros.encoder.checkpoint import Encoder, shipped_checkpoint
from monoforce_ros.synthetic import WorldSettings
from monoforce_ros.synthetic.varied.distribution import Chance, LogUniform, Whole
from monoforce_ros.training.judgement import BAND, BOTH, CAMERAS, SWEEP, judged_maps
from monoforce_ros.training.losses import HIGHEST
from monoforce_ros.training.recording_samples import RecordingSamples, read_samples
from monoforce_ros.training.world_samples import world_samples, world_settings

FIRST_WORLD = 456_000
SENSORS = {"images": CAMERAS, "sweep": SWEEP, "both": BOTH}
LOOKS = {"tells": 0.0, "lies": 1.0}
_VEGETATION = 0.1
"""Least depth of vegetation [m]."""
_PATCHES, _SIZE = Whole(60, 120), LogUniform(1.0, 3.5)
"""Number of patches of other ground in 40 × 40 m, and half-axes of each [m]."""


@dataclass(frozen=True)
class Materials:
    """Worlds of one kind, seen by one set of sensors."""

    sensors: str
    look: str
    """Whether the look of the ground tells its friction: a key of :data:`LOOKS`."""
    cells: int
    decrease_correlation: float
    """Of H_d where vegetation is deeper than 10 cm."""
    decrease_correlation_everywhere: float
    decrease_inside: float
    """Share of cells whose H_d lies in the 90 % band."""
    friction_correlation: float
    friction_error: float
    """Median error of the logarithm of friction."""
    constant_error: float
    """That of the best constant."""


def judged(encoder: Encoder, worlds: Sequence[RecordingSamples], sensors: str, look: str) -> Materials:
    """Materials that an encoder predicts in worlds, against the truth."""
    columns: dict[str, list[torch.Tensor]] = {name: [] for name in ("depth", "found", "band", "friction", "predicted")}
    for entry in judged_maps(encoder, worlds, SENSORS[sensors]):
        maps, targets = entry.maps, entry.targets
        known = maps.covered & torch.isfinite(targets.friction)
        columns["depth"].append((targets.geometric - targets.supporting).clamp(0.0, HIGHEST)[known])
        columns["found"].append(maps.decrease[known])
        columns["band"].append(BAND * maps.decrease_spread[known])
        columns["friction"].append(targets.friction[known])
        columns["predicted"].append(maps.friction[known].log())
    joined = {name: torch.cat(parts).numpy() for name, parts in columns.items()}
    depth, found, friction, predicted = (joined[name] for name in ("depth", "found", "friction", "predicted"))
    deep = depth >= _VEGETATION
    # The encoder tells friction relative to ordinary ground: a user gives the level.
    predicted = predicted - np.median(predicted) + np.median(friction)
    return Materials(
        sensors=sensors,
        look=look,
        cells=len(depth),
        decrease_correlation=_correlation(found[deep], depth[deep]),
        decrease_correlation_everywhere=_correlation(found, depth),
        decrease_inside=float((np.abs(found - depth) <= joined["band"]).mean()),
        friction_correlation=_correlation(predicted, friction),
        friction_error=float(np.median(np.abs(predicted - friction))),
        constant_error=float(np.median(np.abs(friction - np.median(friction)))),
    )


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson's; not a number where one of them does not vary."""
    if len(one) < 2 or not one.std() or not other.std():
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])


def settings_of(seed: int, look: str) -> WorldSettings:
    """Settings of a world whose ground is a patchwork that looks like what it is, or does not."""
    usual = world_settings(seed)
    ground = replace(usual.ground, patches=_PATCHES, patch_size=_SIZE, misleading=Chance(LOOKS[look]))
    return replace(usual, ground=ground)


def table(rows: Sequence[Materials]) -> str:
    """Markdown table."""
    lines = [
        "| sensors | look | H_d where vegetation is deeper than 10 cm: correlation | everywhere | in 90 % band "
        "| friction: correlation | error of its logarithm | of the best constant |",
        "|---" * 8 + "|",
    ]
    lines += [
        f"| {row.sensors} | {row.look} | {row.decrease_correlation:.2f} | {row.decrease_correlation_everywhere:.2f} "
        f"| {100 * row.decrease_inside:.0f} % | {row.friction_correlation:.2f} | {row.friction_error:.2f} "
        f"| {row.constant_error:.2f} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", type=Path, metavar="FILE", help="checkpoint (default: the shipped encoder)")
    parser.add_argument("--worlds", type=int, default=12, metavar="N", help="(%(default)s)")
    parser.add_argument("--first", type=int, default=FIRST_WORLD, metavar="SEED", help="of the worlds (%(default)s)")
    parser.add_argument("--places", type=int, default=4, metavar="N", help="places in each world (%(default)s)")
    parser.add_argument("--samples", type=Path, default=Path("out/materials"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="PyTorch threads (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    encoder = load_encoder(options.encoder or shipped_checkpoint(), "camera")
    worlds: dict[str, list[RecordingSamples]] = {look: [] for look in LOOKS}
    for seed in range(options.first, options.first + options.worlds):
        for look, drawn in worlds.items():
            folder = options.samples / look
            file = world_samples(seed, encoder.config, folder, places=options.places, settings=settings_of(seed, look))
            drawn.append(read_samples(file))
        print(f"world {seed}", flush=True)
    rows = [judged(encoder, worlds[look], sensors, look) for sensors in SENSORS for look in LOOKS]
    print(table(rows))
    if options.json:
        write_text(options.json, json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
