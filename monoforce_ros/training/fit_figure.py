"""Figure of a terrain fit: visible and fitted heights, their difference, and the predicted motion."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from monoforce_ros.training.terrain_fit import TerrainFit

_MEASURED, _PREDICTED, _VISIBLE, _FITTED = "#1a1a1a", "#e8285a", "#4c8c4a", "#8a5a2b"


def fit_figure(fit: TerrainFit, title: str) -> Figure:
    """Four panels: H_g*, H_t*, their difference on contact cells, and heights along the trajectory."""
    terrain = fit.terrain
    visible, fitted = terrain.geometric_height.numpy(), terrain.height.numpy()
    low, high = np.percentile(np.concatenate([visible.ravel(), fitted.ravel()]), [2, 98])
    figure = Figure(figsize=(14.0, 8.2), layout="constrained", dpi=110)
    axes = figure.subplots(2, 2)
    path = fit.measured.reshape(-1, 3)
    for ax, values, name in (
        (axes[0, 0], visible, "visible terrain (lidar), H_g*"),
        (axes[0, 1], fitted, "supporting terrain (fitted), H_t*"),
    ):
        image = _map(ax, fit, values, "terrain", low, max(high, low + 0.05))
        ax.plot(path[:, 0], path[:, 1], color=_MEASURED, lw=1.5)
        ax.set_title(name)
        figure.colorbar(image, ax=ax, shrink=0.85, label="height [m]")
    mask = fit.contact_mask
    # A percentile: a wall at the edge of the track must not set the colour scale.
    limit = max(0.05, float(np.percentile(np.abs((visible - fitted)[mask]), 95))) if mask.any() else 0.05
    image = _map(axes[1, 0], fit, np.where(mask, visible - fitted, np.nan), "RdYlGn", -limit, limit)
    axes[1, 0].set_title("H_g* − H_t* on contact cells (green: soft cover)")
    figure.colorbar(image, ax=axes[1, 0], shrink=0.85, label="[m]")
    _profile(axes[1, 1], fit)
    figure.suptitle(
        f"{title}: height error after {fit.times[-1]:g} s {100 * np.median(fit.before):.1f} cm on visible, "
        f"{100 * np.median(fit.after):.1f} cm on fitted terrain (medians)",
        fontweight="bold",
    )
    return figure


def _map(ax: Axes, fit: TerrainFit, values: np.ndarray, colours: str, low: float, high: float) -> AxesImage:
    extent = fit.terrain.grid.extent
    image = ax.imshow(values, origin="lower", extent=extent, interpolation="nearest", cmap=colours, vmin=low, vmax=high)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return image


def _profile(ax: Axes, fit: TerrainFit) -> None:
    """Heights of the terrain under the robot, and of the robot, over the driven distance."""
    path = fit.measured.reshape(-1, 3)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    rows, columns, inside = fit.terrain.grid.cells(path[:, :2])
    for values, colour, name in (
        (fit.terrain.geometric_height.numpy(), _VISIBLE, "visible terrain under the robot"),
        (fit.terrain.height.numpy(), _FITTED, "fitted terrain under the robot"),
    ):
        ax.plot(distance[inside], values[rows, columns][inside], color=colour, lw=1.6, label=name)
    ax.plot(distance, path[:, 2], color=_MEASURED, lw=1.6, label="robot, measured")
    start = 0
    for chunk in range(len(fit.predicted)):
        stop = start + len(fit.times)
        label = "robot, predicted" if chunk == 0 else None
        ax.plot(distance[start:stop], fit.predicted[chunk, :, 2], color=_PREDICTED, lw=1.2, ls="--", label=label)
        start = stop
    ax.set_xlabel("driven distance [m]")
    ax.set_ylabel("height [m]")
    ax.set_title("along the trajectory")
    ax.legend(frameon=False, fontsize=9)
