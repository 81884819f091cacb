"""``evaluate``: predictions along a bag against the measured motion."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.bags import BagError, Recording
from monoforce_ros.core import share_directory
from monoforce_ros.effects import EffectError
from monoforce_ros.encoder import CheckpointError
from monoforce_ros.evaluation import figures
from monoforce_ros.evaluation.check import check_bag, check_text
from monoforce_ros.evaluation.recording_evaluation import (
    CONSTANT_VELOCITY,
    PHYSICS,
    EvaluationError,
    evaluate_recording,
    predict_at,
)
from monoforce_ros.evaluation.report import terminal_table, write_reports
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.messages import MessageError
from monoforce_ros.perception import SOURCES, choose_terrain_source
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.prediction import Predictor
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import RobotFileError, RobotModel, load_robot, shipped_robots
from monoforce_ros.terrain import TerrainDefaults


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate",
        description="Predict along a recorded drive and compare with the motion that was measured. Writes report.html, "
        "report.json and pictures.",
    )
    parser.add_argument("bag", nargs="?", help="rosbag2 folder or ROS 1 .bag file (default: the demo bag)")
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument("--out", default="evaluation", help="folder for the report (default: evaluation)")
    parser.add_argument("--terrain", choices=SOURCES, default="lidar", help="terrain source (default: lidar)")
    parser.add_argument(
        "--checkpoint", default="", help="terrain encoder weights, for --terrain camera (default: the shipped ones)"
    )
    parser.add_argument(
        "--memory",
        type=float,
        default=0.0,
        metavar="S",
        help="for so long what cameras saw is remembered (default: not at all, as in the node)",
    )
    parser.add_argument("--images", nargs="+", default=None, metavar="TOPIC", help="image topics (default: all)")
    parser.add_argument("--odometry", default=None, metavar="TOPIC", help="odometry topic (default: found by type)")
    parser.add_argument("--commands", default=None, metavar="TOPIC", help="command topic (default: found by type)")
    parser.add_argument("--cloud", default=None, metavar="TOPIC", help="point cloud topic (default: found by type)")
    parser.add_argument("--horizons", nargs="+", type=float, default=[1.0, 2.0, 5.0], metavar="S", help="seconds")
    parser.add_argument("--stride", type=float, default=0.4, help="least seconds between windows (default 0.4)")
    parser.add_argument(
        "--friction", type=float, default=TerrainDefaults.friction, help="ground friction (default 0.8)"
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="only say what the bag holds, what is missing, its rates, gaps, clocks and frames; status 1 if unusable",
    )
    parser.add_argument(
        "--tables",
        action="store_true",
        help="compare terrain sources over many drives instead; see `evaluate --tables --help`",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the evaluation; see ``--help``. Returns 0, or 1 with one line that says what is wrong."""
    given = sys.argv[1:] if arguments is None else arguments
    if "--tables" in given:
        from monoforce_ros.evaluation.tables_cli import main as compare

        return compare(given)
    parser = _parser()
    options = parser.parse_args(given)
    if any(not 0.1 <= h <= 30 for h in options.horizons):
        parser.error(f"--horizons: got {options.horizons}, expected 0.1 to 30 s")
    if not 0 <= options.friction <= 3:
        parser.error(f"--friction: got {options.friction}, expected 0 to 3")
    if not 0 <= options.memory <= 600:
        parser.error(f"--memory: got {options.memory}, expected 0 to 600 s")
    try:
        if options.check:
            check = check_bag(options.bag or share_directory() / "bags" / "demo", load_robot(options.robot))
            print(check_text(check))
            return int(not check.usable)
        run(options)
    except (BagError, CheckpointError, EffectError, EvaluationError, MessageError, RobotFileError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def run(options: argparse.Namespace) -> None:
    """Evaluate and write the reports."""
    began = time.monotonic()
    # Many small operations: one thread is faster than several, and does not collapse on a busy machine.
    torch.set_num_threads(1)
    bag = options.bag or share_directory() / "bags" / "demo"
    robot = load_robot(options.robot)
    recording = Recording.open(bag, odometry=options.odometry, commands=options.commands, cloud=options.cloud)
    material = TerrainDefaults(friction=options.friction)
    source = choose_terrain_source(
        options.terrain, robot, material=material, checkpoint=options.checkpoint, memory=options.memory
    )
    predictor = Predictor(robot, source, horizon=max(options.horizons), options=PhysicsOptions())
    topics = tuple(options.images or recording.images) if "camera" in source.sensors else ()
    evaluation = evaluate_recording(
        recording,
        predictor,
        image_topics=topics,
        horizons=sorted(options.horizons),
        stride=options.stride,
        progress=not options.quiet,
    )
    folder = Path(options.out)
    pictures = [
        (
            "Error against the horizon",
            "Line: median over the windows. Band: the middle half of them.",
            figure_png(figures.error_figure(evaluation)),
        ),
        (
            "The drive from above",
            "Black: what was measured. Each dot starts a prediction of "
            f"{max(options.horizons):g} s ({PHYSICS}: solid, {CONSTANT_VELOCITY}: dotted).",
            figure_png(figures.drive_figure(evaluation, recording.motion.positions)),
        ),
    ]
    folder.mkdir(parents=True, exist_ok=True)
    for name, number in _moments(evaluation):
        stamp = int(evaluation.stamps[number])
        prediction = predict_at(recording, predictor, stamp, topics)
        later = recording.motion.stamps - stamp
        ahead = (later >= 0) & (later <= max(options.horizons) * 1e9)
        figure = figures.prediction_figure(
            PredictionView.of_prediction(prediction, robot),
            robot,
            picture=camera_picture(recording, robot, stamp),
            measured=recording.motion.positions[ahead],
            title=f"{(stamp - recording.motion.stamps[0]) * 1e-9:.1f} s into the drive, terrain from {options.terrain}",
        )
        png = figure_png(figure)
        (folder / f"prediction_{name}.png").write_bytes(png)
        pictures.append(
            (f"The {name} prediction", "Predicted path in orange, measured path dashed, forces in red.", png)
        )
    settings = {
        "bag": str(bag),
        "robot": robot.name,
        "terrain": options.terrain,
        "checkpoint": options.checkpoint or "–",
        "topics": ", ".join(f"{role} {topic}" for role, topic in recording.topics.items()),
        "friction": options.friction,
        "stride [s]": options.stride,
        "physics": str(predictor.options),
        "duration [s]": round(time.monotonic() - began, 1),
    }
    report_json, report_html = write_reports(folder, evaluation, settings, pictures)
    print(terminal_table(evaluation))
    print(f"report: {report_html}\ndata:   {report_json}\npictures: {folder}/prediction_*.png")


def _moments(evaluation) -> list[tuple[str, int]]:
    """A typical window and the worst one, by the position error at the longest horizon that any window reaches."""
    errors, _ = evaluation.errors(PHYSICS)
    usable = np.logical_and.accumulate(evaluation.inside, axis=1) & np.isfinite(errors)
    reached = np.flatnonzero(usable.any(axis=0))
    if not len(reached):
        return [("first", 0)]
    final = np.where(usable[:, reached[-1]], errors[:, reached[-1]], np.nan)
    order = np.argsort(final)[: int(np.isfinite(final).sum())]
    return [("typical", int(order[len(order) // 2])), ("worst", int(order[-1]))]


def camera_picture(recording: Recording, robot: RobotModel, stamp: int) -> figures.CameraPicture | None:
    """The image of a forward-looking camera near a stamp, if the bag has one with its calibration and pose."""
    best = None
    for topic, camera in recording.cameras.items():
        frame = min(recording.images[topic], key=lambda entry: abs(entry.stamp - stamp), default=None)
        if frame is None or abs(frame.stamp - stamp) > 200_000_000:
            continue
        try:
            pose = recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors)
        except BagError:
            continue
        if best is None or pose[0, 2] > best[0]:
            best = pose[0, 2], frame, camera, pose
    if best is None or best[0] < 0.5:
        return None
    _, frame, camera, pose = best
    return figures.CameraPicture(recording.image(frame), camera, pose)


if __name__ == "__main__":
    sys.exit(main())
