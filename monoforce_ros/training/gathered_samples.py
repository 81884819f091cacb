"""Gathered samples: those of many bags or worlds, made in parallel and read from their files."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from monoforce_ros.bags import BagError, read_options
from monoforce_ros.encoder import EncoderConfig
from monoforce_ros.reporting import progress
from monoforce_ros.robots import RobotModel
from monoforce_ros.training.batches import use_one_thread
from monoforce_ros.training.recording_samples import RecordingSamples, SamplesError, read_samples
from monoforce_ros.training.sample_extraction import SampleSettings, extract_samples
from monoforce_ros.training.world_samples import PLACES, world_file, world_samples, world_settings

_Made = tuple[Path | None, str]
"""A file of samples, or the reason why there is none."""


def recorded_worlds(
    seeds: Sequence[int], config: EncoderConfig, options: argparse.Namespace, places: int = PLACES
) -> list[RecordingSamples]:
    """Samples of randomised worlds; those in which the robot cannot stand are left out."""
    folder = _folder(options)
    tasks = [(seed, config, folder, places, world_settings(seed, options.world_styles)) for seed in seeds]
    missing = sum(
        not world_file(seed, config, folder, places=places, settings=settings).is_file() for seed, *_, settings in tasks
    )
    left_out = ["left out" for _ in tasks]
    return _gathered(
        _draw_world, tasks, left_out, options, count=missing, label="worlds", unit="world", quiet=options.quiet
    )


def recorded_bags(
    bags: Sequence[Path], robot: RobotModel, config: EncoderConfig, options: argparse.Namespace, title: str
) -> list[RecordingSamples]:
    """Samples of each usable bag; with a progress bar if there is a title.

    Raises:
        SamplesError: no bag gives samples. A single unusable one must not end a long training.
    """
    settings = SampleSettings(period=options.period, iterations=options.fit_iterations, reading=read_options(options))
    tasks = [(bag, robot, config, _folder(options), settings, tuple(options.images)) for bag in bags]
    skipped = [f"train: {bag} skipped" for bag in bags]
    found = _gathered(
        _extract, tasks, skipped, options, count=len(bags), label=title, unit="bag", quiet=options.quiet or not title
    )
    if bags and not found:
        raise SamplesError(f"none of {len(bags)} bags gives samples")
    return found


def _gathered(
    make: Callable[[tuple], _Made], tasks: Sequence[tuple], left_out: Sequence[str], options: argparse.Namespace, *,
    count: int, label: str, unit: str, quiet: bool,
) -> list[RecordingSamples]:  # fmt: skip
    """What tasks make, of which ``count`` take long; those that make nothing are named by ``left_out`` on stderr."""
    bar = progress(tasks, label=label, unit=unit, quiet=quiet or not tasks)
    found = []
    with _processes(min(options.jobs, count)) as pool:
        # A single one is made here: starting another process takes longer.
        made = pool.map(make, tasks) if count > 1 and options.jobs > 1 else map(make, tasks)
        for name, _, (file, reason) in zip(left_out, bar, made, strict=False):
            if file is not None:
                found.append(read_samples(file))
            else:
                print(f"{name}: {reason}", file=sys.stderr)
    return found


def _folder(options: argparse.Namespace) -> Path:
    return options.samples or options.out / "samples"


def _processes(count: int) -> ProcessPoolExecutor:
    """Processes of one thread each, at least one; they start with their first task."""
    return ProcessPoolExecutor(
        max(1, count), mp_context=multiprocessing.get_context("spawn"), initializer=use_one_thread
    )


def _draw_world(task: tuple) -> _Made:
    seed, config, folder, places, settings = task
    try:
        return world_samples(seed, config, folder, places=places, settings=settings), ""
    except SamplesError as error:
        return None, str(error)


def _extract(task: tuple) -> _Made:
    bag, robot, config, folder, settings, topics = task
    try:
        return extract_samples(bag, robot, config, folder, settings=settings, image_topics=topics), ""
    except (SamplesError, BagError, ValueError) as error:
        return None, str(error)
