"""``diagnose``: find the physical effects that a robot's model lacks, and write them into a copy of its file."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from itertools import chain, count
from pathlib import Path

import torch

from monoforce_ros.bags import BagError, add_read_options, read_options
from monoforce_ros.core import OptionParser
from monoforce_ros.discrepancy.bag_diagnosis import BagDiagnosis, diagnose_bag, read_with_ground, usable_folder
from monoforce_ros.discrepancy.commissioning import commission
from monoforce_ros.discrepancy.comparable_windows import comparable_windows
from monoforce_ros.discrepancy.diagnosis import DiagnosisSettings
from monoforce_ros.discrepancy.export import export_effects, export_target
from monoforce_ros.discrepancy.interruption import INTERRUPTED_STATUS, interruptible, uninterrupted
from monoforce_ros.discrepancy.kept_effects import kept_effects
from monoforce_ros.discrepancy.nominal_residual import residual_complaint
from monoforce_ros.discrepancy.partial_effects import effects_for_file
from monoforce_ros.discrepancy.repetition import prepare_processes
from monoforce_ros.discrepancy.report import effect_entry, summary_lines
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.discrepancy.wheel_units import contradictions
from monoforce_ros.effects import EffectError
from monoforce_ros.encoder import CheckpointError
from monoforce_ros.reporting import progress_bar
from monoforce_ros.robots import RobotFileError, fingerprint, load_robot, shipped_robots, write_robot
from monoforce_ros.terrain import TerrainError, TerrainFileError

NOT_IDENTIFIABLE_STATUS = 3
"""Exit status where a recording cannot be diagnosed; 1 is an error, 2 a wrong option."""
_MOST_COMPLAINTS = 3
"""Problems of a bag that are printed; all are in the report."""
_ERRORS = (BagError, CheckpointError, EffectError, RobotFileError, TerrainFileError, TerrainError, ValueError, OSError)


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = OptionParser(
        prog="diagnose",
        description="Compare a robot's model with recordings, find the physical effects that it lacks, and write them "
        "into a copy of its file. Each bag gets a folder with report.html and report.json.",
        epilog="Exit status: 0 a diagnosis was made; 1 an error; 2 wrong usage; 3 a recording cannot be diagnosed "
        "(not_identifiable), the report says why; 130 interrupted (Ctrl-C).",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder or ROS 1 .bag file")
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument(
        "--terrain",
        default="auto",
        metavar="auto|flat|lidar|traced|camera|lidar_camera|FILE",
        help="ground of the recording: level (flat), mapped from the lidar, traced by the wheels along the poses, "
        "predicted by the terrain encoder from images (camera, lidar_camera; camera:WEIGHTS for other weights than the "
        "shipped ones), a file of fit_terrain, or what the bag holds (auto): clouds, else poses where they show "
        "slopes, else level (%(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the reports")
    parser.add_argument(
        "--commission",
        action="store_true",
        help="fit friction, effective track width and servo response to recordings of the healthy robot and write "
        "OUT/ROBOT.yaml, the nominal model for later runs",
    )
    parser.add_argument(
        "--effects", type=int, default=4, metavar="N", help="largest number of effects to add (%(default)s)"
    )
    add_read_options(parser)
    parser.add_argument(
        "--held-out",
        nargs="+",
        type=Path,
        default=[],
        metavar="BAG",
        help="compare errors before and after on these other recordings too; nothing is fitted to them",
    )
    parser.add_argument(
        "--local-effects",
        action="store_true",
        help="write effects that act on a part of the ground only into the robot file (and exports), too: predictions "
        "on all other ground get worse with them",
    )
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        metavar="FILE",
        help="write the effects for other tools: FILE.xml (MuJoCo), FILE.diff_drive.yaml (ros2_control) or "
        "FILE.nav2.yaml (Nav2), or KIND:FILE with mujoco, diff_drive or nav2; with one bag only",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=2,
        metavar="N",
        help="processes: bags diagnosed in parallel, or of one bag the repetitions without parts of it (%(default)s)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not 1 <= options.effects <= 6:
        parser.error(f"--effects: got {options.effects}, expected 1 to 6")
    if options.jobs < 1:
        parser.error(f"--jobs: got {options.jobs}, expected 1 or more")
    if options.export and (len(options.bags) > 1 or options.commission):
        parser.error("--export: got several bags or --commission, expected one bag to diagnose")
    try:
        for target in options.export:
            export_target(target)
    except ValueError as error:
        parser.error(str(error))
    # Many small operations: one thread is faster than several, and does not collapse on a busy machine. NumPy's threads
    # are set as a process starts: this holds for those of the repetitions and of further bags.
    torch.set_num_threads(1)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with interruptible():
            return _done(options)
    except _ERRORS as error:
        print(f"diagnose: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("diagnose: interrupted; reports that are listed above are complete", file=sys.stderr)
        return INTERRUPTED_STATUS


def _done(options: argparse.Namespace) -> int:
    """Do what the options ask for; returns the exit status."""
    # Report a wrong robot before a long recording is read.
    load_robot(options.robot)
    if options.commission:
        return _commission(options)
    if len(options.bags) > 1:
        return _diagnose_many(options)
    if options.jobs > 1:
        with uninterrupted():
            prepare_processes()
    found = _with_bar(options.bags[0], options.out, options)
    print_finding(found)
    if options.export:
        _export(found, options)
    return _status(found)


def _export(found: BagDiagnosis, options: argparse.Namespace) -> None:
    """Write the effects for other tools, and say what these lack."""
    diagnosis = found.diagnosis
    # What is too doubtful for a robot file is so for a controller.
    effects = effects_for_file(diagnosis, local=options.local_effects) if found.robot_file else ()
    left = [effect.name for effect in diagnosis.effects if effect not in effects]
    if left:
        print(f"  not exported: {', '.join(left)}, since it is not written into a robot file either; see the report")
    if any(effect.name in diagnosis.partial for effect in effects):
        print(f"  exported as if it acted everywhere and always: {diagnosis.part}")
    for exported in export_effects(options.export, load_robot(options.robot), effects):
        for file in exported.files:
            print(f"  {exported.kind}: {file}")
        for text in exported.not_exported:
            print(f"  {exported.kind}: not exported: {text}")


def _status(found: BagDiagnosis) -> int:
    """Exit status of one diagnosis."""
    return NOT_IDENTIFIABLE_STATUS if found.diagnosis.verdict == Verdict.NOT_IDENTIFIABLE else 0


def print_finding(found: BagDiagnosis) -> None:
    """Print the result."""
    for complaint in found.complaints[:_MOST_COMPLAINTS]:
        print(f"diagnose: {found.bag}: {complaint}", file=sys.stderr)
    first, *rest = summary_lines(found.diagnosis, found.doubts)
    print(f"{found.bag}: {first}")
    if found.ground is not None:
        rest.append(f"  ground: {found.ground.description}")
    if found.robot_file:
        rest.append(f"  robot file: {found.robot_file}")
    print("\n".join([*rest, f"  report: {found.page}"]))


def _with_bar(bag: Path, out: Path, options: argparse.Namespace) -> BagDiagnosis:
    form = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}] {postfix}"
    with progress_bar(100, label=bag.name, bar_format=form, quiet=options.quiet, leave=False) as bar:

        def progress(share: float, step: str) -> None:
            bar.set_postfix_str(step, refresh=False)
            bar.update(100 * share - bar.n)

        return _run(bag, out, options, progress)


def _run(
    bag: Path,
    out: Path,
    options: argparse.Namespace,
    progress: Callable[[float, str], None] = lambda share, step: None,
) -> BagDiagnosis:
    return diagnose_bag(
        bag,
        options.robot,
        out,
        terrain=options.terrain,
        reading=read_options(options),
        # Bags have processes of their own.
        settings=DiagnosisSettings(
            max_effects=options.effects, processes=options.jobs if len(options.bags) == 1 else 1
        ),
        held_out=options.held_out,
        local_effects=options.local_effects,
        progress=progress,
    )


def _run_alone(bag: Path, out: Path, options: argparse.Namespace) -> BagDiagnosis | str:
    """Run in a worker process; an error is returned as its text."""
    torch.set_num_threads(1)
    try:
        return _run(bag, out, options).without_arrays()
    except _ERRORS as error:
        return str(error)


def report_folders(bags: Sequence[Path]) -> list[str]:
    """Names of the folders of reports, all different: those of the bags, numbered where several bags share one.

    >>> report_folders([Path("monday/short"), Path("tuesday/short.bag"), Path("00_short")])
    ['00_short_1', '01_short', '00_short']
    """
    names = [bag.resolve().name.removesuffix(".bag") for bag in bags]
    taken = {name for name in names if names.count(name) == 1}
    folders = []
    for number, name in enumerate(names):
        folder = name
        if name not in taken:
            numbered = f"{number:02d}_{name}"
            free = chain([numbered], (f"{numbered}_{again}" for again in count(1)))
            folder = next(text for text in free if text not in taken)
            taken.add(folder)
        folders.append(folder)
    return folders


def _diagnose_many(options: argparse.Namespace) -> int:
    """Diagnose bags in parallel, each into a folder of its own; a failure does not stop the others."""
    outs = [options.out / name for name in report_folders(options.bags)]
    failed = refused = 0
    context = multiprocessing.get_context("spawn")
    jobs = min(options.jobs, len(options.bags))
    with (
        ProcessPoolExecutor(jobs, mp_context=context) as pool,
        progress_bar(len(outs), label="diagnose", unit="bag", quiet=options.quiet, leave=False) as bar,
    ):
        with uninterrupted():
            # The first tasks start the processes.
            tasks = zip(options.bags, outs, strict=True)
            running = {pool.submit(_run_alone, bag, out, options): bag for bag, out in tasks}
        for done in as_completed(running):
            try:
                found = done.result()
            except BrokenExecutor:
                found = "its process was ended, perhaps for want of memory: use fewer --jobs"
            bar.clear()
            if isinstance(found, str):
                failed += 1
                print(f"diagnose: {running[done]}: {found}", file=sys.stderr)
            else:
                refused += _status(found) != 0
                print_finding(found)
            bar.update()
    if failed:
        print(f"diagnose: {failed} of {len(outs)} bags failed", file=sys.stderr)
    if refused:
        print(f"diagnose: {refused} of {len(outs)} recordings cannot be diagnosed", file=sys.stderr)
    return 1 if failed else NOT_IDENTIFIABLE_STATUS if refused else 0


def _commission(options: argparse.Namespace) -> int:
    robot = load_robot(options.robot)
    usable_folder(options.out)
    recordings = []
    for bag in options.bags:
        evidence, recording, ground = read_with_ground(bag, robot, options.terrain, read_options(options))
        recordings.append(evidence)
        wrong, remarks = contradictions(evidence.smoothed.motion, evidence.wheels, evidence.commands, robot)
        for text in (*recording.warnings[:_MOST_COMPLAINTS], *wrong):
            print(f"diagnose: {bag}: {text}", file=sys.stderr)
        print(f"{bag}: ground: {ground.description}")
        if ground.unknown:
            print(f"diagnose: {bag}: {ground.complaint}", file=sys.stderr)
        for remark in (*remarks, *comparable_windows(evidence, robot, DiagnosisSettings()).remarks):
            print(f"{bag}: {remark}")
    settings = DiagnosisSettings()
    effects, nominal = commission(recordings, robot, samples=settings.samples)
    kept = nominal.entry(settings.samples)
    entries = [effect_entry(effect) for effect in effects]
    out = write_robot(
        options.robot, options.out / f"{robot.name}.yaml", entries, options.bags, fingerprint(options.bags), kept
    )
    for effect in effects:
        for key, parameter in effect.parameters.items():
            unit = "" if parameter.unit == "-" else f" {parameter.unit}"
            print(f"{effect.name}: {key} {parameter.value:.3g}{unit}")
    for text in kept_effects(recordings, robot, effects):
        print(text)
    print(nominal.summary(settings.horizon))
    print(f"robot file: {out}")
    for bag, evidence in zip(options.bags, recordings, strict=True):
        large = residual_complaint(nominal.residual, evidence.smoothed, evidence.commands)
        if large:
            print(f"diagnose: {bag}: {large}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
