"""Simulator, predictor and path_selector drive to a goal around a wall and through tall grass, seed after seed.

    scripts/run.sh python benchmarks/closed_loop.py [--count 10] [--source NAME ...] [--json FILE] [--docs FILE]

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
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from ros_peer import Peer

from monoforce_ros.evaluation.report import write_between, write_text
from monoforce_ros.synthetic.course import CourseSettings

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {"ROS_DOMAIN_ID": "88", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
TOLERANCE = 0.5
BEHIND = 2.0
"""Of the goal behind the grass [m]."""
_ROBOT = 0.55
"""Nearer to a wall than this the robot's middle is in it [m]: half its length, and some."""


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
        self.node.create_subscription(Odometry, "odom", self._on_odometry, QoSProfile(depth=20))
        self.goals = self.node.create_publisher(PoseStamped, "goal_pose", 1)

    def _on_odometry(self, message: Odometry) -> None:
        place = message.pose.pose.position
        self.way.append(np.array([place.x, place.y]))

    def send(self, goal: np.ndarray) -> None:
        """Send the robot to a place."""
        message = PoseStamped()
        message.header.frame_id = "odom"
        message.pose.position.x, message.pose.position.y = map(float, goal)
        self.goals.publish(message)


def drive(seed: int, source: str, robot: str, checkpoint: str, seconds: float, folder: Path) -> dict:
    """One drive."""
    course = CourseSettings.draw(seed)
    goal = np.array([course.grass + course.grass_depth + BEHIND, 0.0])
    sensors = ["--camera-rate", "5" if "camera" in source else "0", "--lidar-rate", "5" if "lidar" in source else "0"]
    processes = [started("simulator", folder, "--course", "--seed", str(seed), *sensors)]
    wait_for(folder / "simulator.log", "simulating")
    parameters = [f"terrain_source:={source}", "candidates:=46", "horizon:=4.0", "rate:=5.0", f"robot:={robot}",
                  "candidate_yaw_rate:=1.0", "candidate_speeds:=[0.0,0.4,0.8]"]  # fmt: skip
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
            left = float(np.linalg.norm(watcher.way[-1] - goal))
        took = time.monotonic() - began
    finally:
        way = np.array(watcher.way)
        watcher.close()
        for process in reversed(processes):
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)
    across = np.abs(way[:, 1] - course.wall_side) < course.wall_width / 2
    along = course.wall - way[:, 0]
    touched = bool((across & (along < _ROBOT) & (along > -_ROBOT)).any())
    return {
        "way": np.round(way[:: max(1, len(way) // 60)], 2).tolist(),
        "seed": seed, "source": source, "reached": left <= TOLERANCE, "wall_touched": touched, "left_m": left,
        "seconds": took, "furthest_m": float(way[:, 0].max()), "grass_from_m": course.grass,
        "through_grass": bool(way[:, 0].max() > course.grass + course.grass_depth),
    }  # fmt: skip


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
    lines = ["| terrain from | goal reached | wall touched | came through the grass | median time |", "|---" * 5 + "|"]
    for source in options.source:
        mine = [row for row in rows if row["source"] == source]
        times = [row["seconds"] for row in mine if row["reached"]]
        lines.append(
            f"| {source} | {sum(r['reached'] and not r['wall_touched'] for r in mine)} of {len(mine)} | "
            f"{sum(r['wall_touched'] for r in mine)} | {sum(r['through_grass'] for r in mine)} | "
            f"{f'{np.median(times):.0f} s' if times else '–'} |"
        )
    text = "\n".join(lines)
    print(text)
    if options.json:
        write_text(options.json, json.dumps({"rows": rows}, indent=1))
    if options.docs:
        write_between(options.docs, "closed loop", text)


if __name__ == "__main__":
    main()
