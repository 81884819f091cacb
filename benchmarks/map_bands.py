"""Bands of the maps that the node publishes: how often they hold the true surface while trust in the encoder grows.

    scripts/run.sh python benchmarks/map_bands.py [--worlds N] [--first SEED] [--out DIR] [--json FILE]

A robot drives through randomised worlds (choosing seeds, docs/protocol.md) with terrain from `camera`, `lidar` and
`lidar_camera` as the node makes it. At every half second the published H_g is compared with the
world's true surface in the cells that count as observed. Foreign images are those of the same drive in reverse order:
pictures of another place. Side by side: the band that the map tells, and the encoder's own band, which knows nothing
of the fallback. The first metres, in which nothing was compared yet, are also listed alone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from terrain import CHOOSING, record_world, true_support
from tqdm import tqdm

from monoforce_ros.bags import Recording, observe
from monoforce_ros.core import StaleDataError, write_text
from monoforce_ros.evaluation import corrected_recording
from monoforce_ros.perception import TrustedTerrain, choose_terrain_source
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import WorldSettings
from monoforce_ros.synthetic.recording import world_file
from monoforce_ros.terrain import TerrainMap
from monoforce_ros.training.judgement import BAND
from monoforce_ros.training.losses import HIGHEST, LOWEST

SOURCES = ("camera", "camera, foreign images", "lidar", "lidar_camera", "lidar_camera, foreign images")
STEP = 500_000_000
"""Between maps [ns]."""


@dataclass(frozen=True)
class Coverage:
    """One world and source."""

    source: str
    world: int
    published: float
    """Share of the cells whose true surface lies in the published band."""
    encoder: float
    """Share in a band as wide as the encoder's own about the published height."""
    width: float
    """Median half-width of the published band [m]."""
    encoder_width: float
    """That of the encoder's own [m]."""
    start: float
    """Share of the cells in the published band until the robot has gone one metre."""
    error: float
    """Median error of the published H_g [m]."""


def coverage(recording: Recording, robot: RobotModel, seed: int, name: str, bag: Path) -> Coverage:
    """Coverage along one recording."""
    kind, _, foreign = name.partition(", ")
    source = choose_terrain_source(kind, robot, threads=1, fallback=True)
    assert isinstance(source, TrustedTerrain)
    truth = true_support(bag, robot)
    recording = corrected_recording(recording, robot)
    first, last = int(recording.motion.stamps[0]), int(recording.motion.stamps[-1])
    stamps = range(first + STEP, last, STEP)
    columns: dict[str, list[np.ndarray]] = {"error": [], "band": [], "own": [], "start": []}
    start = None
    for stamp in stamps:
        try:
            motion = recording.motion.at(stamp, maximum_gap=0.3)
            observation = observe(recording, robot, stamp, source.sensors, tuple(recording.images))
            if foreign:
                other = observe(recording, robot, first + last - stamp, ("camera",), tuple(recording.images))
                observation = replace(observation, images=other.images, cameras=other.cameras,
                                      base_from_cameras=other.base_from_cameras)  # fmt: skip
            published = source.terrain(observation, motion)
        except (StaleDataError, ValueError):
            continue
        start = motion.position if start is None else start
        predicted, actual = source.predicted, truth.terrain(observation, motion)
        assert predicted is not None
        assert predicted.geometric_spread is not None
        assert published.geometric_spread is not None
        known = published.observed
        ground = float(actual.height[actual.height.shape[0] // 2, actual.height.shape[1] // 2])

        def above(terrain: TerrainMap, ground: float = ground) -> torch.Tensor:
            return (terrain.geometric_height - ground).clamp(LOWEST, HIGHEST)

        error = (above(published) - above(actual)).abs()[known]
        columns["error"].append(error.numpy())
        columns["band"].append(BAND * published.geometric_spread[known].numpy())
        columns["own"].append(BAND * predicted.geometric_spread[known].numpy())
        columns["start"].append(np.full(len(error), np.linalg.norm((motion.position - start)[:2]) < 1.0))
    joined = {key: np.concatenate(parts) for key, parts in columns.items()}
    inside = joined["error"] <= joined["band"]
    return Coverage(
        source=name,
        world=seed,
        published=float(inside.mean()),
        encoder=float((joined["error"] <= joined["own"]).mean()),
        width=float(np.median(joined["band"])),
        encoder_width=float(np.median(joined["own"])),
        start=float(inside[joined["start"].astype(bool)].mean()),
        error=float(np.median(joined["error"])),
    )


def table(rows: Sequence[Coverage]) -> str:
    """Markdown table: means over worlds, with the smallest and the largest."""
    lines = ["| terrain | worlds | bands hold | in the first metre | half-width | encoder's own | half-width | error |"]
    lines += ["|---" * 8 + "|"]
    for name in SOURCES:
        of = [row for row in rows if row.source == name]
        if not of:
            continue
        lines.append(
            f"| {name} | {len(of)} | {_shares([row.published for row in of])} "
            f"| {100 * np.mean([row.start for row in of]):.0f} % | {_width([row.width for row in of])} "
            f"| {_shares([row.encoder for row in of])} | {_width([row.encoder_width for row in of])} "
            f"| {100 * np.median([row.error for row in of]):.1f} cm |"
        )
    return "\n".join(lines)


def _shares(values: Sequence[float]) -> str:
    return f"{100 * np.mean(values):.0f} % ({100 * min(values):.0f} – {100 * max(values):.0f})"


def _width(values: Sequence[float]) -> str:
    return f"±{100 * np.median(values):.0f} cm"


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=8, help="number of worlds (%(default)s)")
    parser.add_argument("--first", type=int, default=CHOOSING.first + 6_000, metavar="SEED", help="of the worlds "
                        "(%(default)s)")  # fmt: skip
    parser.add_argument("--duration", type=float, default=40.0, help="of a drive [s] (%(default)s)")
    parser.add_argument("--sources", nargs="+", choices=SOURCES, default=SOURCES, metavar="NAME", help="%(choices)s")
    parser.add_argument("--out", type=Path, default=Path("out/map_bands"), help="recorded worlds (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for seed in tqdm(range(options.first, options.first + options.worlds), desc="worlds", unit="world"):
        bag = record_world(options.out, seed, WorldSettings(), options.duration)
        robot = load_robot(json.loads(world_file(bag).read_text())["robot"])
        recording = Recording.open(bag, robot=robot).in_base_frame(robot.base_frame)
        for source in options.sources:
            rows.append(coverage(recording, robot, seed, source, bag))
            print(rows[-1], flush=True)
    print(table(rows))
    if options.json:
        write_text(options.json, json.dumps([vars(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
