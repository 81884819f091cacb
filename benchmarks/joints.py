"""What steering and flippers cost: rollouts in which they move beside rollouts of the same body in which they do not.

    scripts/run.sh python benchmarks/joints.py [--json FILE] [--quick]

Both run alternately in one process with one thread, over the same bumpy ground and drive speeds; the figure is the
ratio of the medians. The body that stands still has the same points, and neither joints nor motor limits.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import yaml
from rollout import bumpy_ground

from monoforce_ros.core import write_text
from monoforce_ros.effects import controls
from monoforce_ros.physics import State
from monoforce_ros.physics import rollout as predict
from monoforce_ros.robots import Controls, RobotModel, load_robot, robot_file
from monoforce_ros.terrain import TerrainMap

STEP, STEPS = 0.01, 500
CASES = (
    ("rally_car", "steering", ("suspension", "motors")),
    ("rally_car", "steering, springs and motors", ()),
    ("offroad_car", "steering", ("suspension", "motors")),
    ("offroad_car", "steering, springs and motors", ()),
    ("marv", "flippers", ()),
)
"""Robot, what moves, and sections of its file that are left out."""
BATCHES = (1, 64)


def commanded(robot: RobotModel, batch: int, steps: int) -> Controls:
    """A fan of arcs; flippers swing up and down."""
    share = torch.linspace(-1.0, 1.0, batch) if batch > 1 else torch.tensor([0.5])
    twists = torch.stack([torch.full_like(share, min(1.0, robot.maximum_speed)), 0.6 * share], dim=-1)
    count = len(robot.flippers)
    flippers = None
    if count:
        times = STEP * torch.arange(steps)
        flippers = (0.4 * torch.sin(times))[None, :, None].expand(batch, steps, count)
    return controls(robot, twists[:, None].expand(batch, steps, 2), STEP, flippers=flippers)


def work(robot: RobotModel, given: Controls, batch: int, *, backward: bool) -> Callable[[], None]:
    """A rollout, or one with its gradient by the terrain's height."""
    ground = bumpy_ground()
    height = ground.height.requires_grad_(backward)
    terrain = TerrainMap.from_height(height, ground.grid)
    state = State.at_rest(robot.ground_clearance, batch=batch)

    def run() -> None:
        with torch.set_grad_enabled(backward):
            result = predict(terrain, robot, given, state, with_forces=False)
            if backward:
                height.grad = None
                result.position[:, ::50].sum().backward()

    return run


def robot_without(name: str, sections: Sequence[str]) -> RobotModel:
    """A shipped robot without some sections of its file."""
    content = yaml.safe_load(robot_file(name).read_text())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(yaml.safe_dump({key: value for key, value in content.items() if key not in sections}))
        return load_robot(path)


def compare(name: str, left_out: Sequence[str], batch: int, *, backward: bool, quick: bool) -> dict:
    """Medians of rollouts with and without motion of the joints."""
    robot = robot_without(name, left_out)
    moving = commanded(robot, batch, 50 if quick else STEPS)
    still = dataclasses.replace(
        robot, joints=(), flippers=(), steered=None, motors=(), point_joints=None, point_grip=None, joint_angles=None
    )
    pair = (
        work(still, Controls(moving.drive_speeds), batch, backward=backward),
        work(robot, moving, batch, backward=backward),
    )
    durations: tuple[list[float], list[float]] = ([], [])
    for run in pair:
        run()
    for _ in range(2 if quick else 15):
        for run, into in zip(pair, durations, strict=True):
            began = time.perf_counter()
            run()
            into.append(time.perf_counter() - began)
    seconds = [statistics.median(values) for values in durations]
    return {
        "robot": name, "joints": len(robot.joints), "points": len(robot.points), "batch": batch, "backward": backward,
        "still_s": seconds[0], "moving_s": seconds[1], "ratio": seconds[1] / seconds[0],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="50 steps and two runs each, for testing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    print("| robot | moves | points | case | still [ms] | moving [ms] | ratio |\n|---|---|---|---|---|---|---|")
    for name, what, left_out in CASES:
        for backward in (False, True):
            for batch in BATCHES:
                row = {"moves": what} | compare(name, left_out, batch, backward=backward, quick=options.quick)
                rows.append(row)
                case = f"B = {batch}, {'forward + backward' if backward else 'forward'}"
                print(
                    f"| {name} | {what} | {row['points']} | {case} | {1e3 * row['still_s']:.1f} | "
                    f"{1e3 * row['moving_s']:.1f} | {row['ratio']:.2f} |",
                    flush=True,
                )
    if options.json:
        write_text(options.json, json.dumps({"steps": STEPS, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
