"""What stops a robot: posts, trunks, kerbs and bars in the rollout and in MuJoCo, with the same robot and commands.

    scripts/run.sh python benchmarks/obstacles.py [--robot husky] [--speed 1.0] [--resolution 0.05 0.1] [--json FILE]
    scripts/run.sh python benchmarks/obstacles.py --rim [--robot husky warthog] [--json FILE]

The robot drives straight ahead for four seconds towards an obstacle on level ground, 1.5 m ahead. In MuJoCo it is
a solid box or cylinder; the rollout's map has the obstacle's height in every cell of which its footprint covers a
quarter or more, and at least in the cell of its middle. A bar hangs in the air in MuJoCo; a height map fills the
space below it.

``--rim`` measures where a robot gets past a post of 5 cm: how far outside the outermost of its wheels the post's
middle may stand and still stop it. Half the post's width, 2.5 cm, is the geometric answer; a map knows a place to
half a cell.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import (
    TIME_STEP,
    Simulation,
    TerrainSettings,
    Vehicle,
    build_model,
    build_scenery,
    shapes,
)
from monoforce_ros.synthetic.obstacle import Obstacle, Part
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

SECONDS, STEP, DISTANCE = 4.0, 0.01, 1.5
FRICTION = 0.8
STOPPED = 0.75
"""A robot counts as stopped if it covers less than this share of what it covers without the post: between the shares
of robots that turn about a post (0.57 at most) and of those that graze it (0.95 at least)."""


@dataclass(frozen=True)
class Block:
    """A box on level ground: lateral position of its middle, length, width and height, and clearance below it [m]."""

    name: str
    y: float
    size: tuple[float, float, float]
    clearance: float = 0.0
    round: bool = False

    def obstacle(self, x: float, ground: float) -> Obstacle:
        """The solid body, its middle at ``x`` [m] on ground at height ``ground`` [m]."""
        height = self.size[2] - self.clearance
        if self.round:
            shape = shapes.cylinder(self.size[0] / 2, height)
        else:
            shape = shapes.box(np.array([*self.size[:2], height]), 0.0)
        shape = shape.moved(np.array([x, self.y, ground + self.clearance]))
        return Obstacle("block", (Part(shape, "wall"),), np.array([x, self.y]), max(self.size[:2]))

    def terrain(self, x: float, resolution: float) -> TerrainMap:
        """Level ground with the block's height in the cells of its footprint."""
        grid = Grid.square(12.8, resolution)
        fine = 8
        offsets = ((np.arange(fine) + 0.5) / fine - 0.5) * resolution
        along, across = (
            np.add.outer(np.asarray(axis), offsets).reshape(-1) - place
            for axis, place in ((grid.x, x), (grid.y, self.y))
        )
        if self.round:
            inside = np.hypot(along[None, :], across[:, None]) <= self.size[0] / 2
        else:
            inside = (np.abs(along)[None, :] <= self.size[0] / 2) & (np.abs(across)[:, None] <= self.size[1] / 2)
        share = inside.reshape(grid.rows, fine, grid.columns, fine).mean(axis=(1, 3))
        filled = share >= 0.25
        middle = (int(np.argmin(np.abs(np.asarray(grid.y) - self.y))), int(np.argmin(np.abs(np.asarray(grid.x) - x))))
        filled[middle] = True
        heights = torch.from_numpy(np.where(filled, self.size[2], 0.0).astype(np.float32))
        return TerrainMap.from_height(heights, grid, material=TerrainDefaults(friction=FRICTION))


def blocks(robot: RobotModel) -> list[Block]:
    """Obstacles for a robot: at its middle, beside it and at a wheel; lower and higher than its underside."""
    outward = robot.point_outward
    assert outward is not None
    # Faces to both sides are the hull's alone; wheels have a front and a rear.
    hull = robot.points[outward[:, 1] != 0.0]
    low = float(hull[:, 2].min()) + robot.ground_clearance
    high = float(hull[:, 2].max()) + robot.ground_clearance
    side = float(hull[:, 1].max()) / 2
    driven = robot.points[robot.point_drives >= 0]
    wheel = float((driven[:, 1].max() + driven[driven[:, 1] > 0][:, 1].min()) / 2)
    rim = float(robot.points[:, 1].max())
    return [
        Block("post 5 cm", 0.0, (0.05, 0.05, 1.0)),
        Block("post 10 cm", 0.0, (0.10, 0.10, 1.0)),
        Block("post 5 cm, off the middle", side, (0.05, 0.05, 1.0)),
        Block("post 10 cm, off the middle", side, (0.10, 0.10, 1.0)),
        Block("stump 10 cm, as high as half the hull", 0.0, (0.10, 0.10, (low + high) / 2)),
        Block("stump 5 cm, as high as half the hull", 0.0, (0.05, 0.05, (low + high) / 2)),
        Block("trunk 20 cm", 0.0, (0.20, 0.20, 2.0), round=True),
        Block("trunk 20 cm before a wheel", wheel, (0.20, 0.20, 2.0), round=True),
        Block("post 10 cm before a wheel", wheel, (0.10, 0.10, 1.0)),
        Block("post 5 cm before a wheel", wheel, (0.05, 0.05, 1.0)),
        Block("post 5 cm before a wheel's outer rim", rim, (0.05, 0.05, 1.0)),
        Block("kerb, a third of the clearance", 0.0, (0.3, 6.0, low / 3)),
        Block("kerb, two thirds of the hull", 0.0, (0.3, 6.0, low + 0.67 * (high - low))),
        Block("bar at half the hull", 0.0, (0.10, 6.0, high), clearance=(low + high) / 2),
        Block("bar above the hull", 0.0, (0.10, 6.0, high + 0.6), clearance=high + 0.5),
    ]


def distance(robot: RobotModel) -> float:
    """Distance of an obstacle's middle from the base frame [m]: well before the front of a long robot, too."""
    return max(DISTANCE, float(robot.points[:, 0].max()) + 0.8)


def in_mujoco(robot: str | Path, block: Block, speed: float) -> np.ndarray:
    """Final position ``[3]`` [m] in the odom frame."""
    scenery = build_scenery(TerrainSettings(flat=True, bare=True), 1)
    vehicle = Vehicle.load(robot)
    origin = Simulation(build_model(scenery, vehicle, 1, {}), scenery, vehicle).odom_origin
    ground = float(scenery.ground.height_at(origin[:2]))
    obstacle = block.obstacle(origin[0] + distance(load_robot(robot)), ground)
    scenery = replace(scenery, obstacles=(replace(obstacle, position=obstacle.position + origin[:2]),))
    simulation = Simulation(build_model(scenery, vehicle, 1, {}), scenery, vehicle)
    simulation.drive(speed, 0.0)
    for _ in range(round(SECONDS / TIME_STEP)):
        simulation.step()
    return simulation.state().position


def in_rollout(
    robot: RobotModel, block: Block, speed: float, resolution: float, ahead: float | None = None
) -> np.ndarray:
    """Final position ``[3]`` [m], with the block ``ahead`` [m] (default: as :func:`distance` says)."""
    ahead = distance(robot) if ahead is None else ahead
    twists = torch.tensor([speed, 0.0]).expand(1, round(SECONDS / STEP), 2)
    start = State.at_rest(robot.ground_clearance)
    result = rollout(
        block.terrain(ahead, resolution), robot, drive_speeds(robot, twists, STEP), start, with_forces=False
    )
    return result.position[0, -1].numpy() - np.array([0.0, 0.0, robot.ground_clearance])


def compare(robot: str, speed: float, resolutions: Sequence[float]) -> list[dict]:
    """Distance covered along x in MuJoCo and in the rollout [m] for each obstacle."""
    model = load_robot(robot)
    rows = []
    for block in blocks(model):
        truth = in_mujoco(robot, block, speed)
        row: dict = {"obstacle": block.name, "mujoco": [round(float(v), 3) for v in truth]}
        for resolution in resolutions:
            place = in_rollout(model, block, speed, resolution)
            row[f"{resolution:g} m"] = [round(float(v), 3) for v in place]
        rows.append(row)
    return rows


def reach(robot: str, speed: float, resolutions: Sequence[float]) -> dict:
    """How far outside a robot's outermost points a post of 5 cm stops it, in MuJoCo and in the rollout [m]."""
    model = load_robot(robot)
    rim = float(model.points[:, 1].max())
    aside = rim + 10.0

    def stops(drive: Callable[[Block], np.ndarray]) -> Callable[[float], bool]:
        free = drive(Block("post", aside, (0.05, 0.05, 1.0)))[0]
        return lambda offset: bool(drive(Block("post", rim + offset, (0.05, 0.05, 1.0)))[0] < STOPPED * free)

    def farthest(stopped: Callable[[float], bool]) -> float:
        inner, outer = -0.1, 0.15
        if not stopped(inner):
            return float("nan")
        while outer - inner > 0.005:
            middle = (inner + outer) / 2
            inner, outer = (middle, outer) if stopped(middle) else (inner, middle)
        return round((inner + outer) / 2, 3)

    row: dict = {"robot": model.name, "mujoco": farthest(stops(lambda block: in_mujoco(robot, block, speed)))}
    for resolution in resolutions:
        row[f"{resolution:g} m"] = farthest(stops(lambda block, cell=resolution: in_rollout(model, block, speed, cell)))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", nargs="+", default=["husky"], help="names or files (default: husky)")
    parser.add_argument("--rim", action="store_true", help="where a post beside the wheels still stops the robot")
    parser.add_argument("--speed", type=float, default=1.0, help="commanded speed [m/s] (default: %(default)s)")
    parser.add_argument("--resolution", type=float, nargs="+", default=[0.05, 0.1], help="of the map [m] (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    columns = ["mujoco", *(f"{resolution:g} m" for resolution in options.resolution)]
    if options.rim:
        print(f"| robot | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
        rows = []
        for robot in options.robot:
            rows.append(reach(robot, options.speed, options.resolution))
            print(f"| {rows[-1]['robot']} | {' | '.join(f'{rows[-1][c]:+.3f}' for c in columns)} |", flush=True)
        results = {"speed": options.speed, "rows": rows}
    else:
        results = {"speed": options.speed, "robots": {}}
        for robot in options.robot:
            rows = compare(robot, options.speed, options.resolution)
            print(f"\n{robot}\n\n| obstacle | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
            for row in rows:
                cells = " | ".join(f"{row[c][0]:.2f} ({row[c][1]:+.2f}, {row[c][2]:+.2f})" for c in columns)
                print(f"| {row['obstacle']} | {cells} |")
            results["robots"][robot] = rows
    if options.json:
        write_text(options.json, json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
