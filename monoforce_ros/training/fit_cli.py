"""``fit_terrain``: the ground under recorded drives, from how the robot moved on it."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from monoforce_ros.bags import BagError, Recording, SmoothedMotion, smooth
from monoforce_ros.core import write_bytes, write_text
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, shipped_robots
from monoforce_ros.terrain import TerrainDefaults, TerrainError, save_terrain
from monoforce_ros.training.fit_figure import fit_figure
from monoforce_ros.training.terrain_fit import FitSettings, fit_terrain, trajectory_frame, trajectory_grid
from monoforce_ros.training.visible import visible_terrain

_SEEN_BEFORE = 2.0
"""Sweeps from this long before a trajectory count for it too [s]."""


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(
        prog="fit_terrain",
        description="Fit the terrain that carried a robot (H_t*) to recorded drives by gradient descent through the "
        "physics, and map what its lidar saw (H_g*). Writes a map, a picture and figures for each trajectory. "
        "An interrupted run goes on where it stopped.",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder or ROS 1 .bag file")
    parser.add_argument("--out", type=Path, required=True, help="folder for the maps")
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument("--length", type=float, default=10.0, metavar="S", help="of a trajectory (%(default)s)")
    parser.add_argument("--stride", type=float, metavar="S", help="between starts of trajectories (the length)")
    parser.add_argument("--chunk", type=float, default=FitSettings.chunk, metavar="S", help="rolled out (%(default)s)")
    parser.add_argument("--iterations", type=int, default=FitSettings.iterations, help="(%(default)s)")
    parser.add_argument("--no-lidar", action="store_true", help="from the motion alone")
    parser.add_argument("--friction", action="store_true", help="fit friction too")
    parser.add_argument("--position-noise", type=float, metavar="M", help="of the odometry (found from the data)")
    parser.add_argument("--rotation-noise", type=float, metavar="DEG", help="of the odometry (found from the data)")
    parser.add_argument("--odometry", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--commands", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--cloud", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--force", action="store_true", help="fit again what is there already")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not 1.0 <= options.length <= 120.0 or (options.stride is not None and not 0.1 <= options.stride <= 3600.0):
        parser.error("--length: expected 1 to 120 s; --stride: 0.1 to 3600 s")
    # Many small operations: one thread is faster than several, and does not collapse on a busy machine.
    torch.set_num_threads(1)
    try:
        settings = FitSettings(chunk=options.chunk, iterations=options.iterations, friction=options.friction)
        robot = load_robot(options.robot)
        done = [_fit_bag(bag, robot, settings, options) for bag in options.bags]
    except (BagError, RobotFileError, ValueError, OSError) as error:
        print(f"fit_terrain: {error}", file=sys.stderr)
        return 1
    rows = [row for listed in done for row in listed]
    write_text(options.out / "fit_terrain.json", json.dumps({"trajectories": rows}, indent=2))
    fitted = [row for row in rows if "error" not in row]
    for row in rows:
        if "error" in row:
            print(f"fit_terrain: {row['name']} left out: {row['error']}", file=sys.stderr)
    if not fitted:
        print("fit_terrain: nothing could be fitted", file=sys.stderr)
        return 1
    before, after = (np.median([row[which] for row in fitted]) for which in ("height_error_seen_m", "height_error_m"))
    print(
        f"{len(fitted)} trajectories in {options.out}: median height error after {options.chunk:g} s "
        f"{100 * before:.1f} cm on what was seen, {100 * after:.1f} cm on what was fitted"
    )
    return 0


def _fit_bag(bag: Path, robot: RobotModel, settings: FitSettings, options: argparse.Namespace) -> list[dict]:
    recording = Recording.open(bag, odometry=options.odometry, commands=options.commands, cloud=options.cloud)
    for complaint in recording.warnings[:3]:
        print(f"fit_terrain: {complaint}", file=sys.stderr)
    if not len(recording.commands):
        raise BagError(f"{bag}: no commands (Twist or TwistStamped): the physics needs them")
    noise = None if options.rotation_noise is None else np.radians(options.rotation_noise)
    smoothed = smooth(recording.motion, position_noise=options.position_noise, rotation_noise=noise)
    stride = round(1e9 * (options.stride or options.length))
    first, last = int(recording.motion.stamps[0]), int(recording.motion.stamps[-1])
    starts = range(first, last - round(1e9 * options.length) + 1, stride)
    if not starts:
        raise BagError(f"{bag}: {(last - first) * 1e-9:.1f} s of odometry, expected at least {options.length:g} s")
    rows = []
    bar = tqdm(starts, desc=bag.name, unit="trajectory", disable=True if options.quiet else None)
    for index, start in enumerate(bar):
        name = f"{bag.name.removesuffix('.bag')}_{index:03d}"
        rows.append(_fit_one(name, recording, smoothed, robot, start, settings, options))
        bar.set_postfix({"height error": f"{100 * rows[-1].get('height_error_m', float('nan')):.1f} cm"})
    return rows


def _fit_one(
    name: str,
    recording: Recording,
    smoothed: SmoothedMotion,
    robot: RobotModel,
    start: int,
    settings: FitSettings,
    options: argparse.Namespace,
) -> dict:
    file = options.out / f"{name}.npz"
    fingerprint = _fingerprint(recording, robot, start, settings, options)
    row: dict = {"name": name, "file": file.name, "start_ns": start, "length_s": options.length}
    kept = None if options.force else _kept(file, fingerprint)
    if kept is not None:
        return row | kept
    motion = smoothed.motion
    try:
        material = TerrainDefaults()
        grid, pose = trajectory_grid(motion, start, options.length, settings), trajectory_frame(motion, start)
        visible = None
        if recording.clouds and not options.no_lidar:
            stop = start + round(1e9 * options.length)
            seen_from = start - round(1e9 * _SEEN_BEFORE)
            visible = visible_terrain(
                recording, motion, robot, grid, pose, start=seen_from, stop=stop, material=material
            )
        fit = fit_terrain(
            motion, recording.commands, robot, start=start, length=options.length, visible=visible, settings=settings
        )
    except (TerrainError, ValueError) as error:
        return row | {"error": str(error)}
    figures = {
        "height_error_seen_m": float(np.median(fit.before)),
        "height_error_m": float(np.median(fit.after)),
        "loss_first": float(fit.losses[0]) if len(fit.losses) else 0.0,
        "loss_last": float(fit.losses[-1]) if len(fit.losses) else 0.0,
        "felt_cells": int(fit.felt.sum()),
    }
    title = f"{name}, {(start - recording.motion.stamps[0]) * 1e-9:.1f} s into the drive"
    picture = options.out / f"{name}.png"
    write_bytes(picture, figure_png(fit_figure(fit, title)))
    # The map comes last: where it is, the picture is too.
    save_terrain(
        file,
        fit.terrain,
        fit.odometry_from_terrain,
        felt=fit.felt,
        start_ns=np.array(start),
        fingerprint=np.array(fingerprint),
        figures=np.array(json.dumps(figures)),
    )
    return row | figures


def _fingerprint(
    recording: Recording, robot: RobotModel, start: int, settings: FitSettings, options: argparse.Namespace
) -> str:
    said = [
        str(recording.path.name), len(recording.motion), len(recording.commands), len(recording.clouds), start,
        robot.name, [round(float(v), 9) for v in robot.points.flatten()[:60]], float(robot.mass), str(robot.effects),
        asdict(settings), options.length, options.no_lidar, options.position_noise, options.rotation_noise,
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(said, default=str).encode()).hexdigest()


def _kept(file: Path, fingerprint: str) -> dict | None:
    """Figures of a map that was fitted from the same data in the same way, or None."""
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as content:
            if str(content["fingerprint"]) != fingerprint:
                return None
            figures = json.loads(str(content["figures"]))
            return {name: float(value) for name, value in figures.items()}
    except (OSError, ValueError, KeyError, AttributeError, zipfile.BadZipFile):
        return None


if __name__ == "__main__":
    sys.exit(main())
