"""``fit_terrain``: fits the terrain under a robot to recordings of its motion."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import warnings
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.bags import BagError, Recording, SmoothedMotion, add_read_options, read_options, smooth
from monoforce_ros.core import OptionParser, write_bytes, write_text
from monoforce_ros.reporting import figure_png, progress
from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, shipped_robots
from monoforce_ros.terrain import TerrainDefaults, TerrainError, save_terrain
from monoforce_ros.training.fit_figure import fit_figure
from monoforce_ros.training.terrain_fit import FitSettings, TerrainFit, fit_terrain, trajectory_frame, trajectory_grid
from monoforce_ros.training.visible import visible_terrain

_SWEEPS_BEFORE = 2.0
"""Sweeps this long before a trajectory belong to its map too [s]."""


@dataclass(frozen=True)
class FitFigures:
    """Figures of one fit, as in ``fit_terrain.json``."""

    height_error_seen_m: float
    """Median height error at the end of a chunk on the visible terrain."""
    height_error_m: float
    """The same on the fitted terrain."""
    loss_first: float
    loss_last: float
    contact_cells: int

    @classmethod
    def of(cls, fit: TerrainFit) -> FitFigures:
        """The figures of a fit."""
        return cls(
            height_error_seen_m=float(np.median(fit.before)),
            height_error_m=float(np.median(fit.after)),
            loss_first=float(fit.losses[0]) if len(fit.losses) else 0.0,
            loss_last=float(fit.losses[-1]) if len(fit.losses) else 0.0,
            contact_cells=int(fit.contact_mask.sum()),
        )


@dataclass(frozen=True)
class FittedTrajectory:
    """A row of ``fit_terrain.json``: the figures of a trajectory, or the reason why there are none."""

    name: str
    file: str
    start_ns: int
    length_s: float
    figures: FitFigures | None = None
    error: str = ""

    @property
    def row(self) -> dict[str, str | float]:
        """As written to the file."""
        row: dict[str, str | float] = {
            "name": self.name, "file": self.file, "start_ns": self.start_ns, "length_s": self.length_s,
        }  # fmt: skip
        if self.figures is None:
            return row | {"error": self.error}
        # felt_cells: the name of contact_cells in earlier releases.
        return row | asdict(self.figures) | {"felt_cells": self.figures.contact_cells}


def build_parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = OptionParser(
        prog="fit_terrain",
        description="Fit the supporting terrain (H_t*) to recorded motion by gradient descent through the physics, and "
        "map the visible terrain (H_g*) from lidar sweeps. Writes a map, a figure and metrics for each trajectory. "
        "The same command resumes an interrupted run.",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folders or ROS 1 .bag files")
    parser.add_argument("--out", type=Path, required=True, help="folder for the maps")
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument("--length", type=float, default=10.0, metavar="S", help="length of a trajectory (default: "
                        "%(default)s)")  # fmt: skip
    parser.add_argument("--stride", type=float, metavar="S", help="interval between the starts of trajectories "
                        "(default: the length)")  # fmt: skip
    parser.add_argument("--chunk", type=float, default=FitSettings.chunk, metavar="S", help="length of the "
                        "chunks that are rolled out (default: %(default)s)")  # fmt: skip
    parser.add_argument("--iterations", type=int, default=FitSettings.iterations, help="gradient steps "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--no-lidar", action="store_true", help="fit to the motion only")
    parser.add_argument("--traced", action="store_true", help="leave heights as the wheels traced them, and fit "
                        "material only")  # fmt: skip
    parser.add_argument("--friction", action="store_true", help="fit friction too")
    parser.add_argument("--stiffness", action="store_true", help="fit the stiffness of the ground too")
    parser.add_argument("--position-noise", type=float, metavar="M", help="standard deviation of the "
                        "odometry's position (default: estimated)")  # fmt: skip
    parser.add_argument("--rotation-noise", type=float, metavar="DEG", help="standard deviation of the "
                        "odometry's rotation (default: estimated)")  # fmt: skip
    add_read_options(parser)
    parser.add_argument("--force", action="store_true", help="fit existing maps again")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not 1.0 <= options.length <= 120.0 or (options.stride is not None and not 0.1 <= options.stride <= 3600.0):
        parser.error("--length: expected 1 to 120 s; --stride: 0.1 to 3600 s")
    # For many small operations one thread is faster than several, and robust to other load.
    torch.set_num_threads(1)
    try:
        settings = FitSettings(
            chunk=options.chunk, iterations=options.iterations, heights=not options.traced, friction=options.friction,
            stiffness=options.stiffness,
        )  # fmt: skip
        robot = load_robot(options.robot)
        done = [_fit_bag(bag, robot, settings, options) for bag in options.bags]
    except (BagError, RobotFileError, ValueError, OSError) as error:
        print(f"fit_terrain: {error}", file=sys.stderr)
        return 1
    trajectories = [trajectory for of_bag in done for trajectory in of_bag]
    rows = [trajectory.row for trajectory in trajectories]
    write_text(options.out / "fit_terrain.json", json.dumps({"trajectories": rows}, indent=2))
    for trajectory in trajectories:
        if trajectory.figures is None:
            print(f"fit_terrain: {trajectory.name} skipped: {trajectory.error}", file=sys.stderr)
    fitted = [trajectory.figures for trajectory in trajectories if trajectory.figures is not None]
    if not fitted:
        print("fit_terrain: no trajectory could be fitted", file=sys.stderr)
        return 1
    before = np.median([figures.height_error_seen_m for figures in fitted])
    after = np.median([figures.height_error_m for figures in fitted])
    print(
        f"{len(fitted)} trajectories in {options.out}: median height error after {options.chunk:g} s "
        f"{100 * before:.1f} cm on visible, {100 * after:.1f} cm on fitted terrain"
    )
    return 0


def _fit_bag(
    bag: Path, robot: RobotModel, settings: FitSettings, options: argparse.Namespace
) -> list[FittedTrajectory]:
    reading = read_options(options)
    recording = reading.open(bag, robot)
    robot = reading.robot_in_bag(robot)
    for complaint in recording.warnings[:3]:
        print(f"fit_terrain: {complaint}", file=sys.stderr)
    if not len(recording.commands):
        raise BagError(f"{bag}: no commands (Twist or TwistStamped), which the physics needs")
    noise = None if options.rotation_noise is None else np.radians(options.rotation_noise)
    smoothed = smooth(recording.motion, position_noise=options.position_noise, rotation_noise=noise)
    stride = round(1e9 * (options.stride or options.length))
    first, last = int(recording.motion.stamps[0]), int(recording.motion.stamps[-1])
    starts = range(first, last - round(1e9 * options.length) + 1, stride)
    if not starts:
        raise BagError(f"{bag}: got {(last - first) * 1e-9:.1f} s of odometry, expected {options.length:g} s or more")
    trajectories = []
    bar = progress(starts, label=bag.name, unit="trajectory", quiet=options.quiet)
    for index, start in enumerate(bar):
        name = f"{bag.name.removesuffix('.bag')}_{index:03d}"
        trajectories.append(_fit_one(name, recording, smoothed, robot, start, settings, options))
        figures = trajectories[-1].figures
        error = figures.height_error_m if figures is not None else np.nan
        bar.set_postfix({"height error": f"{100 * error:.1f} cm"})
    return trajectories


def _fit_one(
    name: str,
    recording: Recording,
    smoothed: SmoothedMotion,
    robot: RobotModel,
    start: int,
    settings: FitSettings,
    options: argparse.Namespace,
) -> FittedTrajectory:
    file = options.out / f"{name}.npz"
    fingerprint = _fingerprint(recording, robot, start, settings, options)
    trajectory = FittedTrajectory(name, file.name, start, options.length)
    existing = None if options.force else existing_figures(file, fingerprint)
    if existing is not None:
        return replace(trajectory, figures=existing)
    motion = smoothed.motion
    try:
        material = TerrainDefaults()
        grid, pose = trajectory_grid(motion, start, options.length, settings), trajectory_frame(motion, start)
        visible = None
        if recording.clouds and not options.no_lidar:
            stop = start + round(1e9 * options.length)
            first_sweep = start - round(1e9 * _SWEEPS_BEFORE)
            visible = visible_terrain(
                recording, motion, robot, grid, pose, start=first_sweep, stop=stop, material=material
            )
        fit = fit_terrain(
            motion, recording.commands, robot, start=start, length=options.length, visible=visible, settings=settings,
            joints=recording.joints,
        )  # fmt: skip
    except (TerrainError, ValueError) as error:
        return replace(trajectory, error=str(error))
    figures = FitFigures.of(fit)
    title = f"{name}, {(start - recording.motion.stamps[0]) * 1e-9:.1f} s into the recording"
    write_bytes(options.out / f"{name}.png", figure_png(fit_figure(fit, title)))
    # The map is written last: it marks the trajectory as complete.
    save_terrain(
        file,
        fit.terrain,
        fit.odometry_from_terrain,
        contact_mask=fit.contact_mask,
        start_ns=np.array(start),
        fingerprint=np.array(fingerprint),
        figures=np.array(json.dumps(asdict(figures))),
    )
    return replace(trajectory, figures=figures)


def _fingerprint(
    recording: Recording, robot: RobotModel, start: int, settings: FitSettings, options: argparse.Namespace
) -> str:
    content = [
        str(recording.path.name), len(recording.motion), len(recording.commands), len(recording.clouds), start,
        robot.name, [round(float(v), 9) for v in robot.points.flatten()[:60]], float(robot.mass), str(robot.effects),
        asdict(settings), asdict(read_options(options)), options.length, options.no_lidar, options.position_noise,
        options.rotation_noise,
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()


def existing_figures(file: Path, fingerprint: str) -> FitFigures | None:
    """Figures of an existing map, or None unless it was fitted to the same data with the same settings."""
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as content:
            if str(content["fingerprint"]) != fingerprint:
                return None
            figures = json.loads(str(content["figures"]))
        if "felt_cells" in figures:
            figures["contact_cells"] = figures.pop("felt_cells")
            text = f"{file}: 'felt' is now 'contact_mask'; fit it again with --force to rename it"
            warnings.warn(text, FutureWarning, stacklevel=2)
        return FitFigures(**figures)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile):
        return None


if __name__ == "__main__":
    sys.exit(main())
