"""``evaluate --tables``: compare terrain sources over recordings on rigid ground and in tall grass."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import torch

from monoforce_ros.bags import BagError
from monoforce_ros.core import OptionParser, write_text
from monoforce_ros.encoder import CheckpointError
from monoforce_ros.evaluation.recording_evaluation import EvaluationError
from monoforce_ros.evaluation.tables import CONSTANT, FLAT, LIDAR, SequenceErrors, System, evaluate_sequence
from monoforce_ros.evaluation.tables_report import compare, html_page, markdown
from monoforce_ros.reporting import progress_bar, write_between
from monoforce_ros.robots import RobotFileError, load_robot, shipped_robots

LEARNED = {
    "lidar_network": ("network on a lidar sweep [22]", "point cloud"),
    "lss": ("images → H_g, LSS [9]", "images"),
    "monoforce": ("images → H_t, MonoForce", "images"),
    "no_geometric": ("MonoForce without geometric loss", "images"),
}
"""Title and input of each system with a checkpoint, by its option."""


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = OptionParser(
        prog="evaluate --tables",
        description="Compare terrain sources over whole recordings: lidar interpolation, level ground, constant "
        "velocity, and trained encoders. Writes tables.json, tables.html and tables.md.",
    )
    parser.add_argument("--tables", action="store_true", required=True, help=argparse.SUPPRESS)
    parser.add_argument("--rigid", nargs="+", type=Path, default=[], metavar="BAG", help="recordings on rigid ground, "
                        "or folders of them")  # fmt: skip
    parser.add_argument("--grass", nargs="+", type=Path, default=[], metavar="BAG", help="recordings in tall grass, "
                        "or folders of them")  # fmt: skip
    for key, (title, _) in LEARNED.items():
        parser.add_argument(
            f"--{key.replace('_', '-')}", type=Path, metavar="FILE.safetensors", help=f"checkpoint: {title}"
        )
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())} (husky)")
    parser.add_argument("--out", type=Path, default=Path("tables"), help="output folder (%(default)s)")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also write the tables into this document, between "
                        "the comments `<!-- tables -->` and `<!-- end of tables -->`")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="recordings in parallel (%(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not options.rigid and not options.grass:
        parser.error("--rigid or --grass: expected at least one recording")
    try:
        load_robot(options.robot)
        systems = _systems(options)
        grounds = {name: _bags(getattr(options, name)) for name in ("rigid", "grass") if getattr(options, name)}
        rows = _evaluate(grounds, systems, options)
    except (BagError, CheckpointError, EvaluationError, RobotFileError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    comparisons = {ground: compare(listed, systems) for ground, listed in rows.items()}
    content = {ground: found.as_json() for ground, found in comparisons.items()}
    text = markdown(comparisons, systems)
    names = {ground: [bag.name for bag in bags] for ground, bags in grounds.items()}
    write_text(options.out / "tables.json", json.dumps(content, indent=1, ensure_ascii=False))
    write_text(options.out / "tables.md", text)
    write_text(options.out / "tables.html", html_page(comparisons, systems, names))
    if options.docs is not None:
        write_between(options.docs, "tables", text)
    print(text)
    print(f"\n{options.out / 'tables.html'}")
    return 0


def _systems(options: argparse.Namespace) -> list[System]:
    systems = [LIDAR]
    for key, (title, sensors) in LEARNED.items():
        checkpoint = getattr(options, key)
        if checkpoint is not None:
            systems.append(System(key, title, sensors, checkpoint))
        if key == "monoforce" and checkpoint is not None:
            systems.append(
                System(
                    "monoforce_lidar",
                    "lidar lowered by images → H_d",
                    "images, point cloud",
                    checkpoint,
                    with_lidar=True,
                )
            )
    return [*systems, FLAT, CONSTANT]


def _bags(paths: Sequence[Path]) -> list[Path]:
    """The given bags, and those in the given folders."""
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise BagError(f"{path} does not exist")
        inner = sorted(p for p in path.iterdir() if (p / "metadata.yaml").exists()) if path.is_dir() else []
        found += [path] if (path / "metadata.yaml").exists() or not inner else inner
    return found


def _evaluate(
    grounds: Mapping[str, Sequence[Path]], systems: Sequence[System], options: argparse.Namespace
) -> dict[str, list[dict[str, SequenceErrors]]]:
    """Errors of each system on each recording, by kind of ground and sorted by name."""
    rows: dict[str, list[dict[str, SequenceErrors]]] = {ground: [] for ground in grounds}
    tasks = [(ground, bag) for ground, bags in grounds.items() for bag in bags]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max(1, options.jobs), mp_context=context) as pool:
        running = {pool.submit(_evaluate_one, bag, options.robot, systems): ground for ground, bag in tasks}
        with progress_bar(len(tasks), unit="recording", quiet=options.quiet) as bar:
            for done in as_completed(running):
                rows[running[done]].append(done.result())
                bar.update()
    for listed in rows.values():
        listed.sort(key=lambda row: next(iter(row.values())).sequence)
    return rows


def _evaluate_one(bag: Path, robot: str, systems: Sequence[System]) -> dict[str, SequenceErrors]:
    torch.set_num_threads(1)
    return evaluate_sequence(bag, load_robot(robot), systems)
