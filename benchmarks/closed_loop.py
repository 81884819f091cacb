"""Closed loop: simulator, predictor and path_selector drive around a wall and through tall grass to a goal.

    scripts/run.sh python benchmarks/closed_loop.py [--count 10] [--seed 91000] [--source NAME ...] [--json FILE]
                                                    [--docs FILE] [--png FILE]

The three processes communicate through ROS in real time. A run succeeds if the robot comes within half a metre of the
goal within the time limit without touching the wall. `lidar_interpolation` treats grass as solid ground; the other
sources run the terrain encoder on the sweep, the images, or both.

Settings of the encoder and the selector were tuned on courses with seeds 80000 to 80031. Reported results use held-out
seeds from 91000 on (the default); `--docs` rejects the tuning seeds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from ros_peer import Executable, Peer

from monoforce_ros.core import write_text
from monoforce_ros.perception import SOURCES
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import WALL_THICKNESS, CourseSettings

ENVIRONMENT = {"ROS_DOMAIN_ID": "88", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
CHOICE_SEEDS = range(80_000, 80_032)
"""Seeds of courses for tuning the encoder and the selector; never report results on them."""
REPORT_SEED = 91_000
"""First seed of courses for reported results; do not tune on this or later seeds."""
DRIVEN = tuple(source for source in SOURCES if source != "flat")
"""Terrain sources that see the wall."""
TOLERANCE = 0.5
"""Distance to the goal at which it counts as reached [m]."""
GOAL_BEHIND_GRASS = 2.0
"""Distance of the goal behind the grass [m]."""
_CONTACT_CLEARANCE = 0.03
"""Clearance below which the robot has touched the wall, within the accuracy of its odometry [m]."""


class Watcher(Peer):
    """Sends the goal and records the robot's trajectory."""

    def __init__(self):
        super().__init__("watcher", ENVIRONMENT)
        self.trajectory: list[np.ndarray] = []
        """x, y [m] and heading [rad]."""
        self.node.create_subscription(Odometry, "odom", self._on_odometry, QoSProfile(depth=20))
        self.goals = self.node.create_publisher(PoseStamped, "goal_pose", 1)

    def _on_odometry(self, message: Odometry) -> None:
        position, rotation = message.pose.pose.position, message.pose.pose.orientation
        heading = 2.0 * np.arctan2(rotation.z, rotation.w)
        self.trajectory.append(np.array([position.x, position.y, heading]))

    def send(self, goal: np.ndarray) -> None:
        """Send the robot to a goal ``[2]`` [m]."""
        message = PoseStamped()
        message.header.frame_id = "odom"
        message.pose.position.x, message.pose.position.y = map(float, goal)
        self.goals.publish(message)


def wall_clearance(trajectory: np.ndarray, course: CourseSettings, bounds: tuple) -> float:
    """Smallest distance between the robot's outline and the wall over a trajectory ``[n, 3]`` [m]."""
    (rear, right), (front, left) = (bound.numpy()[:2] for bound in bounds)
    along, across = (v.ravel() for v in np.meshgrid(np.linspace(rear, front, 21), np.linspace(right, left, 15)))
    cosine, sine = np.cos(trajectory[:, 2:]), np.sin(trajectory[:, 2:])
    x = trajectory[:, :1] + along * cosine - across * sine
    y = trajectory[:, 1:2] + along * sine + across * cosine
    offset_x = np.maximum(0.0, np.abs(x - course.wall - WALL_THICKNESS / 2) - WALL_THICKNESS / 2)
    offset_y = np.maximum(0.0, np.abs(y - course.wall_side) - course.wall_width / 2)
    return float(np.hypot(offset_x, offset_y).min())


def drive(seed: int, source: str, robot: str, checkpoint: str, seconds: float, folder: Path) -> dict:
    """Run one course with one terrain source."""
    course = CourseSettings.draw(seed)
    goal = np.array([course.grass + course.grass_depth + GOAL_BEHIND_GRASS, 0.0])
    sensors = ["--camera-rate", "5" if "camera" in source else "0", "--lidar-rate", "5" if "lidar" in source else "0"]
    processes = [_start("simulator", folder, "--course", "--seed", str(seed), *sensors)]
    processes[-1].wait_for("simulating")
    parameters = [f"terrain_source:={source}", "candidates:=46", "horizon:=4.0", "rate:=5.0", f"robot:={robot}",
                  "candidate_yaw_rate:=1.0", "candidate_speeds:=[0.0,0.4,0.8]"]  # fmt: skip
    # Nearby obstacles leave the camera's field of view.
    parameters += ["camera_retention_time:=20.0"] if source == "camera" else []
    parameters += [f"checkpoint:={checkpoint}"] if checkpoint else []
    words = [word for parameter in parameters for word in ("-p", parameter)]
    processes.append(_start("predictor", folder, "--ros-args", *words))
    processes[-1].wait_for("predicting")
    processes.append(_start("path_selector", folder, "--ros-args", "-p", f"goal_tolerance:={0.8 * TOLERANCE}"))
    processes[-1].wait_for("waiting for a goal")
    watcher = Watcher()
    try:
        deadline = time.monotonic() + 20
        while not watcher.trajectory or not watcher.goals.get_subscription_count():
            watcher.spin(0.2)
            if time.monotonic() > deadline:
                raise SystemExit("no odometry from the simulator, or no subscriber of the goal, within 20 s")
        watcher.send(goal)
        began = time.monotonic()
        remaining = np.inf
        while time.monotonic() - began < seconds and remaining > TOLERANCE:
            watcher.spin(0.2)
            remaining = float(np.linalg.norm(watcher.trajectory[-1][:2] - goal))
        duration = time.monotonic() - began
    finally:
        trajectory = np.array(watcher.trajectory)
        watcher.close()
        for process in reversed(processes):
            process.stop()
    clearance = wall_clearance(trajectory, course, load_robot(robot).bounds)
    return {
        "trajectory": np.round(trajectory[:: max(1, len(trajectory) // 60), :2], 2).tolist(),
        "seed": seed, "source": source, "reached": remaining <= TOLERANCE, "remaining_m": remaining,
        "wall_touched": clearance < _CONTACT_CLEARANCE, "wall_clearance_m": clearance,
        "seconds": duration, "largest_x_m": float(trajectory[:, 0].max()), "grass_x_m": course.grass,
        "through_grass": bool(trajectory[:, 0].max() > course.grass + course.grass_depth),
    }  # fmt: skip


def _start(name: str, folder: Path, *arguments: str) -> Executable:
    return Executable(name, list(arguments), folder / f"{name}.log", ENVIRONMENT)


def trajectory_figure(rows: list[dict], sources: list[str]) -> Figure:
    """Trajectories of all runs, one panel per source; walls and grass of all seeds are superimposed."""
    figure = Figure(figsize=(5.2 * len(sources), 6.4), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(sources), squeeze=False)
    for panel, source in zip(panels[0], sources, strict=True):
        selected = [row for row in rows if row["source"] == source]
        for row in selected:
            course = CourseSettings.draw(row["seed"])
            panel.axvspan(
                course.grass, course.grass + course.grass_depth, color="#6aa84f", alpha=0.5 / len(selected), lw=0
            )
            corner = (course.wall, course.wall_side - course.wall_width / 2)
            panel.add_patch(Rectangle(corner, WALL_THICKNESS, course.wall_width, color="#444444", alpha=0.25, lw=0))
            succeeded = row["reached"] and not row["wall_touched"]
            colour = "#1f77b4" if succeeded else "#d62728"
            panel.plot(*np.array(row["trajectory"]).T, color=colour, lw=1.2)
            panel.plot(*row["trajectory"][-1], "o" if succeeded else "x", color=colour, ms=5)
        reached = sum(row["reached"] and not row["wall_touched"] for row in selected)
        panel.set(title=f"{source}: {reached} of {len(selected)} reach the goal", aspect="equal", xlim=(-0.8, 10.5))
        sideways = 0.6 + max(3.0, *(np.abs(np.array(row["trajectory"])[:, 1]).max() for row in selected))
        panel.set(ylim=(-sideways, sideways), xlabel="x [m]", ylabel="y [m]")
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="number of seeds (%(default)s)")
    parser.add_argument(
        "--seed",
        type=int,
        default=REPORT_SEED,
        help=f"first seed (%(default)s); {CHOICE_SEEDS[0]} to {CHOICE_SEEDS[-1]} are for tuning, seeds from "
        f"{REPORT_SEED} on for reporting",
    )
    parser.add_argument("--source", nargs="+", choices=DRIVEN, default=list(DRIVEN),
                        help="terrain sources (default: all)")  # fmt: skip
    parser.add_argument("--robot", default="husky", help="robot name or file (%(default)s)")
    parser.add_argument("--checkpoint", default="", help="terrain encoder weights (default: the shipped ones)")
    parser.add_argument("--seconds", type=float, default=75.0, help="time limit of each run (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument(
        "--docs", type=Path, help="write the table into this document, between its `<!-- closed loop -->` comments"
    )
    parser.add_argument("--png", type=Path, help="draw the trajectories")
    options = parser.parse_args()
    if options.count < 1:
        parser.error(f"--count: got {options.count}, expected at least 1")
    seeds = range(options.seed, options.seed + options.count)
    if options.docs and set(seeds) & set(CHOICE_SEEDS):
        parser.error(
            f"--docs: got seeds {seeds[0]} to {seeds[-1]}, including tuning seeds, expected seeds from {REPORT_SEED} on"
        )
    rows = []
    for source in options.source:
        for seed in seeds:
            with tempfile.TemporaryDirectory() as folder:
                rows.append(drive(seed, source, options.robot, options.checkpoint, options.seconds, Path(folder)))
            row = rows[-1]
            end = "reached" if row["reached"] else "not reached"
            wall = "touched" if row["wall_touched"] else "clear of"
            print(
                f"{source} {seed}: {end} after {row['seconds']:.0f} s, {row['remaining_m']:.1f} m remaining, "
                f"{wall} the wall",
                flush=True,
            )
    heads = (
        "terrain from",
        "goal reached",
        "wall touched",
        "crossed the grass",
        "smallest clearance to the wall",
        "time",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for source in options.source:
        selected = [row for row in rows if row["source"] == source]
        times = [row["seconds"] for row in selected if row["reached"]]
        lines.append(
            f"| {source} | {sum(r['reached'] and not r['wall_touched'] for r in selected)} of {len(selected)} | "
            f"{sum(r['wall_touched'] for r in selected)} | {sum(r['through_grass'] for r in selected)} | "
            f"{min(r['wall_clearance_m'] for r in selected):.2f} m | "
            f"{f'{np.median(times):.0f} s' if times else '–'} |"
        )
    text = "\n".join(lines)
    print(text)
    if options.json:
        write_text(options.json, json.dumps({"rows": rows}, indent=1))
    if options.png:
        options.png.parent.mkdir(parents=True, exist_ok=True)
        trajectory_figure(rows, options.source).savefig(options.png)
    if options.docs:
        write_between(options.docs, "closed loop", text)


if __name__ == "__main__":
    main()
