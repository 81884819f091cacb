"""Speed and accuracy of the integrators: the rollout and the paper's Neural-ODE variant.

    scripts/run.sh python benchmarks/integrators.py [--json FILE]

One Husky on bumpy ground for 1 s in float64. The error is the position difference at 1 s from a rollout with a time
step of 0.1 ms.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.physics import OdeOptions, PhysicsOptions, State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

STEPS, STEP = 100, 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    robot = load_robot("husky", spacing=0.066).to(torch.float64)
    grid = Grid.square(8.0, 0.1)
    x, y = (torch.from_numpy(v) for v in np.meshgrid(grid.x, grid.y))
    height = 0.05 * torch.sin(1.3 * x) * torch.cos(0.9 * y)
    speeds = robot.drive_speeds(torch.tensor([0.7, 0.5]).double().expand(1, STEPS, 2))
    state = State.at_rest(0.14, dtype=torch.float64)

    def fine(factor):
        stepped = PhysicsOptions(time_step=STEP / factor)
        repeated = speeds.repeat_interleave(factor, dim=1)
        terrain = TerrainMap.from_height(height, grid)
        return rollout(terrain, robot, repeated, state, options=stepped, with_forces=False).position[0, -1]

    truth = fine(100)

    def case(name, **choice):
        def run(backward):
            bumps = height.clone().requires_grad_(backward)
            result = rollout(TerrainMap.from_height(bumps, grid), robot, speeds, state, with_forces=False, **choice)
            if backward:
                result.position[0, -1].sum().backward()
            return result.position[0, -1].detach()

        error = float((run(False) - truth).norm())
        durations = {}
        for backward in (False, True):
            taken = []
            for _ in range(3):
                began = time.perf_counter()
                run(backward)
                taken.append(time.perf_counter() - began)
            durations[backward] = statistics.median(taken)
        return {"integrator": name, "error_mm": 1e3 * error, "forward_s": durations[False], "both_s": durations[True]}

    rows = [
        case("rollout, 10 ms, Warp", backend="warp"),
        case("rollout, 10 ms, PyTorch", backend="torch"),
        case("Neural ODE, Euler 1 ms", ode=OdeOptions(method="euler")),
        case("Neural ODE, rk4 2 ms", ode=OdeOptions(method="rk4", step=0.002)),
        case("Neural ODE, dopri5", ode=OdeOptions(method="dopri5")),
        case("Neural ODE, rk4 2 ms, adjoint", ode=OdeOptions(method="rk4", step=0.002, adjoint=True)),
        case("Neural ODE, dopri5, adjoint", ode=OdeOptions(method="dopri5", adjoint=True)),
    ]
    reference = rows[1]
    print(
        "| integrator | error at 1 s [mm] | forward [ms] | forward + backward [ms] | forward, times PyTorch rollout |"
    )
    print("|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['integrator']} | {row['error_mm']:.2f} | {1e3 * row['forward_s']:.1f} | "
            f"{1e3 * row['both_s']:.1f} | {row['forward_s'] / reference['forward_s']:.2f} |"
        )
    if options.json:
        write_text(options.json, json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
