"""``diagnose``: find the physical effect that a robot's model lacks, and write it into a copy of its file."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from monoforce_ros.bags import BagError, Recording, SmoothedMotion, smooth
from monoforce_ros.discrepancy.diagnosis import Diagnosis, Settings, commission, diagnose
from monoforce_ros.discrepancy.report import summary_lines, write_diagnosis
from monoforce_ros.discrepancy.robot_copy import fingerprint, read_leftover, write_robot
from monoforce_ros.physics.effects import EffectError
from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, shipped_robots
from monoforce_ros.terrain import Grid, TerrainFileError, TerrainMap, load_terrain
from monoforce_ros.terrain.lidar import TerrainError
from monoforce_ros.training.visible import visible_terrain

_MARGIN = 4.0


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(
        prog="diagnose",
        description="Compare a robot's model with drives, find which physical effect it lacks, and write a copy "
        "of its file that holds the effect. Each bag gets a folder with report.html and report.json.",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder or ROS 1 .bag file")
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument(
        "--terrain", default="flat", metavar="flat|lidar|FILE", help="ground of the drive; a file of fit_terrain (flat)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the reports")
    parser.add_argument(
        "--commission",
        action="store_true",
        help="fit what every new robot needs (friction, effective track width, servo response) to drives of the "
        "healthy robot on level ground and write OUT/ROBOT.yaml, the nominal model of later runs",
    )
    parser.add_argument("--effects", type=int, default=2, metavar="N", help="at most (%(default)s)")
    parser.add_argument("--odometry", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--commands", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--cloud", metavar="TOPIC", help="(found by type)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not 1 <= options.effects <= 5:
        parser.error(f"--effects: got {options.effects}, expected 1 to 5")
    # Many small operations: one thread is faster than several, and does not collapse on a busy machine.
    torch.set_num_threads(1)
    try:
        robot = load_robot(options.robot)
        if options.commission:
            return _commission(robot, options)
        for bag in options.bags:
            _diagnose_bag(bag, robot, options)
    except (BagError, EffectError, RobotFileError, TerrainFileError, TerrainError, ValueError, OSError) as error:
        print(f"diagnose: {error}", file=sys.stderr)
        return 1
    return 0


def _commission(robot: RobotModel, options: argparse.Namespace) -> int:
    drives = []
    for bag in options.bags:
        recording = Recording.open(bag, odometry=options.odometry, commands=options.commands)
        drives.append((smooth(recording.motion), recording.commands))
    settings = Settings()
    effects, leftover = commission(drives, robot, settings=settings)
    kept = {
        "samples_s": list(settings.samples),
        "residual_rms": [[float(f"{value:.4g}") for value in row] for row in leftover],
    }
    out = write_robot(
        options.robot, options.out / f"{robot.name}.yaml", effects, options.bags, fingerprint(options.bags), kept
    )
    for effect in effects:
        for key, entry in effect["parameters"].items():
            print(f"{effect['name']}: {key} {entry['value']:.3g} {entry['unit']}")
    along, across, heading = leftover[-1]
    print(
        f"left on the healthy robot after {settings.horizon:g} s: {100 * along:.1f} cm along, "
        f"{100 * across:.1f} cm across, {np.degrees(heading):.2f}° in heading"
    )
    print(f"robot file: {out}")
    return 0


def _diagnose_bag(bag: Path, robot: RobotModel, options: argparse.Namespace) -> Diagnosis:
    began = time.monotonic()
    recording = Recording.open(bag, odometry=options.odometry, commands=options.commands, cloud=options.cloud)
    for complaint in recording.complaints[:3]:
        print(f"diagnose: {complaint}", file=sys.stderr)
    smoothed = smooth(recording.motion)
    terrain, pose = _terrain(recording, smoothed, robot, options.terrain)
    form = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}] {postfix}"
    with tqdm(total=100, desc=bag.name, bar_format=form, disable=True if options.quiet else None, leave=False) as bar:

        def progress(share: float, what: str) -> None:
            bar.set_postfix_str(what, refresh=False)
            bar.update(100 * share - bar.n)

        diagnosis = diagnose(
            smoothed,
            recording.commands,
            robot,
            terrain=terrain,
            odometry_from_terrain=pose,
            leftover=read_leftover(options.robot, Settings().samples),
            settings=Settings(most_effects=options.effects),
            progress=progress,
        )
    folder = options.out / bag.name.removesuffix(".bag") if len(options.bags) > 1 else options.out
    data = fingerprint([bag])
    robot_file = None
    if diagnosis.effects:
        robot_file = write_robot(options.robot, folder / f"{robot.name}.yaml", diagnosis.effects, [bag], data)
    inputs = {
        "bag": str(bag),
        "data": data,
        "robot": str(options.robot),
        "terrain": options.terrain,
        "topics": ", ".join(f"{role} {topic}" for role, topic in recording.topics.items()),
        "noise of the poses": f"{100 * smoothed.position_noise:.1f} cm, {np.degrees(smoothed.rotation_noise):.2f}°",
        "duration_s": round(time.monotonic() - began, 1),
    }
    _, page = write_diagnosis(folder, diagnosis, inputs, robot_file)
    print("\n".join([f"{bag}: " + summary_lines(diagnosis)[0], *summary_lines(diagnosis)[1:]]))
    if robot_file:
        print(f"  robot file: {robot_file}")
    print(f"  report: {page}")
    return diagnosis


def _terrain(
    recording: Recording, smoothed: SmoothedMotion, robot: RobotModel, source: str
) -> tuple[TerrainMap | None, np.ndarray | None]:
    if source == "flat":
        return None, None
    if source != "lidar":
        return load_terrain(Path(source))
    motion = smoothed.motion
    low, high = motion.positions.min(axis=0)[:2] - _MARGIN, motion.positions.max(axis=0)[:2] + _MARGIN
    columns, rows = np.ceil((high - low) / 0.1).astype(int) + 1
    grid = Grid(int(rows), int(columns), 0.1, (float(low[0]), float(low[1])))
    start, stop = int(motion.stamps[0]), int(motion.stamps[-1])
    return visible_terrain(recording, motion, robot, grid, np.eye(4), start=start, stop=stop), np.eye(4)


if __name__ == "__main__":
    sys.exit(main())
