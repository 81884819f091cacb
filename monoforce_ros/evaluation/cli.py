"""``evaluate``: compare predictions along a bag with the measured motion."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import override

import numpy as np
import torch

from monoforce_ros.bags import BagError, Recording, add_read_options, chosen_cameras, read_options, smooth
from monoforce_ros.core import OptionParser, share_directory
from monoforce_ros.discrepancy import motion_faults
from monoforce_ros.effects import EffectError
from monoforce_ros.encoder import CheckpointError
from monoforce_ros.evaluation import figures
from monoforce_ros.evaluation.check import check_bag, check_text
from monoforce_ros.evaluation.recording_evaluation import (
    CONSTANT_VELOCITY,
    PHYSICS,
    EvaluationError,
    RecordingEvaluation,
    evaluate_recording,
    predict_at,
)
from monoforce_ros.evaluation.report import Picture, terminal_table, write_reports
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.messages import MessageError
from monoforce_ros.perception import (
    CAMERA_SOURCES,
    LIDAR_RETENTION_TIME,
    SOURCES,
    TrustedTerrain,
    choose_terrain_source,
)
from monoforce_ros.physics import SOILS, PhysicsOptions, SoilError, read_soil
from monoforce_ros.prediction import Predictor
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, shipped_robots
from monoforce_ros.terrain import TerrainDefaults


class _FormerOption(argparse.Action):
    """An option under its former name: works, and prints a warning with the new one."""

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[object] | None,
        option_string: str | None = None,
    ) -> None:
        new = f"--{self.dest.replace('_', '-')}"
        print(f"warning: {option_string} is deprecated and will be removed; use {new}", file=sys.stderr)
        setattr(namespace, self.dest, values)


_OF_CAMERAS = ("retention_time", "images", "motion_stereo")


def _parser() -> OptionParser:
    parser = OptionParser(
        prog="evaluate",
        description="Predict along a recording and compare with the measured motion. Writes report.html, report.json "
        "and figures.",
    )
    parser.add_argument("bag", nargs="?", help="rosbag2 folder or ROS 1 .bag file (default: the demo bag)")
    parser.add_argument(
        "--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())} (default: husky)"
    )
    parser.add_argument("--out", default="evaluation", help="output folder (default: evaluation)")
    parser.add_argument("--terrain", choices=SOURCES, default="lidar", help="terrain source (default: lidar)")
    parser.add_argument(
        "--checkpoint",
        default="",
        help="terrain encoder weights (default: the shipped ones)",
    )
    parser.add_argument(
        "--retention-time",
        type=float,
        default=0.0,
        metavar="S",
        help="how long terrain seen by cameras is kept after it leaves the images (default: 0, as in the node)",
    )
    parser.add_argument("--memory", type=float, dest="retention_time", action=_FormerOption, help=argparse.SUPPRESS)
    parser.add_argument("--images", nargs="+", default=None, metavar="TOPIC", help="image topics (default: all)")
    parser.add_argument(
        "--motion-stereo",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="add what images of the moving camera show to stand on the ground (default: yes, as in the node)",
    )
    add_read_options(parser)
    parser.add_argument("--horizons", nargs="+", type=float, default=[1.0, 2.0, 5.0], metavar="S",
                        help="times at which errors are reported [s] (default: 1 2 5)")  # fmt: skip
    parser.add_argument(
        "--stride", type=float, default=0.4, help="smallest time between predictions [s] (default: 0.4)"
    )
    parser.add_argument(
        "--friction",
        type=float,
        default=TerrainDefaults.friction,
        help="friction coefficient of the ground (default: 0.8)",
    )
    parser.add_argument(
        "--soil",
        default="",
        metavar="NAME|FILE",
        help=f"soft soil: one of {', '.join(SOILS)}, or a soil file (docs/physics.md); default: firm ground",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="only report the bag's contents, missing data, rates, gaps, clocks and frames; exit status 1 if unusable",
    )
    parser.add_argument(
        "--tables",
        action="store_true",
        help="compare terrain sources over many recordings instead; see `evaluate --tables --help`",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the evaluation; see ``--help``. Returns 0, or 1 after an error message of one line."""
    words = sys.argv[1:] if arguments is None else arguments
    if "--tables" in words:
        from monoforce_ros.evaluation.tables_cli import main as compare

        return compare(words)
    parser = _parser()
    options = parser.parse_args(words)
    if any(not 0.1 <= h <= 30 for h in options.horizons):
        parser.error(f"--horizons: got {options.horizons}, expected 0.1 to 30 s")
    if not 0 <= options.friction <= 3:
        parser.error(f"--friction: got {options.friction}, expected 0 to 3")
    if not 0 <= options.retention_time <= 600:
        parser.error(f"--retention-time: got {options.retention_time}, expected 0 to 600 s")
    if options.check:
        unused = ("terrain", "checkpoint", *_OF_CAMERAS, "friction", "soil", "horizons", "stride")
        parser.refuse_without_effect(options, unused, "with --check")
    elif options.terrain not in CAMERA_SOURCES:
        sources = " or ".join(CAMERA_SOURCES)
        parser.refuse_without_effect(options, _OF_CAMERAS, f"with --terrain {options.terrain}: it needs {sources}")
        if options.terrain != "lidar":
            parser.refuse_without_effect(options, ("checkpoint",), f"with --terrain {options.terrain}: no encoder")
    try:
        if options.check:
            bag = options.bag or share_directory() / "bags" / "demo"
            check = check_bag(bag, load_robot(options.robot), read_options(options))
            print(check_text(check))
            return int(not check.usable)
        run(options)
    except (
        BagError,
        CheckpointError,
        EffectError,
        EvaluationError,
        MessageError,
        RobotFileError,
        SoilError,
        OSError,
    ) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def run(options: argparse.Namespace) -> None:
    """Evaluate and write the reports."""
    began = time.monotonic()
    # Operations are many and small: one thread is faster than several, above all on a busy machine.
    torch.set_num_threads(1)
    bag = options.bag or share_directory() / "bags" / "demo"
    reading = read_options(options)
    robot = load_robot(options.robot)
    recording = reading.open(bag, robot)
    robot = reading.robot_in_bag(robot)
    for text in motion_faults(smooth(recording.motion), recording.commands, recording.wheels, recording.efforts):
        print(f"warning: {text}", file=sys.stderr)
    material = TerrainDefaults(friction=options.friction)
    source = choose_terrain_source(
        options.terrain,
        robot,
        material=material,
        checkpoint=options.checkpoint,
        retention_time=options.retention_time,
        lidar_retention_time=LIDAR_RETENTION_TIME,
        motion_stereo=options.motion_stereo,
        fallback=True,
        warn=lambda message: print(f"warning: {message}", file=sys.stderr),
    )
    predictor = Predictor(
        robot, source, horizon=max(options.horizons), options=PhysicsOptions(soil=read_soil(options.soil))
    )
    topics, left_out = (
        _camera_topics(recording, robot, options.images or ()) if "camera" in source.sensors else ((), [])
    )
    evaluation = evaluate_recording(
        recording,
        predictor,
        image_topics=topics,
        horizons=sorted(options.horizons),
        stride=options.stride,
        quiet=options.quiet,
    )
    evaluation = replace(evaluation, remarks=(*left_out, *evaluation.remarks))
    if not any(position.windows for position, _ in evaluation.summary(PHYSICS).values()):
        raise EvaluationError(
            f"{bag}: after the start of every window the odometry jumps or pauses, or leaves the map, so that nothing "
            f"can be compared; see `evaluate --check {bag}`"
        )
    folder = Path(options.out)
    pictures = [
        Picture(
            "Error over the horizon",
            "Line: median over the windows. Band: interquartile range.",
            figure_png(figures.error_figure(evaluation)),
        ),
        Picture(
            "Top view of the recording",
            "Black: measured path. A prediction of "
            f"{max(options.horizons):g} s starts at each dot ({PHYSICS}: solid, {CONSTANT_VELOCITY}: dotted).",
            figure_png(figures.recording_figure(evaluation, recording.motion.positions)),
        ),
    ]
    if isinstance(source, TrustedTerrain):
        # The examples show the encoder's own terrain; they are not in the order of time that trust needs.
        predictor.source = source.source
    folder.mkdir(parents=True, exist_ok=True)
    for name, number in _example_windows(evaluation):
        stamp = int(evaluation.stamps[number])
        prediction = predict_at(recording, predictor, stamp, topics)
        later = recording.motion.stamps - stamp
        ahead = (later >= 0) & (later <= max(options.horizons) * 1e9)
        figure = figures.prediction_figure(
            PredictionView.of_prediction(prediction, robot),
            robot,
            picture=figures.CameraPicture.nearest(recording, robot, stamp),
            measured=recording.motion.positions[ahead],
            title=f"{(stamp - recording.motion.stamps[0]) * 1e-9:.1f} s into the recording, terrain: {options.terrain}",
        )
        png = figure_png(figure)
        (folder / f"prediction_{name}.png").write_bytes(png)
        pictures.append(
            Picture(
                f"{name.capitalize()} prediction",
                "Orange: predicted path. Dashed: measured path. Red: contact forces.",
                png,
            )
        )
    settings = {
        "bag": str(bag),
        "robot": robot.name,
        "terrain": options.terrain,
        "checkpoint": options.checkpoint or "–",
        "topics": ", ".join(f"{role} {topic}" for role, topic in recording.topics.items()),
        "odometry": f"{recording.motion.frame_id} → {recording.odometry_child_frame}, "
        f"evaluated at {recording.motion.child_frame_id}",
        "friction": options.friction,
        "soil": options.soil or "firm ground",
        "stride [s]": options.stride,
        "physics": str(predictor.options),
        "duration [s]": round(time.monotonic() - began, 1),
    }
    report_json, report_html = write_reports(folder, evaluation, settings, pictures)
    print(terminal_table(evaluation))
    print(f"report: {report_html}\ndata:   {report_json}\nfigures: {folder}/prediction_*.png")


def _camera_topics(recording: Recording, robot: RobotModel, named: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Image topics of the cameras that can be used, of those named or all, and remarks on the others."""
    unknown = [topic for topic in named if topic not in recording.images]
    if unknown:
        raise EvaluationError(f"{recording.path}: no images on {unknown}; there are {sorted(recording.images)}")
    choice = chosen_cameras(recording, robot, named)
    for remark in choice.remarks:
        print(f"warning: {remark}", file=sys.stderr)
    if recording.images and not choice.topics:
        raise EvaluationError(f"{recording.path}: no camera can be used: {'; '.join(choice.remarks)}")
    return choice.topics, choice.remarks


def _example_windows(evaluation: RecordingEvaluation) -> list[tuple[str, int]]:
    """The median and the worst window, by position error at the longest time that any window reaches on the map."""
    errors, _ = evaluation.errors(PHYSICS)
    usable = np.logical_and.accumulate(evaluation.inside, axis=1) & np.isfinite(errors)
    reached = np.flatnonzero(usable.any(axis=0))
    if not len(reached):
        return [("first", 0)]
    final = np.where(usable[:, reached[-1]], errors[:, reached[-1]], np.nan)
    order = np.argsort(final)[: int(np.isfinite(final).sum())]
    return [("typical", int(order[len(order) // 2])), ("worst", int(order[-1]))]


if __name__ == "__main__":
    sys.exit(main())
