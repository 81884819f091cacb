"""Steady turns: measured motion of real robots beside rollouts of their measured wheel speeds, by friction law.

    scripts/run.sh python benchmarks/steady_turns.py FILE... [--robot warthog] [--json FILE] [--docs docs/physics.md]

Reads windows of the DRIVE dataset. Driven by the wheel speeds that were measured, a rollout shows the contact alone: no
command, drive or clock takes part. Windows of 2 s are compared in which speeds have been steady for 2 s or more and the
wheels ask for a turn; nothing is fitted.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import write_text
from monoforce_ros.datasets import DriveRecording
from monoforce_ros.datasets.drive import TRACK_WIDTH, WHEEL_RADIUS, DriveRun
from monoforce_ros.physics import State, rollout
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

RATIOS = (0.0, 0.1, 0.2, 0.4, 0.8)
FRICTIONS = (0.5, 0.8, 1.1)
LENGTH, STEP = 2.0, 0.01
LEAST_TURN = 1.0
"""Yaw rate that the wheels ask for, without slip, from which a window counts as a turn [rad/s]."""
LEAST_WINDOWS = 20
"""A recording with fewer turns says nothing."""


def steady_windows(run: DriveRun) -> list[slice]:
    """Windows of a run that begin two seconds after its command, or later."""
    step = float(np.median(np.diff(run.stamps))) * 1e-9 if len(run.stamps) > 1 else LENGTH
    count = round(LENGTH / step)
    return [slice(first, first + count) for first in range(count, len(run.stamps) - count + 1, count)]


def measured_rates(run: DriveRun, window: slice) -> np.ndarray:
    """Mean forward and sideways speed and yaw rate in the robot's axes, ``[3]`` [m/s, m/s, rad/s]."""
    seconds = (run.stamps[window][-1] - run.stamps[window][0]) * 1e-9
    yaw = np.unwrap(Rotation.from_quat(run.quaternions[window]).as_euler("ZYX")[:, 0])
    return _body_rates(run.positions[window, :2], yaw, seconds)


def _body_rates(positions: np.ndarray, yaw: np.ndarray, seconds: float) -> np.ndarray:
    moved, middle = np.diff(positions, axis=0), (yaw[1:] + yaw[:-1]) / 2
    forward = (moved[:, 0] * np.cos(middle) + moved[:, 1] * np.sin(middle)).sum()
    sideways = (moved[:, 1] * np.cos(middle) - moved[:, 0] * np.sin(middle)).sum()
    return np.array([forward, sideways, yaw[-1] - yaw[0]]) / seconds


def predicted_rates(robot: RobotModel, wheels: np.ndarray, step: float, friction: float, ratio: float) -> np.ndarray:
    """The same of rollouts on level ground, ``[W, 3]``.

    Args:
        robot: with one drive at each side.
        wheels: surface speeds of the left and right wheels ``[W, T, 2]`` [m/s].
        step: time between them [s].
        friction: of the ground.
        ratio: at which tyres slip; 0 is Coulomb's law alone.
    """
    first = round(LENGTH / STEP)
    repeated = np.repeat(wheels, round(step / STEP), axis=1)
    before = np.repeat(wheels[:, :1], first, axis=1)
    speeds = torch.as_tensor(np.concatenate([before, repeated], axis=1), dtype=torch.float32)
    ground = TerrainMap.flat(Grid.square(4.0, 1.0), material=TerrainDefaults(friction=friction))
    if ratio:
        robot = replace(robot, effects=(*robot.effects, ("tyre_slip", {"ratio": ratio})))
    start = State.at_rest(robot.ground_clearance, batch=len(speeds))
    with torch.no_grad():
        result = rollout(ground, robot, speeds, start, with_forces=False)
    rotation = result.rotation[:, first:].numpy()
    yaw = np.unwrap(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]), axis=1)
    positions = result.position[:, first:, :2].numpy()
    seconds = repeated.shape[1] * STEP
    return np.array([_body_rates(p, y, seconds) for p, y in zip(positions, yaw, strict=True)])


def compared(recording: DriveRecording, robot: RobotModel) -> list[dict]:
    """A row for each friction and slip ratio: median errors over the turns; none where they are too few."""
    wheels, measured, step = [], [], 0.05
    for run in recording.runs:
        for window in steady_windows(run):
            speeds = WHEEL_RADIUS * run.wheels[window]
            if abs(float(np.mean(speeds[:, 1] - speeds[:, 0]))) / TRACK_WIDTH < LEAST_TURN:
                continue
            step = float(np.median(np.diff(run.stamps))) * 1e-9
            wheels.append(speeds)
            measured.append(measured_rates(run, window))
    if len(wheels) < LEAST_WINDOWS:
        return []
    rows = []
    for friction in FRICTIONS:
        for ratio in RATIOS:
            errors = np.abs(predicted_rates(robot, np.array(wheels), step, friction, ratio) - np.array(measured))
            forward, sideways, turn = np.median(errors, axis=0)
            rows.append(
                {
                    "recording": recording.path.name, "windows": len(wheels), "friction": friction, "tyre_slip": ratio,
                    "forward": float(forward), "sideways": float(sideways), "yaw_rate": float(turn),
                }
            )  # fmt: skip
    return rows


def section(rows: list[dict]) -> str:
    """Table: error of the yaw rate and the forward speed by recording, friction and slip ratio."""
    lines = [
        "| recording (turns) | friction | " + " | ".join(f"κ = {ratio:g}" for ratio in RATIOS) + " |",
        "|---|---|" + "---|" * len(RATIOS),
    ]
    for name in dict.fromkeys(row["recording"] for row in rows):
        for friction in FRICTIONS:
            own = [row for row in rows if row["recording"] == name and row["friction"] == friction]
            cells = [f"{row['yaw_rate']:.2f}, {row['forward']:.2f}" for row in own]
            lines.append(f"| {name} ({own[0]['windows']}) | {friction:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="windows of the DRIVE dataset")
    parser.add_argument("--robot", default="warthog", help="robot that recorded them (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the table into this document")
    options = parser.parse_args()
    robot = load_robot(options.robot)
    rows = []
    for path in options.files:
        found = compared(DriveRecording.open(path), robot)
        if not found:
            print(f"{path.name}: fewer than {LEAST_WINDOWS} steady turns, left out")
        rows += found
    text = section(rows)
    print("median errors of yaw rate [rad/s] and forward speed [m/s]\n\n" + text)
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    if options.docs:
        write_between(options.docs, "steady turns", text)


if __name__ == "__main__":
    main()
