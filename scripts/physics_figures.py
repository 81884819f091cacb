"""Draws the figure of docs/physics.md: scripts/run.sh python scripts/physics_figures.py"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.reporting import figure_png
from monoforce_ros.robots import load_robot, shipped_robots
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap


def robots(axes) -> None:
    """Side view of body points with the directions in which driven surfaces move."""
    for row, name in enumerate(shipped_robots()):
        robot = load_robot(name)
        left = robot.points[:, 1] >= 0
        points, tangents = robot.points[left].numpy(), robot.point_tangents[left].numpy()
        driven = np.linalg.norm(tangents, axis=1) > 0
        shift = np.array([0.0, -1.05 * row])
        axes.scatter(*(points[~driven][:, [0, 2]] + shift).T, s=3, color="#9aa5b1")
        axes.quiver(
            *(points[driven][:, [0, 2]] + shift).T, *tangents[driven][:, [0, 2]].T, color="#0b84a5", width=0.003
        )
        axes.text(-1.55, shift[1] + 0.1, name, fontweight="bold", ha="left")
    axes.set(title="body points and belts", aspect="equal", xlabel="x [m]", yticks=[], xlim=(-1.6, 1.2))


def friction(axes) -> None:
    """Friction divided by load, over slip."""
    slip = np.linspace(-0.4, 0.4, 400)
    for regularisation, colour in ((0.02, "#0b84a5"), (0.1, "#7fc4d6")):
        axes.plot(
            slip,
            -0.8 * slip / np.sqrt(slip**2 + regularisation**2),
            color=colour,
            label=f"coulomb, ε = {regularisation:g} m/s",
        )
    axes.plot(slip, 0.8 * (1 / (1 + np.exp(slip)) - 0.5), color="#e08214", label="sigmoid (paper)")
    axes.set(title="friction at μ = 0.8", xlabel="slip [m/s]", ylabel="force / load")
    axes.legend(frameon=False, fontsize=8)
    axes.grid(alpha=0.25)


def drop(axes) -> None:
    """A Husky dropped from 0.3 m onto ground of very different stiffness, with time steps of 10 ms."""
    robot = load_robot("husky")
    for stiffness, colour in ((2e5, "#7fc4d6"), (2e6, "#0b84a5"), (2e8, "#1a1a1a")):
        material = TerrainDefaults(stiffness=stiffness, damping=0.02 * stiffness)
        terrain = TerrainMap.flat(Grid.square(6.0), material=material)
        result = rollout(
            terrain,
            robot,
            torch.zeros(1, 120, 2),
            State.at_rest(robot.ground_clearance + 0.3),
            options=PhysicsOptions(),
        )
        axes.plot(result.times, result.position[0, :, 2], color=colour, label=f"{stiffness:.0e} N/m³")
    axes.axhline(robot.ground_clearance, color="#e08214", linewidth=0.8, linestyle="--", label="wheels at the surface")
    axes.set(title="dropped from 0.3 m, steps of 10 ms", xlabel="time [s]", ylabel="height of the base [m]")
    axes.legend(frameon=False, fontsize=8)
    axes.grid(alpha=0.25)


def main() -> None:
    figure = Figure(figsize=(14, 4.6), layout="constrained", dpi=110)
    axes = figure.subplots(1, 3, width_ratios=[0.9, 1, 1])
    robots(axes[0])
    friction(axes[1])
    drop(axes[2])
    out = Path(__file__).resolve().parent.parent / "docs" / "physics.png"
    out.write_bytes(figure_png(figure))
    print(out)


if __name__ == "__main__":
    main()
