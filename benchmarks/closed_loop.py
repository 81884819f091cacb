"""Simulator, predictor and path_selector drive to a goal around a wall and through tall grass, seed after seed.

    scripts/run.sh python benchmarks/closed_loop.py [--count 10] [--source NAME ...] [--json FILE] [--docs FILE]
                                                    [--png FILE]

Three processes that talk through ROS in real time. A drive succeeds if the robot stands within half a metre of the goal
in the time given and has not run into the wall. `lidar` takes grass for what it looks like, `camera` runs the terrain
encoder, `lidar_camera` lowers what the lidar measures by what the encoder says.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from ros_peer import Peer

from monoforce_ros.core import write_text
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import CourseSettings
from monoforce_ros.synthetic.course import WALL_THICKNESS

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {"ROS_DOMAIN_ID": "88", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
TOLERANCE = 0.5
BEHIND = 2.0
"""Of the goal behind the grass [m]."""
_TOUCHED = 0.03
"""A robot nearer to the wall than this has touched it, as far as its odometry can tell [m]."""


def started(name: str, folder: Path, *arguments: str) -> subprocess.Popen:
    """An installed executable at work."""
    executable = ROOT / "install" / "monoforce_ros" / "lib" / "monoforce_ros" / name
    with (folder / f"{name}.log").open("w") as log:
        return subprocess.Popen(
            [str(executable), *arguments], stdout=log, stderr=subprocess.STDOUT, env=os.environ | ENVIRONMENT
        )


def wait_for(log: Path, text: str, seconds: float = 90.0) -> None:
    """Until a process has printed something."""
    deadline = time.monotonic() + seconds
    while text not in log.read_text():
        if time.monotonic() > deadline:
            raise SystemExit(f"{log.name}: {text!r} did not appear:\n{log.read_text()}")
        time.sleep(0.1)


class Watcher(Peer):
    """Knows where the robot is and sends it off."""

    def __init__(self):
        super().__init__("watcher", ENVIRONMENT)
        self.way: list[np.ndarray] = []
        """x, y [m] and heading [rad]."""
        self.node.create_subscription(Odometry, "odom", self._on_odometry, QoSProfile(depth=20))
        self.goals = self.node.create_publisher(PoseStamped, "goal_pose", 1)

    def _on_odometry(self, message: Odometry) -> None:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        self.way.append(np.array([place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w)]))

    def send(self, goal: np.ndarray) -> None:
        """Send the robot to a place."""
        message = PoseStamped()
        message.header.frame_id = "odom"
        message.pose.position.x, message.pose.position.y = map(float, goal)
        self.goals.publish(message)


def room_to_wall(way: np.ndarray, course: CourseSettings, bounds: tuple) -> float:
    """Least distance between the robot's outline and the wall over a way ``[n, 3]`` [m]."""
    (rear, right), (front, left) = (bound.numpy()[:2] for bound in bounds)
    along, aside = (v.ravel() for v in np.meshgrid(np.linspace(rear, front, 21), np.linspace(right, left, 15)))
    cosine, sine = np.cos(way[:, 2:]), np.sin(way[:, 2:])
    x = way[:, :1] + along * cosine - aside * sine
    y = way[:, 1:2] + along * sine + aside * cosine
    ahead = np.maximum(0.0, np.abs(x - course.wall - WALL_THICKNESS / 2) - WALL_THICKNESS / 2)
    beside = np.maximum(0.0, np.abs(y - course.wall_side) - course.wall_width / 2)
    return float(np.hypot(ahead, beside).min())


def drive(seed: int, source: str, robot: str, checkpoint: str, seconds: float, folder: Path) -> dict:
    """One drive."""
    course = CourseSettings.draw(seed)
    goal = np.array([course.grass + course.grass_depth + BEHIND, 0.0])
    sensors = ["--camera-rate", "5" if "camera" in source else "0", "--lidar-rate", "5" if "lidar" in source else "0"]
    processes = [started("simulator", folder, "--course", "--seed", str(seed), *sensors)]
    wait_for(folder / "simulator.log", "simulating")
    parameters = [f"terrain_source:={source}", "candidates:=46", "horizon:=4.0", "rate:=5.0", f"robot:={robot}",
                  "candidate_yaw_rate:=1.0", "candidate_speeds:=[0.0,0.4,0.8]"]  # fmt: skip
    # What a camera comes near to it no longer sees.
    parameters += ["camera_retention_time:=20.0"] if source == "camera" else []
    parameters += [f"checkpoint:={checkpoint}"] if checkpoint else []
    words = [word for parameter in parameters for word in ("-p", parameter)]
    processes.append(started("predictor", folder, "--ros-args", *words))
    wait_for(folder / "predictor.log", "predicting")
    processes.append(started("path_selector", folder, "--ros-args", "-p", f"goal_tolerance:={0.8 * TOLERANCE}"))
    wait_for(folder / "path_selector.log", "waiting for a goal")
    watcher = Watcher()
    try:
        deadline = time.monotonic() + 20
        while not watcher.way or not watcher.goals.get_subscription_count():
            watcher.spin(0.2)
            if time.monotonic() > deadline:
                raise SystemExit("the simulator's odometry does not come")
        watcher.send(goal)
        began = time.monotonic()
        left = np.inf
        while time.monotonic() - began < seconds and left > TOLERANCE:
            watcher.spin(0.2)
            left = float(np.linalg.norm(watcher.way[-1][:2] - goal))
        took = time.monotonic() - began
    finally:
        way = np.array(watcher.way)
        watcher.close()
        for process in reversed(processes):
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)
    room = room_to_wall(way, course, load_robot(robot).bounds)
    return {
        "way": np.round(way[:: max(1, len(way) // 60), :2], 2).tolist(),
        "seed": seed, "source": source, "reached": left <= TOLERANCE, "left_m": left,
        "wall_touched": room < _TOUCHED, "room_to_wall_m": room,
        "seconds": took, "furthest_m": float(way[:, 0].max()), "grass_from_m": course.grass,
        "through_grass": bool(way[:, 0].max() > course.grass + course.grass_depth),
    }  # fmt: skip


def drawn(rows: list[dict], sources: list[str]) -> Figure:
    """The ways of all drives, a panel for each source; walls and grass of all seeds lie over each other."""
    figure = Figure(figsize=(5.2 * len(sources), 4.0), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(sources), squeeze=False)
    for panel, source in zip(panels[0], sources, strict=True):
        mine = [row for row in rows if row["source"] == source]
        for row in mine:
            course = CourseSettings.draw(row["seed"])
            panel.axvspan(course.grass, course.grass + course.grass_depth, color="#6aa84f", alpha=0.5 / len(mine), lw=0)
            corner = (course.wall, course.wall_side - course.wall_width / 2)
            panel.add_patch(Rectangle(corner, WALL_THICKNESS, course.wall_width, color="#444444", alpha=0.25, lw=0))
            fine = row["reached"] and not row["wall_touched"]
            panel.plot(*np.array(row["way"]).T, color="#1f77b4" if fine else "#d62728", lw=1.2)
            panel.plot(*row["way"][-1], "o" if fine else "x", color="#1f77b4" if fine else "#d62728", ms=5)
        reached = sum(row["reached"] and not row["wall_touched"] for row in mine)
        panel.set(title=f"{source}: {reached} of {len(mine)} reach the goal", aspect="equal", xlim=(-0.8, 10.5))
        panel.set(ylim=(-3.6, 3.6), xlabel="x [m]", ylabel="y [m]")
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="seeds (%(default)s)")
    parser.add_argument("--seed", type=int, default=80000, help="the first (%(default)s)")
    parser.add_argument("--source", nargs="+", choices=("lidar", "camera", "lidar_camera"),
                        default=["lidar", "camera", "lidar_camera"])  # fmt: skip
    parser.add_argument("--robot", default="husky", help="name or file (%(default)s)")
    parser.add_argument("--checkpoint", default="", help="terrain encoder (the shipped one)")
    parser.add_argument("--seconds", type=float, default=75.0, help="for each drive (%(default)s)")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, help="write the table between this document's marks")
    parser.add_argument("--png", type=Path, help="draw the ways")
    options = parser.parse_args()
    rows = []
    for source in options.source:
        for seed in range(options.seed, options.seed + options.count):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(drive(seed, source, options.robot, options.checkpoint, options.seconds, Path(folder)))
            row = rows[-1]
            end = "reached" if row["reached"] else "not reached"
            wall = "touched" if row["wall_touched"] else "clear of"
            print(
                f"{source} {seed}: {end} after {row['seconds']:.0f} s, {row['left_m']:.1f} m left, {wall} the wall",
                flush=True,
            )
    heads = ("terrain from", "goal reached", "wall touched", "came through the grass", "least room to the wall", "time")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for source in options.source:
        mine = [row for row in rows if row["source"] == source]
        times = [row["seconds"] for row in mine if row["reached"]]
        lines.append(
            f"| {source} | {sum(r['reached'] and not r['wall_touched'] for r in mine)} of {len(mine)} | "
            f"{sum(r['wall_touched'] for r in mine)} | {sum(r['through_grass'] for r in mine)} | "
            f"{min(r['room_to_wall_m'] for r in mine):.2f} m | "
            f"{f'{np.median(times):.0f} s' if times else '–'} |"
        )
    text = "\n".join(lines)
    print(text)
    if options.json:
        write_text(options.json, json.dumps({"rows": rows}, indent=1))
    if options.png:
        options.png.parent.mkdir(parents=True, exist_ok=True)
        drawn(rows, options.source).savefig(options.png)
    if options.docs:
        write_between(options.docs, "closed loop", text)


if __name__ == "__main__":
    main()
