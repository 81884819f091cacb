"""Overfit the encoder to the ROUGH scenes: predict lidar heights from real images.

    scripts/run.sh python benchmarks/overfit_scenes.py SCENES [--steps 150] [--json FILE] [--figure FILE.png]

This checks that images, calibration, lift, splat and heads are consistent on real cameras, including distorted, rotated
and portrait ones. It does not measure generalisation to other scenes.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from monoforce_ros.core import MotionState, transform_points, write_text
from monoforce_ros.datasets import DatasetError, RoughScene
from monoforce_ros.encoder import CameraView, EncoderConfig, EncoderInput, TerrainEncoder, encoder_input
from monoforce_ros.perception import LidarTerrain, Observation, support_points
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import TerrainDefaults
from monoforce_ros.training.losses import HIGHEST, LOWEST


@dataclass(frozen=True)
class Scene:
    """Encoder input and lidar height map of a scene."""

    name: str
    batch: EncoderInput
    heights: Tensor
    """``[rows, columns]`` [m]; clamped as in training."""
    observed: Tensor
    views: tuple[CameraView, ...]


def read_scene(folder: Path, config: EncoderConfig) -> Scene:
    """Read a scene; raises ``DatasetError`` if it has no images."""
    scene = RoughScene.open(folder)
    stamp = int(scene.cloud_stamps[0])
    images = scene.images(stamp)
    if not images:
        raise DatasetError(f"{folder}: no images")
    robot = load_robot("tradr" if "tradr" in folder.name else "husky")
    nearest = int(np.clip(stamp, scene.pose_stamps[0], scene.pose_stamps[-1]))
    pose = scene.pose(nearest)
    motion = MotionState(stamp, pose[:3, 3], pose[:3, :3], np.zeros(3), np.zeros(3))
    cloud = transform_points(scene.base_from_lidar, scene.cloud(stamp))
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    terrain = LidarTerrain(robot, config.grid, TerrainDefaults()).terrain(Observation(stamp, cloud=cloud), motion)
    views = tuple(
        CameraView(image, scene.cameras[name], motion.terrain_from_base @ scene.base_from_sensors[name])
        for name, image in images.items()
    )
    batch = encoder_input(views, support_points(robot, motion, config.stiffness), config)
    ground = float(batch.ground[0])
    heights = terrain.geometric_height.float().clamp(ground + LOWEST, ground + HIGHEST)
    return Scene(folder.name, batch, heights, terrain.observed, views)


def overfit(
    scenes: list[Scene], config: EncoderConfig, steps: int, rate: float = 3e-3, quiet: bool = False
) -> tuple[TerrainEncoder, list[float]]:
    """Fit one encoder to all scenes; returns it and the median error of each scene in the last step [m]."""
    torch.manual_seed(0)
    encoder = TerrainEncoder(config)
    encoder.backbone.load_imagenet()
    encoder.train()
    optimiser = torch.optim.AdamW(encoder.parameters(), lr=rate, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps, pct_start=0.1)
    bar = tqdm(range(steps), unit="step", disable=True if quiet else None)
    for _ in bar:
        optimiser.zero_grad()
        errors = []
        for scene in scenes:
            maps = encoder(scene.batch)
            error = (maps.geometric_height[0] - scene.heights)[scene.observed & maps.covered[0]]
            torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.02).backward()
            errors.append(float(error.detach().abs().median()))
        torch.nn.utils.clip_grad_norm_(encoder.parameters(), 2.0)
        optimiser.step()
        schedule.step()
        bar.set_postfix_str(", ".join(f"{100 * e:.1f} cm" for e in errors))
    return encoder, errors


def figure(scenes: list[Scene], encoder: TerrainEncoder) -> Figure:
    """Image, lidar map, encoder map and their difference, per scene."""
    picture = Figure(figsize=(13.0, 3.4 * len(scenes)), layout="constrained", dpi=90)
    axes = picture.subplots(len(scenes), 4, squeeze=False)
    for row, scene in zip(axes, scenes, strict=True):
        with torch.no_grad():
            maps = encoder(scene.batch)
        known = (scene.observed & maps.covered[0]).numpy()
        measured = np.where(known, scene.heights, np.nan)
        predicted = np.where(known, maps.geometric_height[0], np.nan)
        row[0].imshow(scene.views[0].image)
        row[0].set_title(scene.name)
        row[0].axis("off")
        low, high = np.nanpercentile(measured, (2, 98))
        for ax, values, title, span in (
            (row[1], measured, "lidar [m]", (low, high)),
            (row[2], predicted, "from images [m]", (low, high)),
            (row[3], predicted - measured, "difference [m]", (-0.3, 0.3)),
        ):
            image = ax.imshow(
                values, origin="lower", extent=encoder.config.grid.extent, vmin=span[0], vmax=span[1],
                cmap="terrain" if title != "difference [m]" else "RdBu",
            )  # fmt: skip
            ax.set_title(title, fontsize=10)
            picture.colorbar(image, ax=ax, shrink=0.8)
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder of ROUGH scenes")
    parser.add_argument("--steps", type=int, default=150, help="training steps (%(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="PyTorch threads (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--figure", type=Path, help="draw maps into this PNG")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    config = EncoderConfig()
    scenes = []
    for folder in sorted(p for p in options.scenes.iterdir() if p.is_dir()):
        try:
            scenes.append(read_scene(folder, config))
        except DatasetError as error:
            print(f"skipped: {error}")
    encoder, _ = overfit(scenes, config, options.steps)
    encoder.eval()
    found = {}
    for scene in scenes:
        with torch.no_grad():
            maps = encoder(scene.batch)
        error = (maps.geometric_height[0] - scene.heights).abs()[scene.observed & maps.covered[0]]
        found[scene.name] = {
            "cameras": len(scene.views), "cells": len(error), "median_m": float(error.median()),
            "p90_m": float(error.quantile(0.9)),
        }  # fmt: skip
        print(f"{scene.name}: {len(scene.views)} cameras, {len(error)} cells, median {100 * error.median():.1f} cm")
    if options.json:
        write_text(options.json, json.dumps(found, indent=1) + "\n")
    if options.figure:
        options.figure.write_bytes(figure_png(figure(scenes, encoder)))


if __name__ == "__main__":
    main()
