"""Flipper angles over the horizon, refined by the gradient of a candidate's cost: MARV in front of a step.

    scripts/run.sh python benchmarks/flippers.py [--height M] [--seconds S]

Compares the cost of driving straight with every pair of held angles (front, rear), with a rough program that raises the
front flippers before the step and lifts the tail after it, and with what ``refine`` makes of that program.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass

import numpy as np
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.planning import Assessment, Limits, assess, force_every, refine
from monoforce_ros.prediction import JointMotion, Prediction, Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

HORIZON, TIME_STEP, SPEED = 5.0, 0.02, 0.4
DISTANCE = 0.75
"""From the robot to the foot of the step [m]: its front flippers are just before it."""
HELD = tuple(np.arange(-8, 13) / 10)
"""Angles held [rad]; at -0.14 all belts lie flat on level ground."""
LIMITS = Limits(pitch=1.0, slip=1.5, collision=1.5, wheel_load=1.5, force_variation=2.0)
"""Wide, so that bad angles have a cost rather than none."""


@dataclass(frozen=True)
class Comparison:
    """Costs with held and with refined angles."""

    held: dict[tuple[float, float], float]
    """By front and rear angle."""
    program: float
    """Of the rough program."""
    refined: float
    flippers: np.ndarray
    """Refined angles ``[T, F]`` [rad]."""
    rounds: int
    climbed: tuple[float, float]
    """Height gained with the best held and with the refined angles [m]."""


class _Step:
    """Terrain source of one map."""

    def __init__(self, height: float):
        self.grid = Grid.square(8.0, 0.05)
        x = torch.from_numpy(self.grid.x).float().expand(self.grid.rows, -1)
        self.map = TerrainMap.from_height(height * ((x - DISTANCE) / 0.1).clamp(0.0, 1.0), self.grid)


def rough_program(times: np.ndarray) -> np.ndarray:
    """Angles ``[T, 4]`` [rad] at times ``[T]`` [s]: front flippers up, then level and the tail lifted."""
    front = np.interp(times, [0.0, 1.5, 2.3], [0.9, 0.9, -0.3])
    rear = np.interp(times, [0.0, 1.5, 2.3], [-0.14, -0.14, -0.7])
    return np.stack([front, front, rear, rear], axis=-1)


def compare(height: float = 0.3, seconds: float = 30.0, held: tuple[float, ...] = HELD) -> Comparison:
    """Costs in front of a step of ``height`` [m]; ``seconds`` bound the refinement."""
    robot, source = load_robot("marv"), _Step(height)
    predictor = Predictor(robot, source, horizon=HORIZON, options=PhysicsOptions(time_step=TIME_STEP), history=0.1)  # type: ignore[arg-type]
    standing = np.array([0.0, 0.0, robot.ground_clearance])
    motion = MotionState(0, standing, np.eye(3), np.zeros(3), np.zeros(3))
    terrain = TerrainMap.from_height(source.map.height - robot.ground_clearance, source.grid)
    pairs = list(itertools.product(held, held))
    twists = np.tile([SPEED, 0.0], (len(pairs), predictor.history + predictor.steps, 1))
    programs = np.array([[(front, front, rear, rear)] * predictor.steps for front, rear in pairs])
    joints = JointMotion.of(robot, robot.joint_angles.double().numpy(), np.zeros(4))

    def outcome(angles: np.ndarray) -> tuple[Assessment, np.ndarray]:
        rolled = predictor.roll_out(
            terrain, [motion] * len(angles), twists[: len(angles)], with_forces=False, with_contact=True,
            force_every=force_every(TIME_STEP), joints=joints, flippers=angles,
        )  # fmt: skip
        commanded = torch.from_numpy(twists[: len(angles), predictor.history :]).float()
        return assess(rolled, terrain, robot, commanded, limits=LIMITS), rolled.position[:, -1, 2].numpy()

    # Without the time that compiling takes.
    short = Predictor(robot, source, horizon=0.5, options=predictor.options, history=0.1)  # type: ignore[arg-type]
    prediction = Prediction(motion, terrain, None, joints)  # type: ignore[arg-type]
    refine(short, prediction, twists[0, : short.history], np.array([[SPEED, 0.0]]), limits=LIMITS, seconds=600.0)
    found, gained = outcome(programs)
    costs = torch.where(found.feasible, found.cost, torch.inf)
    best = int(costs.argmin())
    program = rough_program(TIME_STEP * np.arange(predictor.steps))
    refined = refine(
        predictor, prediction, twists[0, : predictor.history], np.array([[SPEED, 0.0]]), limits=LIMITS,
        seconds=seconds, flippers=program, only_flippers=True,
    )  # fmt: skip
    assert refined.flippers is not None
    again, height_gained = outcome(np.stack([program, refined.flippers]))
    return Comparison(
        held={pair: float(cost) for pair, cost in zip(pairs, costs, strict=True)},
        program=float(again.cost[0]),
        refined=float(again.cost[1]),
        flippers=refined.flippers,
        rounds=refined.rounds,
        climbed=(float(gained[best]), float(height_gained[1])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=float, default=0.3, help="of the step [m] (default: 0.3)")
    parser.add_argument("--seconds", type=float, default=30.0, help="for the refinement [s] (default: 30)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = compare(options.height, options.seconds)
    print("| front, rear [rad] | cost |\n|---|---|")
    for (front, rear), cost in sorted(result.held.items(), key=lambda entry: entry[1])[:10]:
        print(f"| held at {front:.2f}, {rear:.2f} | {cost:.3f} |")
    print(f"| rough program | {result.program:.3f} |\n| refined in {result.rounds} rounds | {result.refined:.3f} |")
    print(f"height gained: {result.climbed[0]:.3f} m held, {result.climbed[1]:.3f} m refined")
    for index in np.linspace(0, len(result.flippers) - 1, 6).astype(int):
        print(f"{index * TIME_STEP:.1f} s: {np.round(result.flippers[index], 2).tolist()} rad")


if __name__ == "__main__":
    main()
