"""Picture of a terrain fit: what was seen, what was felt, the difference, and how well it explains the drive."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from monoforce_ros.training.terrain_fit import TerrainFit

_DRIVEN, _PREDICTED, _SEEN, _FELT = "#1a1a1a", "#e8285a", "#4c8c4a", "#8a5a2b"


def fit_figure(fit: TerrainFit, title: str) -> Figure:
    """Four panels: H_g*, H_t*, their difference under the wheels, and heights along the drive."""
    terrain = fit.terrain
    seen, felt = terrain.geometric_height.numpy(), terrain.height.numpy()
    low, high = np.percentile(np.concatenate([seen.ravel(), felt.ravel()]), [2, 98])
    figure = Figure(figsize=(14.0, 8.2), layout="constrained", dpi=110)
    axes = figure.subplots(2, 2)
    path = fit.measured.reshape(-1, 3)
    heights = {"cmap": "terrain", "vmin": low, "vmax": max(high, low + 0.05)}
    for ax, values, name in (
        (axes[0, 0], seen, "what the lidar saw, H_g*"),
        (axes[0, 1], felt, "what carried the robot, H_t*"),
    ):
        image = _map(ax, fit, values, heights)
        ax.plot(path[:, 0], path[:, 1], color=_DRIVEN, lw=1.5)
        ax.set_title(name)
        figure.colorbar(image, ax=ax, shrink=0.85, label="height [m]")
    # A wall beside the track says nothing of the ground: the extremes do not set the colours.
    reach = max(0.05, float(np.percentile(np.abs((seen - felt)[fit.felt]), 95))) if fit.felt.any() else 0.05
    difference = np.where(fit.felt, seen - felt, np.nan)
    image = _map(axes[1, 0], fit, difference, {"cmap": "RdYlGn", "vmin": -reach, "vmax": reach})
    axes[1, 0].set_title("seen minus felt under the wheels (green: something soft)")
    figure.colorbar(image, ax=axes[1, 0], shrink=0.85, label="[m]")
    _profile(axes[1, 1], fit)
    figure.suptitle(
        f"{title}: height error after {fit.times[-1]:g} s {100 * np.median(fit.before):.1f} cm on what was seen, "
        f"{100 * np.median(fit.after):.1f} cm on what was fitted (medians)",
        fontweight="bold",
    )
    return figure


def _map(ax: Axes, fit: TerrainFit, values: np.ndarray, how: dict):
    extent = fit.terrain.grid.extent
    image = ax.imshow(values, origin="lower", extent=extent, interpolation="nearest", **how)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return image


def _profile(ax: Axes, fit: TerrainFit) -> None:
    """Heights below the robot and of the robot over the driven distance."""
    path = fit.measured.reshape(-1, 3)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    rows, columns, inside = fit.terrain.grid.cells(path[:, :2])
    for values, colour, name in (
        (fit.terrain.geometric_height.numpy(), _SEEN, "seen below the robot"),
        (fit.terrain.height.numpy(), _FELT, "fitted below the robot"),
    ):
        ax.plot(distance[inside], values[rows, columns][inside], color=colour, lw=1.6, label=name)
    ax.plot(distance, path[:, 2], color=_DRIVEN, lw=1.6, label="robot, measured")
    start = 0
    for chunk in range(len(fit.predicted)):
        stop = start + len(fit.times)
        label = "robot, predicted" if chunk == 0 else None
        ax.plot(distance[start:stop], fit.predicted[chunk, :, 2], color=_PREDICTED, lw=1.2, ls="--", label=label)
        start = stop
    ax.set_xlabel("driven distance [m]")
    ax.set_ylabel("height [m]")
    ax.set_title("along the drive")
    ax.legend(frameon=False, fontsize=9)
