"""Terrain of real scenes: the shipped encoder as it is, and adapted on the other scenes.

    scripts/run.sh python benchmarks/real_scenes.py SCENES [--encoder FILE] [--adapt WORLDS] [--json FILE]
        [--figure FILE.png]

SCENES is a folder of ROUGH scenes (calibrated images, one lidar cloud, poses). Errors are those of H_g at cells that
the lidar measured and a camera covers, heights clamped as in training. Level ground at the height of the wheels is the
baseline. `--adapt` fine-tunes on all scenes but one and judges on that one, in turn, as `train --adapt` does.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from monoforce_ros.core import write_text
from monoforce_ros.datasets import DatasetError
from monoforce_ros.encoder import TerrainEncoder, load_encoder
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import load_robot
from monoforce_ros.training.adaptation import AdaptationSettings, adapt, keep_obstacles
from monoforce_ros.training.judgement import BAND, CAMERAS, Judgement, judge, judged_maps
from monoforce_ros.training.losses import HIGHEST, LOWEST
from monoforce_ros.training.recording_samples import RecordingSamples, read_samples
from monoforce_ros.training.scene_samples import scene_samples
from monoforce_ros.training.world_samples import CHOOSING_WORLD, REPLAY_WORLD, world_samples

CHOOSING_WORLDS = 6
"""Worlds that choose how much of an adaptation is kept, as many as `train --adapt` takes by default."""


@torch.no_grad()
def pictures(encoder: TerrainEncoder, scene: RecordingSamples) -> dict[str, np.ndarray]:
    """Maps of a scene relative to the ground under the wheels [m]; NaN where nothing was measured or seen."""
    (entry,) = judged_maps(encoder, [scene], CAMERAS)
    ground = float(entry.batch.ground[0])
    measured = (entry.targets.geometric[0] - ground).clamp(LOWEST, HIGHEST)
    predicted = (entry.maps.geometric_height[0] - ground).clamp(LOWEST, HIGHEST)
    covered = entry.maps.covered[0]
    known = entry.targets.observed[0] & covered
    return {
        "measured": np.where(known, measured, np.nan),
        "predicted": np.where(covered, predicted, np.nan),
        "difference": np.where(known, predicted - measured, np.nan),
        "band": np.where(covered, BAND * entry.maps.geometric_spread[0], np.nan),
    }


def table(rows: Sequence[tuple[str, str, Judgement]]) -> str:
    """Markdown table of scenes, encoders and errors."""
    lines = ["| scene | encoder | level ground | error | ratio | bias | correlation | in 90 % band | band |"]
    lines += ["|---" * 9 + "|"]
    for scene, title, found in rows:
        lines.append(
            f"| {scene} | {title} | {100 * found.level:.0f} cm | {100 * found.median:.0f} cm | "
            f"{found.median / found.level:.2f} | {100 * found.bias:+.0f} cm | {found.correlation:.2f} | "
            f"{100 * found.inside:.0f} % | ±{100 * found.band:.0f} cm |"
        )
    return "\n".join(lines)


def figure(scenes: Sequence[tuple[RecordingSamples, dict[str, np.ndarray]]], extent: tuple[float, ...]) -> Figure:
    """Image, lidar map, prediction, difference and band of each scene."""
    picture = Figure(figsize=(15.0, 3.2 * len(scenes)), layout="constrained", dpi=90)
    axes = picture.subplots(len(scenes), 5, squeeze=False)
    for row, (scene, maps) in zip(axes, scenes, strict=True):
        row[0].imshow(scene.images[0, 0].numpy())
        row[0].set_title(scene.name)
        row[0].axis("off")
        low, high = np.nanpercentile(maps["measured"], (2, 98))
        for axis, name, limits, colours in (
            (row[1], "measured", (low, high), "terrain"),
            (row[2], "predicted", (low, high), "terrain"),
            (row[3], "difference", (-0.6, 0.6), "RdBu"),
            (row[4], "band", (0.0, 1.5), "viridis"),
        ):
            image = axis.imshow(maps[name], origin="lower", extent=extent, vmin=limits[0], vmax=limits[1], cmap=colours)
            axis.set_title(f"{name} [m]", fontsize=10)
            picture.colorbar(image, ax=axis, shrink=0.8)
    return picture


def robot_of(scene: str) -> str:
    """Robot of a scene, by its name."""
    return "tradr" if "tradr" in scene else "husky"


def read_scenes(folder: Path, encoder: TerrainEncoder) -> list[RecordingSamples]:
    """Samples of the scenes with images."""
    scenes = []
    for entry in sorted(path for path in folder.iterdir() if path.is_dir()):
        robot = load_robot(robot_of(entry.name))
        try:
            scenes.append(scene_samples(entry, robot, encoder.config))
        except DatasetError as error:
            print(f"left out: {error}")
    return scenes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder of ROUGH scenes")
    parser.add_argument("--encoder", default="", metavar="FILE", help="checkpoint (default: the shipped encoder)")
    parser.add_argument("--adapt", type=int, default=0, metavar="WORLDS", help="also adapt on the other scenes, with "
                        "this number of randomised worlds beside them")  # fmt: skip
    parser.add_argument("--steps", type=int, default=AdaptationSettings.steps, help="of an adaptation (%(default)s)")
    parser.add_argument("--choosing", type=int, default=CHOOSING_WORLDS, metavar="WORLDS", help="worlds that choose "
                        "how much of an adaptation is kept (%(default)s)")  # fmt: skip
    parser.add_argument("--samples", type=Path, default=Path("out/real_scenes"), metavar="DIR", help="samples of the "
                        "worlds and adapted encoders (%(default)s)")  # fmt: skip
    parser.add_argument("--threads", type=int, default=2, help="PyTorch threads (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--figure", type=Path, help="draw maps into this PNG")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    encoder = load_encoder(options.encoder, "camera")
    assert isinstance(encoder, TerrainEncoder), "checked by load_encoder"
    scenes = read_scenes(options.scenes, encoder)
    rows = [(scene.name, "as shipped", judge(encoder, [scene])) for scene in scenes]
    drawn = [(scene, pictures(encoder, scene)) for scene in scenes]
    if options.adapt:
        first = REPLAY_WORLD
        files = [world_samples(first + i, encoder.config, options.samples) for i in range(options.adapt)]
        replay = [read_samples(file) for file in files]
        files = [world_samples(CHOOSING_WORLD + i, encoder.config, options.samples) for i in range(options.choosing)]
        choosing = [read_samples(file) for file in files]
        drawn = []
        for scene in scenes:
            others = [other for other in scenes if other is not scene]
            robot = load_robot(robot_of(scene.name))
            settings, folder = AdaptationSettings(steps=options.steps), options.samples / f"without_{scene.name}"
            adapted = adapt(encoder, robot, others, replay, folder, settings)
            adapted, share = keep_obstacles(encoder, adapted, choosing)
            print(f"{scene.name}: kept {share:.0%} of the change")
            assert isinstance(adapted, TerrainEncoder), "a copy of the encoder"
            rows.append((scene.name, "adapted on the others", judge(adapted, [scene])))
            drawn.append((scene, pictures(adapted, scene)))
    print(table(rows))
    if options.json:
        found = [{"scene": scene, "encoder": title} | asdict(errors) for scene, title, errors in rows]
        write_text(options.json, json.dumps(found, indent=1) + "\n")
    if options.figure:
        options.figure.write_bytes(figure_png(figure(drawn, encoder.config.grid.extent)))


if __name__ == "__main__":
    main()
