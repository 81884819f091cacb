"""Figures: a prediction seen from the camera and from above, errors over the horizon, and a drive's trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from monoforce_ros.core import CameraModel, transform_points
from monoforce_ros.evaluation.overlay import SURFACE_COLOURS, draw_prediction
from monoforce_ros.evaluation.recording_evaluation import CONSTANT_VELOCITY, FLAT_PHYSICS, PHYSICS, RecordingEvaluation
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.robots import RobotModel

COLOURS = {PHYSICS: "#0b84a5", FLAT_PHYSICS: "#9b59b6", CONSTANT_VELOCITY: "#e08214", "measured": "#1a1a1a"}
_PATH = "#ffb020"
_STEERED = "#5ad1ff"
_FORCE = "#e8285a"

matplotlib.rcParams.update(
    {
        "font.family": "sans-serif",
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
    }
)


@dataclass(frozen=True)
class CameraPicture:
    """A camera image to draw a prediction into."""

    image: np.ndarray
    camera: CameraModel
    base_from_camera: np.ndarray


def prediction_figure(
    view: PredictionView,
    robot: RobotModel,
    *,
    picture: CameraPicture | None = None,
    measured: np.ndarray | None = None,
    as_steered: np.ndarray | None = None,
    title: str = "",
) -> Figure:
    """The prediction in the camera image beside its map from above.

    Args:
        view: the prediction to show.
        robot: whose prediction it is.
        picture: the camera image of the same moment, if there is one.
        measured: where the robot went, ``[n, 3]`` in the odometry frame [m].
        as_steered: where it is predicted to go under the commands that followed, ``[n, 3]`` in the terrain frame [m];
            the prediction itself then holds the command of its start.
        title: a line above the figure.
    """
    colour_range = _colour_range(view)
    figure = Figure(figsize=(15.5 if picture else 8.0, 6.4), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2 if picture else 1, width_ratios=[1.18, 1] if picture else None, squeeze=False)[0]
    if picture:
        drawn = draw_prediction(
            picture.image,
            picture.camera,
            picture.base_from_camera,
            view,
            robot,
            colour_range=colour_range,
        )
        axes[0].imshow(drawn, interpolation="lanczos")
        axes[0].set_axis_off()
        axes[0].set_title("from the camera: predicted ground, path and contact forces")
    _draw_map(axes[-1], view, robot, measured, as_steered, colour_range)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold")
    return figure


def _colour_range(view: PredictionView) -> tuple[float, float]:
    """Heights for the ends of the colour scale: what lies around the path fills it, trees may exceed it."""
    x, y = np.meshgrid(view.terrain.grid.x, view.terrain.grid.y)
    offsets = np.stack([x, y], axis=-1)[None] - view.positions[:: max(1, len(view.positions) // 10), None, None, :2]
    near = np.linalg.norm(offsets, axis=-1).min(axis=0) < 3.0
    low, high = np.percentile(view.terrain.height.numpy()[near], [1, 97])
    middle, half = (low + high) / 2, max((high - low) / 2, 0.25)
    return float(middle - 1.1 * half), float(middle + 1.1 * half)


def _draw_map(
    axes: Axes,
    view: PredictionView,
    robot: RobotModel,
    measured: np.ndarray | None,
    as_steered: np.ndarray | None,
    colour_range: tuple[float, float],
) -> None:
    terrain = view.terrain
    height = terrain.height.double().numpy()
    colours = matplotlib.colormaps[SURFACE_COLOURS]
    scaled = np.clip((height - colour_range[0]) / (colour_range[1] - colour_range[0]), 0, 1)
    shaded = LightSource(azdeg=315, altdeg=50).shade_rgb(
        colours(scaled)[..., :3], height, blend_mode="soft", dx=terrain.grid.resolution, dy=terrain.grid.resolution
    )
    # What no sensor saw is greyer.
    seen = terrain.observed.numpy()[..., None]
    shaded = np.where(seen, shaded, 0.6 * shaded + 0.4 * shaded.mean(axis=2, keepdims=True))
    axes.imshow(np.clip(shaded, 0, 1), origin="lower", extent=terrain.grid.extent, interpolation="nearest")
    axes.contour(terrain.grid.x, terrain.grid.y, height, levels=12, colors="k", linewidths=0.4, alpha=0.35)
    to_terrain = np.linalg.inv(view.motion.odometry_from_terrain)
    if measured is not None and len(measured):
        track = transform_points(to_terrain, measured)
        axes.plot(track[:, 0], track[:, 1], color="white", linewidth=3.2, zorder=6.5)
        axes.plot(
            track[:, 0], track[:, 1], color="black", linewidth=1.8, linestyle=(0, (4, 2)), label="measured", zorder=7
        )
    label = "predicted" if as_steered is None else "predicted, the command held"
    axes.plot(view.positions[:, 0], view.positions[:, 1], color=_PATH, linewidth=3.5, label=label, zorder=6)
    if as_steered is not None:
        label = "predicted, as steered later"
        axes.plot(as_steered[:, 0], as_steered[:, 1], color=_STEERED, linewidth=3.5, label=label, zorder=6.2)
    for second in range(int(view.times[-1] + 1e-6) + 1):
        index = int(np.argmin(np.abs(view.times - second)))
        _draw_robot(axes, robot, view.positions[index], view.rotations[index], filled=second == 0)
        if second:
            axes.annotate(
                f"{second} s",
                view.positions[index, :2],
                xytext=(9, 9),
                textcoords="offset points",
                fontsize=9,
                fontweight="bold",
                color="white",
                path_effects=[withStroke(linewidth=2.5, foreground="black")],
                zorder=8,
            )
    _draw_forces(axes, view)
    axes.set(xlabel="forward x [m]", ylabel="left y [m]", aspect="equal")
    axes.set_xlim(terrain.grid.extent[:2])
    axes.set_ylim(terrain.grid.extent[2:])
    axes.set_title("from above: height, robot each second, ground forces")
    axes.legend(loc="upper left", framealpha=0.9)
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(*colour_range), colours)
    axes.figure.colorbar(scale, ax=axes, label="height over the robot's base [m]", shrink=0.8, pad=0.01)


def _draw_robot(axes: Axes, robot: RobotModel, position: np.ndarray, rotation: np.ndarray, *, filled: bool) -> None:
    low, high = (bound.double().numpy() for bound in robot.bounds)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    outline = position[:2] + corners @ rotation[:2, :2].T
    axes.add_patch(
        Polygon(outline, closed=True, fill=filled, facecolor=(1, 1, 1, 0.75), edgecolor="white", linewidth=1.4)
    )
    nose = position[:2] + rotation[:2, :2] @ np.array([high[0], 0.0])
    axes.plot(*np.stack([position[:2], nose]).T, color="white", linewidth=1.4)


def _draw_forces(axes: Axes, view: PredictionView) -> None:
    """Points that carry load, sized by it, and the horizontal part of the forces as arrows."""
    load = np.linalg.norm(view.contact_forces, axis=1)
    axes.scatter(
        *view.contact_points[:, :2].T,
        s=260 * load,
        color=_FORCE,
        alpha=0.55,
        linewidths=0,
        zorder=4,
        label="load on the ground",
    )
    axes.quiver(
        *view.contact_points[:, :2].T,
        *(view.contact_forces[:, :2] * 4.0).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=_FORCE,
        width=0.003,
        zorder=5,
    )


def error_figure(evaluation: RecordingEvaluation) -> Figure:
    """Position and rotation error against the horizon: median and middle half of the windows, per method."""
    figure = Figure(figsize=(11, 3.8), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2)
    for method in evaluation.predicted:
        usable = np.logical_and.accumulate(evaluation.inside, axis=1)
        for panel, errors in zip(axes, evaluation.errors(method), strict=True):
            values = np.where(usable, errors, np.nan)
            counted = np.isfinite(values).any(axis=0)
            if not counted.any():
                continue
            low, middle, high = np.nanquantile(values[:, counted], [0.25, 0.5, 0.75], axis=0)
            times = evaluation.times[counted]
            panel.plot(times, middle, color=COLOURS[method], linewidth=2.2, label=method)
            panel.fill_between(times, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
    axes[0].set(title="position error Δx", xlabel="time since the prediction [s]", ylabel="[m]", ylim=(0, None))
    axes[1].set(title="rotation error ΔR", xlabel="time since the prediction [s]", ylabel="[deg]", ylim=(0, None))
    if axes[0].lines:
        axes[0].legend(frameon=False)
    for panel in axes:
        panel.grid(alpha=0.25)
        panel.set_xlim(0, evaluation.times[-1])
    return figure


def drive_figure(evaluation: RecordingEvaluation, track: np.ndarray, *, most: int = 12) -> Figure:
    """The measured drive from above with some of the predictions that were made along it.

    Args:
        evaluation: the windows.
        track: measured positions of the whole drive ``[n, 3]`` [m].
        most: number of windows to draw.
    """
    figure = Figure(figsize=(11, 5.5), layout="constrained", dpi=110)
    axes = figure.subplots()
    axes.plot(track[:, 0], track[:, 1], color=COLOURS["measured"], linewidth=2.5, label="measured", zorder=2)
    chosen = np.unique(np.linspace(0, len(evaluation.stamps) - 1, most).astype(int))
    for number, window in enumerate(chosen):
        for method, style in ((CONSTANT_VELOCITY, ":"), (PHYSICS, "-")):
            positions = evaluation.predicted[method].positions[window]
            axes.plot(
                *positions[:, :2].T,
                color=COLOURS[method],
                linewidth=1.6,
                linestyle=style,
                label=method if number == 0 else None,
                zorder=3,
            )
        axes.plot(*evaluation.predicted[PHYSICS].positions[window, 0, :2], "o", color="black", markersize=4, zorder=4)
    axes.set(title="predictions along the drive", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    axes.set_aspect("equal", adjustable="datalim")
    return figure
