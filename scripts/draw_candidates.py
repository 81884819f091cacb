"""Draws the planner's view: candidates by cost on the predicted map, the refined best one, and its uncertainty.

scripts/run.sh python scripts/draw_candidates.py [BAG] [--at SECONDS] [--out docs/candidates.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.figure import Figure

from monoforce_ros.bags import Recording, observe
from monoforce_ros.perception import LidarTerrain
from monoforce_ros.planning import CandidateSettings, assess, fan_of_arcs, force_every, occupancy, over_horizon, refine
from monoforce_ros.prediction import EnsembleSettings, Prediction, Predictor, spread
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults

ROOT = Path(__file__).resolve().parent.parent


def draw(recording: Recording, seconds: float) -> Figure:
    """Draw the figure for one time of a recording."""
    robot = load_robot("husky")
    predictor = Predictor(robot, LidarTerrain(robot, Grid.square(), TerrainDefaults()))
    stamp = int(recording.motion.stamps[0] + 1e9 * seconds)
    frame = min(recording.clouds, key=lambda entry: abs(entry.stamp - stamp))
    motion = recording.motion.at(frame.stamp)
    terrain = predictor.source.terrain(observe(recording, robot, frame.stamp, predictor.source.sensors), motion)
    before = recording.commands.sample(predictor.command_stamps(frame.stamp))[: predictor.history]
    fan = fan_of_arcs(CandidateSettings(41, (0.4, 0.8), 0.9))
    twists = over_horizon(fan, before, predictor.steps)
    every = force_every(predictor.options.time_step)
    rolled = predictor.roll_out(terrain, [motion] * len(fan), twists, with_contact=True, force_every=every)
    found = assess(rolled, terrain, robot, torch.from_numpy(twists[:, predictor.history :]).float())
    # The cheapest of the fast candidates.
    moving = torch.from_numpy(np.abs(fan[:, 0, 0]) > 0.6) & found.feasible
    best = int(torch.where(moving, found.cost, torch.inf).argmin())
    chosen = Prediction(motion, terrain, predictor.roll_out(terrain, [motion], twists[best : best + 1]))
    refinement = refine(predictor, chosen, before, fan[best], seconds=5.0)
    commands = over_horizon(refinement.sequence[None], before, predictor.steps)
    refined = Prediction(motion, terrain, predictor.roll_out(terrain, [motion], commands))
    uncertainty = spread(predictor, refined, commands[0], EnsembleSettings())
    figure = Figure(figsize=(13, 6.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    x, y = np.asarray(terrain.grid.x), np.asarray(terrain.grid.y)
    heights = terrain.height.numpy()
    mesh = left.pcolormesh(x, y, heights, cmap="bone", vmin=-1.0, vmax=1.0, shading="nearest", rasterized=True)
    figure.colorbar(mesh, ax=left, label="height [m]", shrink=0.8)
    cost = found.cost.numpy()
    low, high = cost[found.feasible.numpy()].min(), cost[found.feasible.numpy()].max()
    for n in range(len(fan)):
        path = rolled.position[n].numpy()[rolled.inside[n].numpy()]
        feasible = bool(found.feasible[n])
        colour = colormaps["RdYlGn_r"]((cost[n] - low) / max(high - low, 1e-6)) if feasible else (0.25, 0.25, 0.25, 0.6)
        left.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.8 if feasible else 1.0)
    path = refined.rollout.position[0].numpy()
    left.plot(path[:, 0], path[:, 1], color="white", linewidth=4.0)
    label = f"best fast candidate, refined: cost {refinement.cost_before:.2f} → {refinement.cost:.2f}"
    left.plot(path[:, 0], path[:, 1], color="#1454c8", linewidth=2.5, label=label)
    for step in range(100, len(path), 100):
        circle = np.linspace(0, 2 * np.pi, 60)
        radius = uncertainty.radius[step]
        left.plot(path[step, 0] + radius * np.cos(circle), path[step, 1] + radius * np.sin(circle),
                  color="#1454c8", linewidth=1.2, linestyle="--",
                  label="contains 90 % of the outcomes" if step == 100 else None)  # fmt: skip
    left.set(xlim=(-1.5, 6.0), ylim=(-4.2, 4.2), aspect="equal", xlabel="forward x [m]", ylabel="left y [m]")
    left.set_title("candidates: green low cost, red high cost, grey infeasible")
    left.legend(loc="lower left", fontsize=8)
    grid = occupancy(terrain, np.eye(4), slope_limit=0.5, step_limit=0.15)
    rows, columns = grid.data.shape
    extent = (grid.origin[0], grid.origin[0] + columns * grid.resolution,
              grid.origin[1], grid.origin[1] + rows * grid.resolution)  # fmt: skip
    values = np.where(grid.data < 0, np.nan, grid.data.astype(float))
    right.set_facecolor("#9aa7b5")
    right.imshow(values, origin="lower", extent=extent, cmap="gray_r", vmin=0, vmax=100)
    right.plot(path[:, 0], path[:, 1], color="#1454c8", linewidth=2.5)
    right.set(xlim=(-1.5, 6.0), ylim=(-4.2, 4.2), aspect="equal", xlabel="forward x [m]")
    right.set_title("occupancy for Nav2: black lethal, blue-grey unknown")
    return figure


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", nargs="?", type=Path, default=ROOT / "bags" / "demo", help="bag with lidar (demo bag)")
    parser.add_argument("--at", type=float, default=1.2, help="time in the bag [s] (%(default)s)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "candidates.png", help="PNG to write")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    draw(Recording.open(options.bag), options.at).savefig(options.out, dpi=110)
    print(options.out)


if __name__ == "__main__":
    main()
