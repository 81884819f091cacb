"""Compare the rollout with an independent engine: the same Husky, terrain and commands in both, for 5 s.

    scripts/run.sh python benchmarks/mujoco_check.py [--json FILE] [--figure FILE]

The ground is level, or gentle hills without obstacles. Friction and the effective track width are the same in all runs;
the track width is fitted to the first arc on level ground, because the two engines' tyres slip differently in turns.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from monoforce_ros.core import write_text
from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import Rollout, State, rollout
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import (
    TIME_STEP,
    Scenery,
    Simulation,
    TerrainSettings,
    Vehicle,
    build_model,
    build_scenery,
)
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

SECONDS = 5.0
STEP = 0.01
COMMANDS = {
    "straight, slow": (0.4, 0.0),
    "straight, fast": (0.9, 0.0),
    "arc to the left": (0.6, 0.4),
    "arc to the right": (0.6, -0.4),
    "wide arc": (0.8, 0.2),
    "backwards": (-0.5, 0.0),
}
FRICTION = 0.8


def bare_scenery(roughness: float, seed: int) -> Scenery:
    """Hills without obstacles; level ground if the roughness is 0."""
    return build_scenery(TerrainSettings(roughness=roughness, flat=roughness == 0.0, bare=True), seed)


def drive_in_mujoco(
    scenery: Scenery, twist: tuple[float, float], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions ``[T + 1, 3]``, rotations ``[T + 1, 3, 3]`` in the odom frame, and its origin in the world ``[3]``."""
    vehicle = Vehicle.load("husky")
    simulation = Simulation(build_model(scenery, vehicle, seed, {}), scenery, vehicle)
    simulation.drive(*twist)
    positions, rotations = [], []
    for _ in range(round(SECONDS / STEP) + 1):
        state = simulation.state()
        positions.append(state.position)
        rotations.append(state.rotation)
        for _ in range(round(STEP / TIME_STEP)):
            simulation.step()
    return np.array(positions), np.array(rotations), simulation.odom_origin


def drive_in_rollout(
    robot: RobotModel, scenery: Scenery, origin: np.ndarray, start: np.ndarray, twist: tuple
) -> Rollout:
    """The same commands in the rollout, on the heights of MuJoCo's ground."""
    grid = Grid.square(16.0, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    heights = scenery.ground.height_at(np.stack([x, y], axis=-1) + origin[:2]) - origin[2]
    terrain = TerrainMap.from_height(
        torch.from_numpy(heights.astype(np.float32)), grid, material=TerrainDefaults(friction=FRICTION)
    )
    state = dataclasses.replace(State.at_rest(0.0), rotation=torch.from_numpy(start.astype(np.float32))[None])
    twists = torch.tensor(twist).expand(1, round(SECONDS / STEP), 2)
    return rollout(terrain, robot, drive_speeds(robot, twists, STEP), state, with_forces=False)


def yaw_of(rotations: np.ndarray) -> float:
    """Change of heading over the run [rad]."""
    headings = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    return float(headings[-1] - headings[0])


def fitted_robot(seed: int) -> RobotModel:
    """The Husky with the effective track width that reproduces MuJoCo's yaw in an arc on level ground."""
    robot = load_robot("husky")
    scenery = bare_scenery(0.0, seed)
    _, rotations, origin = drive_in_mujoco(scenery, COMMANDS["arc to the left"], seed)
    target, low, high = yaw_of(rotations), 0.5, 2.0
    for _ in range(12):
        factor = (low + high) / 2
        trial = dataclasses.replace(robot, effects=(("turning_scrub", {"track_width_factor": factor}),))
        result = drive_in_rollout(trial, scenery, origin, rotations[0], COMMANDS["arc to the left"])
        low, high = (factor, high) if yaw_of(result.rotation[0].numpy()) > target else (low, factor)
    return trial


def compare(robot: RobotModel, roughness: float, seed: int, twist: tuple[float, float]) -> dict:
    """Errors after 5 s and the two trajectories."""
    scenery = bare_scenery(roughness, seed)
    positions, rotations, origin = drive_in_mujoco(scenery, twist, seed)
    result = drive_in_rollout(robot, scenery, origin, rotations[0], twist)
    predicted, turned = result.position[0].double().numpy(), result.rotation[0].double().numpy()
    angle = Rotation.from_matrix(turned[-1].T @ rotations[-1]).magnitude()
    return {
        "position_error_m": float(np.linalg.norm(predicted[-1] - positions[-1])),
        "rotation_error_deg": float(np.degrees(angle)),
        "yaw_error_deg": float(np.degrees(yaw_of(turned) - yaw_of(rotations))),
        "distance_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "mujoco": positions,
        "rollout": predicted,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--figure", type=Path, help="draw the trajectories into this PNG")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="seeds of the terrain (%(default)s)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    robot = fitted_robot(options.seeds[0])
    factor = robot.effects[0][1]["track_width_factor"]
    print(f"same in all runs: friction {FRICTION}, effective track width × {factor:.2f}\n")
    print("| ground | commands | Δx at 5 s [m] | ΔR at 5 s [deg] | Δyaw at 5 s [deg] |\n|---|---|---|---|---|")
    rows, figure = [], Figure(figsize=(9, 5), layout="constrained", dpi=110)
    axes = figure.subplots()
    for roughness, ground in ((0.0, "level"), (0.4, "gentle")):
        for seed in options.seeds[: 1 if roughness == 0.0 else None]:
            for name, twist in COMMANDS.items():
                row = compare(robot, roughness, seed, twist)
                label = {"label": ("MuJoCo", "rollout")} if not rows else {"label": (None, None)}
                axes.plot(*row.pop("mujoco")[:, :2].T, color="#1a1a1a", linewidth=2.5, label=label["label"][0])
                axes.plot(*row.pop("rollout")[:, :2].T, color="#0b84a5", linewidth=1.4, label=label["label"][1])
                rows.append({"ground": ground, "seed": seed, "commands": name, **row})
                print(
                    f"| {ground} {seed if roughness else ''} | {name} | {row['position_error_m']:.3f} | "
                    f"{row['rotation_error_deg']:.1f} | {row['yaw_error_deg']:+.1f} |",
                    flush=True,
                )
    worst = max(rows, key=lambda r: r["position_error_m"])
    medians = [float(np.median([r[k] for r in rows])) for k in ("position_error_m", "rotation_error_deg")]
    print(f"\nmedian Δx {medians[0]:.3f} m, ΔR {medians[1]:.1f}°; largest Δx {worst['position_error_m']:.3f} m")
    if options.json:
        content = {"friction": FRICTION, "track_width_factor": factor, "rows": rows}
        write_text(options.json, json.dumps(content, indent=2))
    if options.figure:
        axes.set(xlabel="x [m]", ylabel="y [m]", title="the same commands in two engines, 5 s", aspect="equal")
        axes.legend(frameon=False)
        axes.grid(alpha=0.25)
        options.figure.write_bytes(figure_png(figure))


if __name__ == "__main__":
    main()
