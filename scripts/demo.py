"""Demo: plays the bundled bag to a predictor node, records its messages, and draws one of its predictions.

Writes into --out: prediction.png (a prediction of the node), outputs/ (its messages as a bag), evaluation/ (a report).
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from monoforce_ros.bags import BagReader, Recording
from monoforce_ros.core import share_directory
from monoforce_ros.evaluation import figures
from monoforce_ros.evaluation.cli import main as evaluate
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.messages import stamp_of
from monoforce_ros.perception import SOURCES, choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import load_robot

OUTPUTS = ("height_map", "terrain", "path", "contact_forces")
EXECUTABLES = share_directory().parent.parent / "lib" / "monoforce_ros"


def say(text: str) -> None:
    print(f"[demo] {text}", flush=True)


def start(name: str, *arguments: str, log: Path | None) -> subprocess.Popen:
    """Start an installed executable, as ``ros2 run monoforce_ros NAME`` does."""
    output = log.open("w") if log else None
    return subprocess.Popen([str(EXECUTABLES / name), *arguments], stdout=output, stderr=output)


def wait_for(log: Path, text: str, process: subprocess.Popen, seconds: float) -> None:
    """Wait until the log of a process contains a text."""
    deadline = time.monotonic() + seconds
    while text not in log.read_text():
        if process.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"[demo] {log.stem} did not become ready:\n{log.read_text()}")
        time.sleep(0.1)


def stop(process: subprocess.Popen) -> int:
    """Interrupt a process (SIGINT) and return its exit status."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def play(bag: Path, out: Path, robot: str, terrain: str) -> None:
    """Run the player and the predictor, and record the predictor's messages."""
    logs = {name: out / f"{name}.log" for name in ("predictor", "bag_recorder")}
    topics = [*(f"/predicted/{name}" for name in OUTPUTS), "/diagnostics"]
    say(f"starting the predictor (terrain source: {terrain}) and a recorder")
    parameters = ["-p", f"robot:={robot}", "-p", f"terrain_source:={terrain}"]
    predictor = start("predictor", "--ros-args", *parameters, log=logs["predictor"])
    recorder = start("bag_recorder", str(out / "outputs"), "--overwrite", "--topics", *topics, log=logs["bag_recorder"])
    try:
        wait_for(logs["predictor"], "predicting", predictor, 90)
        wait_for(logs["bag_recorder"], "/predicted/contact_forces", recorder, 30)
        say(f"playing {bag.name}")
        if start("bag_player", str(bag), log=None).wait() != 0:
            raise SystemExit("[demo] the bag player failed")
        time.sleep(1.5)
    finally:
        statuses = [stop(process) for process in (predictor, recorder)]
    if any(statuses):
        raise SystemExit(f"[demo] predictor and recorder exited with {statuses}; see {logs['predictor']}")


def published(out: Path) -> dict[int, dict[str, object]]:
    """Complete predictions among the recorded messages, by stamp."""
    by_stamp: dict[int, dict[str, object]] = {}
    with BagReader(out / "outputs") as bag:
        for message in bag.messages([f"/predicted/{name}" for name in OUTPUTS]):
            decoded = message.decode()
            first = decoded.markers[0] if hasattr(decoded, "markers") else decoded
            by_stamp.setdefault(stamp_of(first), {})[message.topic.rsplit("/", 1)[-1]] = decoded
    return {stamp: found for stamp, found in sorted(by_stamp.items()) if len(found) == len(OUTPUTS)}


def terrain_status(out: Path, stamp: int) -> str:
    """What the predictor said of its terrain when it published the prediction of a stamp, or nothing."""
    said = ""
    with BagReader(out / "outputs") as bag:
        for message in bag.messages(["/diagnostics", "/predicted/path"]):
            decoded = message.decode()
            if message.topic == "/predicted/path":
                if stamp_of(decoded) >= stamp and said:
                    break
                continue
            said = next((status.message for status in decoded.status if status.name.endswith("terrain")), said)
    return said


def draw(bag: Path, out: Path, robot_name: str, moment: float) -> int:
    """Draw the published prediction nearest to ``moment`` [s] of the bag; returns the number of predictions."""
    robot = load_robot(robot_name)
    recording = Recording.open(bag)
    predictions = published(out)
    if not predictions:
        raise SystemExit(f"[demo] the predictor published no predictions; see {out / 'predictor.log'}")
    begin = int(recording.motion.stamps[0])
    stamp = min(predictions, key=lambda s: abs((s - begin) * 1e-9 - moment))
    found = predictions[stamp]
    later = recording.motion.stamps - stamp
    view = PredictionView.of_messages(
        found["terrain"], found["path"], found["contact_forces"], recording.motion.at(stamp)
    )
    # The node holds the current command; a prediction under the recorded commands shows the error of the physics.
    predictor = Predictor(robot, choose_terrain_source("flat", robot))
    twists = recording.commands.sample(predictor.command_stamps(stamp))
    rolled = predictor.roll_out(view.terrain, [view.motion], twists[None], with_forces=False)
    figure = figures.prediction_figure(
        view,
        robot,
        under_recorded_commands=rolled.position[0].double().numpy(),
        picture=figures.CameraPicture.nearest(recording, robot, stamp),
        measured=recording.motion.positions[(later >= 0) & (later <= 5e9)],
        title=f"terrain: {status}" if (status := terrain_status(out, stamp)) else "",
    )
    (out / "prediction.png").write_bytes(figure_png(figure))
    gaps = np.diff([s * 1e-9 for s in predictions])
    say(f"{len(predictions)} predictions were published, one every {np.median(gaps):.2f} s of the bag")
    return len(predictions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="output folder (%(default)s)")
    parser.add_argument("--bag", type=Path, default=share_directory() / "bags" / "demo", help="bag to play (demo bag)")
    parser.add_argument("--robot", default="husky", help="robot name or file (%(default)s)")
    parser.add_argument(
        "--terrain",
        choices=SOURCES,
        default="camera",
        help="terrain source (%(default)s)",
    )
    parser.add_argument(
        "--moment", type=float, default=3.3, help="time in the bag of the drawn prediction [s] (%(default)s)"
    )
    options = parser.parse_args()
    began = time.monotonic()
    # A separate domain isolates the demo from robots and other runs on the network.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100))
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    play(options.bag, options.out, options.robot, options.terrain)
    draw(options.bag, options.out, options.robot, options.moment)
    say("comparing predictions along the bag with the measured motion")
    arguments = [str(options.bag), "--robot", options.robot, "--terrain", options.terrain]
    status = evaluate([*arguments, "--out", str(options.out / "evaluation")])
    if status:
        sys.exit(status)
    say(f"done after {time.monotonic() - began:.0f} s; open:")
    print(f"  {options.out / 'prediction.png'}\n  {options.out / 'evaluation' / 'report.html'}")


if __name__ == "__main__":
    main()
