"""Speed of the terrain encoder: time from images or a lidar sweep to terrain, in total and per stage.

    scripts/run.sh python benchmarks/encoder.py [--json FILE] [--threads 2] [--compile] [--quick]

First the shipped encoder in the predictor's terrain sources, along the bundled bag: from a decoded sweep of 5,000 or
35,000 returns, or images, to the map in the terrain frame, with its trust, memory and fallback. Times are on the clock
and of the processor, all threads together: the latter do not depend on what else runs. Then stages of an untrained
encoder with one and four cameras: as trained, with folded norms, with packed weights, and in bfloat16 if the processor
supports it. Every figure is the median of several runs.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.bags import Recording, observe
from monoforce_ros.core import CameraModel, MotionState, homogeneous, write_text
from monoforce_ros.encoder import CameraView, EncoderConfig, TerrainEncoder, encoder_input, fused, packed
from monoforce_ros.encoder.heads import terrain_maps, with_edges
from monoforce_ros.encoder.inference import multiplies_bfloat16
from monoforce_ros.encoder.lift import lifted_points, map_cells, splat
from monoforce_ros.encoder.terrain_encoder import MOMENTS
from monoforce_ros.encoder.view import SUPPORT_CHANNELS
from monoforce_ros.perception import Observation, choose_terrain_source
from monoforce_ros.perception.sources import LIDAR_RETENTION_TIME
from monoforce_ros.robots import load_robot

FORWARD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
SUPPORT = np.array([[0.3, 0.3, -0.1], [0.3, -0.3, -0.1], [-0.3, 0.3, -0.1], [-0.3, -0.3, -0.1]])


def views(count: int, width: int = 320, height: int = 240) -> list[CameraView]:
    """Cameras on all sides of a robot, tilted slightly downwards."""
    random = np.random.default_rng(0)
    matrix = np.array([[0.6 * width, 0, width / 2 - 0.5], [0, 0.6 * width, height / 2 - 0.5], [0, 0, 1]])
    camera = CameraModel(width, height, matrix, np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    down = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    found = []
    for side in range(count):
        angle = side * np.pi / 2
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        image = random.integers(0, 255, (height, width, 3), np.uint8)
        found.append(CameraView(image, camera, homogeneous(turn @ down @ FORWARD, turn @ np.array([0.3, 0.0, 0.4]))))
    return found


def timed(work: Callable[[], object], repeats: int) -> float:
    """Median duration [ms]."""
    work()
    durations = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        durations.append(time.perf_counter() - began)
    return 1e3 * statistics.median(durations)


DEMO = Path(__file__).resolve().parent.parent / "bags" / "demo"
_RETURN_NOISE = 0.02
"""Of the copies that make larger sweeps [m]."""


def along_the_bag(frames: int) -> list[tuple[Observation, MotionState]]:
    """Sweeps and images of the bundled bag, with the motion at their times."""
    robot = load_robot("husky")
    recording = Recording.open(DEMO).in_base_frame(robot.base_frame)
    stamps = [frame.stamp for frame in recording.clouds[2 : 2 + frames]]
    topics = tuple(recording.images)
    return [
        (observe(recording, robot, stamp, ("lidar", "camera"), topics), recording.motion.at(stamp)) for stamp in stamps
    ]


def with_returns(observation: Observation, count: int) -> Observation:
    """The observation with so many returns and no image."""
    cloud, random = observation.cloud, np.random.default_rng(0)
    assert cloud is not None
    chosen = np.sort(random.permutation(np.arange(count) % len(cloud))) if count > len(cloud) else np.arange(count)
    noise = _RETURN_NOISE * random.standard_normal((count, 3)) if count > len(cloud) else 0.0
    return replace(observation, cloud=(cloud[chosen] + noise).astype(np.float32), images={})


def with_cameras(observation: Observation, count: int) -> Observation:
    """The observation with its first image on so many sides of the robot, and no sweep."""
    (name, image), *_ = observation.images.items()
    placed = {}
    for side in range(count):
        cosine, sine = np.cos(side * np.pi / 2), np.sin(side * np.pi / 2)
        turn = homogeneous(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]), np.zeros(3))
        placed[f"{name}/{side}"] = turn @ observation.base_from_cameras[name]
    return replace(
        observation,
        cloud=None,
        images=dict.fromkeys(placed, image),
        cameras=dict.fromkeys(placed, observation.cameras[name]),
        base_from_cameras=placed,
    )


def shipped(threads: int, frames: int) -> dict[str, dict[str, float]]:
    """Median time on the clock and of the processor of each map of the predictor's terrain sources [ms]."""
    seen = along_the_bag(frames)
    found = {}
    for title, kind, reduced in (
        *((f"lidar sweep, {n:,} returns", "lidar", lambda o, n=n: with_returns(o, n)) for n in (5_000, 35_000)),
        *((f"{n} camera(s)", "camera", lambda o, n=n: with_cameras(o, n)) for n in (1, 4)),
    ):
        source = choose_terrain_source(
            kind, load_robot("husky"), precision="auto", threads=threads, lidar_retention_time=LIDAR_RETENTION_TIME,
            fallback=True,
        )  # fmt: skip
        clock, processor = [], []
        for observation, motion in [(reduced(observation), motion) for observation, motion in seen]:
            began = time.perf_counter(), time.process_time()
            source.terrain(observation, motion)
            clock.append(time.perf_counter() - began[0])
            processor.append(time.process_time() - began[1])
        # The first map packs the weights.
        times = [1e3 * statistics.median(values[1:]) for values in (clock, processor)]
        found[title] = {"clock_ms": times[0], "processor_ms": times[1]}
        print(f"shipped encoder, {title}, {threads} threads: {times[0]:.1f} ms, {times[1]:.1f} ms of the processor")
    return found


def stages(encoder: TerrainEncoder, cameras: list[CameraView], repeats: int) -> dict[str, float]:
    """Duration of each stage [ms]."""
    config = encoder.config
    size = config.grid.rows * config.grid.columns
    batch = encoder_input(cameras, SUPPORT, config)
    with torch.no_grad():

        def depths_and_features():
            return encoder.lifted(*encoder.image_features(batch.images), batch.rays, batch.origins)

        depth, features = depths_and_features()
        points = lifted_points(batch.rays, batch.origins, encoder.depths)
        cells = map_cells(points, config)
        dtype = encoder.lift.weight.dtype
        images = (batch.images.float() / 127.5 - 1.0).to(dtype)
        inputs = config.image_features + MOMENTS + SUPPORT_CHANNELS
        maps = torch.zeros(1, inputs, config.grid.rows, config.grid.columns)
        maps = maps.contiguous(memory_format=torch.channels_last)
        encoded = encoder(batch)
        return {
            "geometry and resizing": timed(lambda: encoder_input(cameras, SUPPORT, config), repeats),
            "backbone": timed(lambda: encoder.backbone(images), repeats),
            "backbone, neck and depths": timed(depths_and_features, repeats),
            "points and cells": timed(
                lambda: map_cells(lifted_points(batch.rays, batch.origins, encoder.depths), config), repeats
            ),
            "splat": timed(lambda: splat(depth, features, cells, points[..., 2], size), repeats),
            "bird's-eye-view network": timed(lambda: encoder.heads(encoder.bird(maps.to(dtype)).float()), repeats),
            "edges and terrain map": timed(lambda: terrain_maps(with_edges(encoded, config), config), repeats),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2, help="threads of PyTorch (default: %(default)s)")
    parser.add_argument("--compile", action="store_true", help="also measure torch.compile (needs a C++ compiler)")
    parser.add_argument("--quick", action="store_true", help="few repeats, for testing")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    repeats = 3 if options.quick else 30
    plain = TerrainEncoder(EncoderConfig()).eval()
    kinds = {"fused": fused(plain), "packed": packed(fused(plain))}
    if multiplies_bfloat16():
        kinds["packed bfloat16"] = packed(fused(plain, "bfloat16"))
    best, quick = list(kinds.items())[-1]
    if options.compile:
        for kind, precision in (("compiled", "float32"), ("compiled bfloat16", "bfloat16")):
            if kind.replace("compiled", "packed") in kinds:
                kinds[kind] = fused(plain, precision)
                kinds[kind].compile(options={"freezing": True})
    figures: dict = {"threads": options.threads, "processor": platform.processor(), "torch": torch.__version__}
    figures["shipped"] = shipped(options.threads, 4 if options.quick else 31)
    for count in (1, 4):
        cameras = views(count)
        before = timed(lambda: plain.terrain(cameras, SUPPORT), repeats)  # noqa: B023
        times = {}
        for kind, encoder in kinds.items():
            began = time.perf_counter()
            encoder.terrain(cameras, SUPPORT)
            if kind.startswith("compiled"):
                print(f"torch.compile, {kind}: {time.perf_counter() - began:.0f} s")
            times[kind] = timed(lambda e=encoder: e.terrain(cameras, SUPPORT), repeats)  # noqa: B023
        after = times[best]
        parts = stages(quick, cameras, repeats)
        figures[f"{count} cameras"] = {
            "plain_ms": before,
            **{f"{kind.replace(' ', '_')}_ms": duration for kind, duration in times.items()},
            "ratio": before / after,
            "stages_ms": parts,
        }
        print(f"{count} camera(s) 320 × 240, {options.threads} threads: {before:.1f} ms as trained")
        for kind, duration in times.items():
            print(f"    {kind:28s} {duration:7.1f} ms  {before / duration:.2f} ×")
        print(f"  of {best}:")
        for name, duration in parts.items():
            print(f"    {name:28s} {duration:7.1f} ms  {100 * duration / after:4.0f} %")
    if options.json:
        write_text(options.json, json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
