"""Figures: a prediction in the camera image and from above, errors over the horizon, trajectories of a recording."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from monoforce_ros.bags import BagError, Recording, nearest_frame
from monoforce_ros.core import CameraModel, transform_points
from monoforce_ros.evaluation.overlay import SURFACE_COLOURS, draw_prediction
from monoforce_ros.evaluation.recording_evaluation import (
    CONFIRMED_PHYSICS,
    CONSTANT_VELOCITY,
    FLAT_PHYSICS,
    PHYSICS,
    RecordingEvaluation,
)
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.robots import RobotModel

COLOURS = {
    PHYSICS: "#0b84a5",
    CONFIRMED_PHYSICS: "#2e8b57",
    FLAT_PHYSICS: "#9b59b6",
    CONSTANT_VELOCITY: "#e08214",
    "measured": "#1a1a1a",
}
_PATH = "#ffb020"
_RECORDED_COMMANDS = "#5ad1ff"
_FORCE = "#e8285a"
_IMAGE_LIMIT = 0.2
"""Largest time between a prediction and the image that it is drawn into [s]."""

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
    """RGB ``[height, width, 3]``."""
    camera: CameraModel
    base_from_camera: np.ndarray
    """Pose of the camera on the robot ``[4, 4]``."""

    @classmethod
    def nearest(cls, recording: Recording, robot: RobotModel, stamp: int) -> CameraPicture | None:
        """The image nearest to a stamp [ns] of the camera that points most forward.

        None if no calibrated camera with a known pose points forward, or without a usable image within 0.2 s.
        """
        best: tuple[float, CameraPicture] | None = None
        for topic, camera in recording.cameras.items():
            frame = nearest_frame(recording.images[topic], stamp, limit=_IMAGE_LIMIT)
            if frame is None:
                continue
            try:
                pose = recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors, frame.stamp)
            except BagError:
                continue
            forward = float(pose[0, 2])
            if forward < 0.5 or (best is not None and forward <= best[0]):
                continue
            try:
                image = recording.image(frame)
                camera.check_image(image)
            except ValueError:
                continue
            best = forward, cls(image, camera, pose)
        return None if best is None else best[1]


def prediction_figure(
    view: PredictionView,
    robot: RobotModel,
    *,
    picture: CameraPicture | None = None,
    measured: np.ndarray | None = None,
    under_recorded_commands: np.ndarray | None = None,
    title: str = "",
) -> Figure:
    """The prediction in the camera image, next to its map from above.

    Args:
        view: the prediction to show.
        robot: the model that the prediction used.
        picture: the camera image of the same time, if there is one.
        measured: measured positions ``[n, 3]`` in the odometry frame [m].
        under_recorded_commands: positions ``[n, 3]`` in the terrain frame [m] that are predicted under the commands
            recorded afterwards; ``view`` is then a prediction under the command at its start.
        title: text above the figure.
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
        axes[0].set_title("camera: predicted ground, path and contact forces")
    _draw_map(axes[-1], view, robot, measured, under_recorded_commands, colour_range)
    if title:
        figure.suptitle(textwrap.fill(title, 140 if picture else 72), x=0.01, ha="left", fontsize=13, fontweight="bold")
    return figure


def _colour_range(view: PredictionView) -> tuple[float, float]:
    """Heights at the ends of the colour scale: it spans the ground near the path; trees may exceed it."""
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
    under_recorded_commands: np.ndarray | None,
    colour_range: tuple[float, float],
) -> None:
    terrain = view.terrain
    height = terrain.height.double().numpy()
    colours = matplotlib.colormaps[SURFACE_COLOURS]
    scaled = np.clip((height - colour_range[0]) / (colour_range[1] - colour_range[0]), 0, 1)
    shaded = LightSource(azdeg=315, altdeg=50).shade_rgb(
        colours(scaled)[..., :3], height, blend_mode="soft", dx=terrain.grid.resolution, dy=terrain.grid.resolution
    )
    # Unobserved cells are less saturated.
    observed = terrain.observed.numpy()[..., None]
    shaded = np.where(observed, shaded, 0.6 * shaded + 0.4 * shaded.mean(axis=2, keepdims=True))
    axes.imshow(np.clip(shaded, 0, 1), origin="lower", extent=terrain.grid.extent, interpolation="nearest")
    axes.contour(terrain.grid.x, terrain.grid.y, height, levels=12, colors="k", linewidths=0.4, alpha=0.35)
    to_terrain = np.linalg.inv(view.motion.odometry_from_terrain)
    if measured is not None and len(measured):
        track = transform_points(to_terrain, measured)
        axes.plot(track[:, 0], track[:, 1], color="white", linewidth=3.2, zorder=6.5)
        axes.plot(
            track[:, 0], track[:, 1], color="black", linewidth=1.8, linestyle=(0, (4, 2)), label="measured", zorder=7
        )
    label = "predicted" if under_recorded_commands is None else "predicted, command held"
    axes.plot(view.positions[:, 0], view.positions[:, 1], color=_PATH, linewidth=3.5, label=label, zorder=6)
    if under_recorded_commands is not None:
        label = "predicted, recorded commands"
        axes.plot(
            under_recorded_commands[:, 0],
            under_recorded_commands[:, 1],
            color=_RECORDED_COMMANDS,
            linewidth=3.5,
            label=label,
            zorder=6.2,
        )
    for second in range(int(view.times[-1] + 1e-6) + 1):
        index = int(np.argmin(np.abs(view.times - second)))
        _draw_robot(axes, robot, view.positions[index], view.rotations[index], filled=second == 0)
        if second:
            axes.annotate(
                f"{second} s",
                (view.positions[index, 0], view.positions[index, 1]),
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
    axes.set_title("top view: height, robot every second, contact forces")
    axes.legend(loc="upper left", framealpha=0.9)
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(*colour_range), colours)
    axes.figure.colorbar(scale, ax=axes, label="height relative to the robot's base [m]", shrink=0.8, pad=0.01)


def _draw_robot(axes: Axes, robot: RobotModel, position: np.ndarray, rotation: np.ndarray, *, filled: bool) -> None:
    low, high = (bound.double().numpy() for bound in robot.bounds)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    outline = position[:2] + corners @ rotation[:2, :2].T
    axes.add_patch(
        Polygon(outline, closed=True, fill=filled, facecolor=(1, 1, 1, 0.75), edgecolor="white", linewidth=1.4)
    )
    nose = position[:2] + rotation[:2, :2] @ np.array([high[0], 0.0])
    axes.plot(*np.stack([position[:2], nose]).T, color="white", linewidth=1.4)


_METRES_PER_WEIGHT = 4.0
"""Length of the arrow of a horizontal force of the robot's weight [m]: a twentieth of it, as in turns, is visible."""
_LONGEST_ARROW = 0.5
"""Longest arrow [m], about half of a robot, so that forces at the start do not hide the path."""


def _draw_forces(axes: Axes, view: PredictionView) -> None:
    """Loaded contact points, sized by the load, and the horizontal part of the forces as arrows."""
    forces = view.drawn_forces
    load = np.linalg.norm(forces, axis=1)
    arrows = forces[:, :2] * _METRES_PER_WEIGHT
    arrows *= np.minimum(1.0, _LONGEST_ARROW / np.maximum(np.linalg.norm(arrows, axis=1, keepdims=True), 1e-12))
    axes.scatter(
        view.contact_points[:, 0],
        view.contact_points[:, 1],
        s=260 * load,
        color=_FORCE,
        alpha=0.55,
        linewidths=0,
        zorder=4,
    )
    axes.scatter([], [], s=40, color=_FORCE, alpha=0.55, linewidths=0, label="contact force")
    axes.quiver(
        *view.contact_points[:, :2].T,
        *arrows.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=_FORCE,
        width=0.003,
        zorder=5,
    )


def error_figure(evaluation: RecordingEvaluation) -> Figure:
    """Position and rotation errors over the horizon: median and interquartile range of the windows, by method."""
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
    axes[0].set(
        title="position error Δx", xlabel="time since the start of the prediction [s]", ylabel="[m]", ylim=(0, None)
    )
    axes[1].set(
        title="rotation error ΔR", xlabel="time since the start of the prediction [s]", ylabel="[deg]", ylim=(0, None)
    )
    if axes[0].lines:
        axes[0].legend(frameon=False)
    for panel in axes:
        panel.grid(alpha=0.25)
        panel.set_xlim(0, evaluation.times[-1])
    return figure


def recording_figure(evaluation: RecordingEvaluation, track: np.ndarray, *, windows: int = 12) -> Figure:
    """Top view of the measured path with some of the predictions along it.

    Args:
        evaluation: the windows.
        track: measured positions of the whole recording ``[n, 3]`` [m].
        windows: largest number of windows to draw.
    """
    figure = Figure(figsize=(11, 5.5), layout="constrained", dpi=110)
    axes = figure.subplots()
    axes.plot(track[:, 0], track[:, 1], color=COLOURS["measured"], linewidth=2.5, label="measured", zorder=2)
    chosen = np.unique(np.linspace(0, len(evaluation.stamps) - 1, windows).astype(int))
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
    axes.set(title="predictions along the recording", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    axes.set_aspect("equal", adjustable="datalim")
    return figure
