"""``synthesize``: record a bag from a simulated world."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from monoforce_ros.synthetic.random_streams import DEFAULT_SEED


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(
        prog="synthesize",
        description="Record a rosbag2 bag from a simulated world of hills, a ramp, rocks, trees and soft tall grass.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the bag")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED, help="of world, drive and noise (%(default)s)")
    parser.add_argument("--duration", type=float, default=10.0, metavar="SECONDS", help="(%(default)s)")
    parser.add_argument("--robot", default="husky", metavar="NAME|FILE.yaml", help="(%(default)s)")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="(%(default)s)")
    parser.add_argument("--camera", default="320x240", metavar="WIDTHxHEIGHT|none", help="(%(default)s)")
    parser.add_argument("--camera-rate", type=float, default=10.0, metavar="HZ", help="(%(default)s)")
    parser.add_argument("--lidar", default="16x360", metavar="RINGSxCOLUMNS|none", help="(%(default)s)")
    parser.add_argument("--lidar-rate", type=float, default=5.0, metavar="HZ", help="(%(default)s)")
    parser.add_argument(
        "--commands",
        default="random",
        metavar="random|straight|circle|FILE.csv",
        help="who drives; a file has the columns t,v,w in s, m/s, rad/s (%(default)s)",
    )
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument(
        "--terrain-roughness", type=float, default=1.0, metavar="FACTOR", help="on the height of hills (%(default)s)"
    )
    shape.add_argument("--flat", action="store_true", help="level ground with nothing on it")
    parser.add_argument("--labels", action="store_true", help="write the true heights and classes to OUT.labels.npz")
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")
    parser.add_argument("--quiet", action="store_true", help="no progress and no summary")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.out.exists() and not options.force:
        print(f"synthesize: {options.out} exists already; choose another folder or add --force", file=sys.stderr)
        return 1
    # Only now, so that --help and a wrong option answer at once.
    from monoforce_ros.robots import RobotFileError
    from monoforce_ros.synthetic.graphics import DrawingError
    from monoforce_ros.synthetic.labels import labels_file
    from monoforce_ros.synthetic.recording import RecordingSettings, record
    from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
    from monoforce_ros.synthetic.terrain_shape import TerrainSettings

    started = time.monotonic()
    try:
        camera, lidar = _size(options.camera, "--camera"), _size(options.lidar, "--lidar")
        settings = RecordingSettings(
            seed=options.seed,
            duration=options.duration,
            robot=options.robot,
            commands=options.commands,
            terrain=TerrainSettings(roughness=options.terrain_roughness, flat=options.flat),
            camera=camera and CameraSettings(width=camera[0], height=camera[1], rate=options.camera_rate),
            lidar=lidar and LidarSettings(rings=lidar[0], columns=lidar[1], rate=options.lidar_rate),
            storage=options.storage,
            labels=options.labels,
            overwrite=options.force,
        )
        form = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s [{elapsed}<{remaining}]"
        with tqdm(
            total=options.duration, desc=options.out.name, bar_format=form, disable=options.quiet, leave=False
        ) as bar:
            summary = record(options.out, settings, bar.update)
    except (DrawingError, RobotFileError, ValueError, OSError) as error:
        print(f"synthesize: {error}", file=sys.stderr)
        return 1
    if summary.mishap is not None:
        print(f"synthesize: {summary.mishap} after {summary.duration:.1f} s; the bag ends there", file=sys.stderr)
    if not options.quiet:
        size = sum(path.stat().st_size for path in options.out.iterdir()) / 1e6
        print(
            f"{options.out}: {summary.duration:.1f} s, {summary.distance:.1f} m driven, "
            f"{sum(summary.messages.values())} messages, {size:.1f} MB, in {time.monotonic() - started:.0f} s"
        )
        if options.labels:
            print(f"{labels_file(options.out)}: true heights and classes")
    return 0


def _size(text: str, option: str) -> tuple[int, int] | None:
    """``AxB`` as two whole numbers, or None for ``none``."""
    if text == "none":
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"{option}: got {text!r}, expected two whole numbers as in 320x240, or none")
    return int(parts[0]), int(parts[1])


if __name__ == "__main__":
    sys.exit(main())
