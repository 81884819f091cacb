"""``synthesize``: record a bag from a simulated world."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from monoforce_ros.core import OptionParser
from monoforce_ros.reporting import progress_bar
from monoforce_ros.synthetic.random_streams import DEFAULT_SEED
from monoforce_ros.synthetic.terrain_shape import GROUNDS

if TYPE_CHECKING:
    from monoforce_ros.synthetic.recording import RecordingSettings
    from monoforce_ros.synthetic.varied.settings import WorldSettings


def build_parser() -> OptionParser:
    """The command line's options."""
    parser = OptionParser(
        prog="synthesize",
        description="Record bags in simulated worlds: hills, ramp, kerbs, rocks, walls, trees, mud and tall grass.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the bag")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED, help="seed of world, commands, noise (%(default)s)")
    parser.add_argument("--duration", type=float, default=10.0, metavar="SECONDS", help="(%(default)s)")
    parser.add_argument(
        "--style",
        choices=("nature", "varied", "textures", "site"),
        default="nature",
        help="nature: one kind of landscape; varied: everything is drawn from wide ranges, for training; textures: as "
        "varied, with random patterns on every surface; site: as varied, nearly level, with more walls and things "
        "(%(default)s)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="GROUP.SETTING=VALUE|LOW..HIGH|NAMES",
        help="narrow a setting of a style other than nature, such as vegetation.height=0.2..0.5; repeatable; "
        "`--set list` lists all settings with their ranges",
    )
    parser.add_argument("--robot", metavar="NAME|FILE.yaml", help="(husky; drawn by all styles but nature)")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="(%(default)s)")
    parser.add_argument("--camera", metavar="WIDTHxHEIGHT|none", help="(320x240; drawn by varied and textures)")
    parser.add_argument(
        "--cameras",
        type=int,
        metavar="1-6",
        help="number of cameras: up to 4 for front, left, right, rear (the robot's); up to 6 anywhere for varied and "
        "textures (drawn)",
    )
    parser.add_argument(
        "--distortion", metavar="K1,K2,P1,P2,K3", help="lens distortion of every camera, such as -0.3,0.1,0,0,0 (none)"
    )
    parser.add_argument("--camera-rate", type=float, default=10.0, metavar="HZ", help="(%(default)s)")
    parser.add_argument("--lidar", default="16x360", metavar="RINGSxCOLUMNS|none", help="(%(default)s)")
    parser.add_argument("--lidar-rate", type=float, default=5.0, metavar="HZ", help="(%(default)s)")
    parser.add_argument(
        "--commands",
        default="random",
        metavar="random|steps|sweep|straight|circle|spin|crab|FILE.csv",
        help="command profile: random follows the world's track and passes obstacles that stop it, steps covers all "
        "motion regimes near the start; crab moves sideways; a file has the columns t,v,w in s, m/s, rad/s, or t,v,w,y "
        "with the speed to the left in m/s (%(default)s)",
    )
    parser.add_argument(
        "--command-type",
        choices=("twist", "ackermann"),
        default="twist",
        help="twist: TwistStamped on /cmd_vel; ackermann: AckermannDriveStamped on /ackermann_cmd, for cars "
        "(%(default)s)",
    )
    parser.add_argument(
        "--flippers",
        default="hold",
        metavar="hold|steps|FILE.csv",
        help="program of flippers, recorded on /flipper_commands: steps moves them at random; a file has a header "
        "t,NAME,... and angles in rad, linear in between (%(default)s)",
    )
    parser.add_argument(
        "--odometry",
        default="truth",
        metavar="truth|slam|slam:METRES,DEGREES",
        help="slam is noisy, delayed and drifting; default noise 0.01 m and 0.5 degrees (%(default)s)",
    )
    hiding = parser.add_mutually_exclusive_group()
    hiding.add_argument(
        "--hide",
        action="append",
        metavar="NAME[:VALUE|:PARAMETER=VALUE,...]",
        help="inject a fault for `diagnose` to find, such as payload:20; repeatable; `--hide list` lists all faults. "
        "The ground truth is written to OUT.hidden.json, never into the bag",
    )
    hiding.add_argument(
        "--hide-random",
        type=int,
        metavar="SEED",
        help="inject random faults: none, one or two of the catalogue, or an out-of-catalogue one",
    )
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument(
        "--terrain-roughness",
        type=float,
        default=1.0,
        metavar="FACTOR",
        help="scales the height of the hills (%(default)s)",
    )
    shape.add_argument("--flat", action="store_true", help="level ground without obstacles or grass")
    shape.add_argument("--bare", action="store_true", help="hills without obstacles or grass")
    parser.add_argument(
        "--ground",
        choices=GROUNDS,
        default="mixed",
        help="mixed: patches of tall grass; rigid: no grass; grass: tall grass on most of the track; yard: walls "
        "and grass around the start (%(default)s)",
    )
    parser.add_argument(
        "--count",
        type=int,
        metavar="N",
        help="record N bags OUT/SEED with consecutive seeds from --seed",
    )
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="bags recorded in parallel (%(default)s)")
    parser.add_argument("--labels", action="store_true", help="write true heights, classes and poses to OUT.labels.npz")
    parser.add_argument("--force", action="store_true", help="overwrite OUT if it exists")
    parser.add_argument("--quiet", action="store_true", help="no progress bar and no summary")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words in (["--hide", "list"], ["--set", "list"]):
        # Lists need no folder.
        words.append("unused")
    options = parser.parse_args(words)
    if options.hide == ["list"]:
        return _list_faults()
    if options.set == ["list"]:
        return _list_settings()
    if options.camera == "none":
        parser.refuse_without_effect(options, ("cameras", "distortion", "camera_rate"), "with --camera none")
    if options.lidar == "none":
        parser.refuse_without_effect(options, ("lidar_rate",), "with --lidar none")
    outs = [options.out]
    if options.count is not None:
        if not 1 <= options.count <= 10_000:
            print(f"synthesize: --count: got {options.count}, expected 1 to 10000", file=sys.stderr)
            return 1
        outs = [options.out / f"{options.seed + index:04d}" for index in range(options.count)]
    existing = [out for out in outs if out.exists()]
    if existing and not options.force:
        print(f"synthesize: {existing[0]} exists already; choose another folder or add --force", file=sys.stderr)
        return 1
    if options.count is None:
        return _record_one(options.out, options)
    return _record_many(outs, options)


def _list_faults() -> int:
    from monoforce_ros.synthetic.hidden import FAULTS

    for name, fault in sorted(FAULTS.items()):
        values = ", ".join(f"{n} = {p.default:g} ({p.low:g} to {p.high:g})" for n, p in fault.parameters.items())
        print(f"{name}: {values}\n    {(fault.__doc__ or '').splitlines()[0]}")
    return 0


def _list_settings() -> int:
    from monoforce_ros.synthetic.varied.settings import WorldSettings

    for name, distribution in WorldSettings().distributions().items():
        print(f"{name}: {distribution}")
    return 0


def _record_many(outs: list[Path], options: argparse.Namespace) -> int:
    """Record a bag for each seed, several at a time in separate processes."""
    # Each process renders with one thread: more would compete for the cores.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    failed = 0
    tasks = []
    for index, out in enumerate(outs):
        seeded = argparse.Namespace(**vars(options))
        seeded.seed, seeded.quiet = options.seed + index, True
        if options.hide_random is not None:
            seeded.hide_random = options.hide_random + index
        tasks.append((out, seeded))
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(max(1, options.jobs), mp_context=context) as pool,
        progress_bar(len(outs), label=options.out.name, unit="bag", quiet=options.quiet, always=True) as bar,
    ):
        for done in as_completed([pool.submit(_record_one, *task) for task in tasks]):
            failed += done.result() != 0
            bar.update()
    if failed:
        print(f"synthesize: {failed} of {len(outs)} bags failed", file=sys.stderr)
    return int(failed > 0)


def _settings(options: argparse.Namespace) -> RecordingSettings:
    from monoforce_ros.synthetic.hidden import draw_hidden, parse_hidden
    from monoforce_ros.synthetic.odometry import OdometrySettings
    from monoforce_ros.synthetic.recording import RecordingSettings
    from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
    from monoforce_ros.synthetic.terrain_shape import TerrainSettings

    world = _world(options)
    camera = _size(options.camera or "320x240", "--camera")
    lidar = _size(options.lidar, "--lidar")
    odometry = OdometrySettings()
    if options.odometry != "truth":
        name, _, noise = options.odometry.partition(":")
        if name != "slam":
            raise ValueError(f"--odometry: got {options.odometry!r}, expected truth, slam or slam:METRES,DEGREES")
        odometry = OdometrySettings.slam()
        if noise:
            metres, degrees = _numbers(noise, 2, "--odometry slam")
            odometry = OdometrySettings.slam(metres, math.radians(degrees))
    hidden = None
    if options.hide is not None:
        hidden = tuple(parse_hidden(text) for text in options.hide)
    elif options.hide_random is not None:
        has_grass = not (options.flat or options.bare)
        hidden = draw_hidden(options.hide_random, () if has_grass else ("vegetation_drag",))
    distortion = tuple(_numbers(options.distortion, 5, "--distortion")) if options.distortion else ()
    return RecordingSettings(
        seed=options.seed,
        duration=options.duration,
        robot=options.robot or "husky",
        commands=options.commands,
        command_type=options.command_type,
        flippers=options.flippers,
        terrain=TerrainSettings(
            roughness=options.terrain_roughness, flat=options.flat, bare=options.bare, ground=options.ground
        ),
        camera=camera
        and CameraSettings(width=camera[0], height=camera[1], rate=options.camera_rate, distortion=distortion),
        cameras=None if world is not None else options.cameras,
        lidar=lidar and LidarSettings(rings=lidar[0], columns=lidar[1], rate=options.lidar_rate),
        odometry=odometry,
        hidden=hidden,
        storage=options.storage,
        labels=options.labels,
        overwrite=options.force,
        world=world,
    )


def _world(options: argparse.Namespace) -> WorldSettings | None:
    """Ranges of a randomised world, narrowed by the options; None for style ``nature``."""
    from monoforce_ros.synthetic.varied.distribution import Choice, Uniform
    from monoforce_ros.synthetic.varied.settings import WorldSettings

    assignments = {}
    for text in options.set:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set: got {text!r}, expected GROUP.SETTING=VALUE; `--set list` lists all settings")
        assignments[name.strip()] = value.strip()
    if options.style == "nature":
        if assignments:
            raise ValueError(f"--set {options.set[0]}: style nature has no such settings; add --style varied")
        return None
    fixed = {
        "--ground": options.ground != "mixed", "--flat": options.flat, "--bare": options.bare,
        "--terrain-roughness": options.terrain_roughness != 1.0, "--distortion": bool(options.distortion),
    }  # fmt: skip
    for option, is_given in fixed.items():
        if is_given:
            raise ValueError(f"{option}: applies to --style nature only; use --set, `--set list` lists the settings")
    settings = WorldSettings.of_style(options.style).narrowed(assignments)
    rig = replace(settings.rig, rate=Uniform(options.camera_rate, options.camera_rate))
    if options.camera not in (None, "none"):
        _size(options.camera, "--camera")
        rig = replace(rig, size=Choice((options.camera,)))
    if options.cameras is not None:
        if not 1 <= options.cameras <= 6:
            raise ValueError(f"--cameras: got {options.cameras}, expected 1 to 6")
        rig = replace(rig, count=Choice((str(options.cameras),)))
    robot = settings.robot if options.robot is None else replace(settings.robot, kind=Choice((options.robot,)))
    return replace(settings, rig=rig, robot=robot)


def _record_one(out: Path, options: argparse.Namespace) -> int:
    # Imported late, so that --help and option errors are fast.
    from monoforce_ros.robots import RobotFileError
    from monoforce_ros.synthetic.graphics import DrawingError
    from monoforce_ros.synthetic.hidden import truth_file
    from monoforce_ros.synthetic.labels import labels_file
    from monoforce_ros.synthetic.recording import record

    started = time.monotonic()
    try:
        settings = _settings(options)
        bar_format = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s [{elapsed}<{remaining}]"
        with progress_bar(
            options.duration, label=out.name, bar_format=bar_format, quiet=options.quiet, always=True, leave=False
        ) as bar:
            summary = record(out, settings, bar.update)
    except (DrawingError, RobotFileError, ValueError, OSError) as error:
        print(f"synthesize: {error}", file=sys.stderr)
        return 1
    if summary.mishap is not None:
        print(f"synthesize: {summary.mishap} after {summary.duration:.1f} s; {out} ends there", file=sys.stderr)
    if not options.quiet:
        size = sum(path.stat().st_size for path in out.iterdir()) / 1e6
        print(
            f"{out}: {summary.duration:.1f} s, {summary.distance:.1f} m driven, "
            f"{sum(summary.messages.values())} messages, {size:.1f} MB, in {time.monotonic() - started:.0f} s"
        )
        if options.labels:
            print(f"{labels_file(out)}: true heights, classes and poses")
        if settings.hidden is not None:
            print(f"{truth_file(out)}: injected faults")
    return 0


def _numbers(text: str, count: int, option: str) -> list[float]:
    """Comma-separated numbers."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{option}: got {text!r}, expected {count} comma-separated numbers")
    return numbers


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
