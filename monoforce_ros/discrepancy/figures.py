"""Figures of a diagnosis: errors by horizon, by regime, on the map and over time, paths, and tested effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc

from monoforce_ros.discrepancy.areas import Circle
from monoforce_ros.discrepancy.comparison import PathComparison, RegimeRow
from monoforce_ros.discrepancy.diagnosis import Details, Diagnosis

_BEFORE, _AFTER, _FLOOR, _MEASURED = "#e08214", "#0b84a5", "#8a95a0", "#20262b"
_PALE = "#c9d3da"
_NOMINAL, _WITH_EFFECTS = "nominal model", "with the added effects"


def gap_figure(diagnosis: Diagnosis) -> Figure:
    """Median position and heading error at each horizon, before and after, with the noise floor."""
    figure = Figure(figsize=(11.0, 3.8), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2)
    for ax, metric, name in ((axes[0], "position", "position error [m]"), (axes[1], "heading", "heading error [deg]")):
        rows = [row for key, row in diagnosis.gap.items() if key.startswith(metric)]
        at = np.arange(len(rows))
        ax.bar(at - 0.2, [row.before for row in rows], 0.38, color=_BEFORE, label=_NOMINAL)
        after = [row.after for row in rows if row.after is not None]
        if len(after) == len(rows):
            ax.bar(at + 0.2, after, 0.38, color=_AFTER, label=_WITH_EFFECTS)
        for place, row in enumerate(rows):
            label = "noise floor" if place == 0 else None
            ax.plot([place - 0.42, place + 0.42], 2 * [row.noise], color=_FLOOR, lw=2, ls=":", label=label)
        ax.set_xticks(at, [f"after {row.horizon:g} s" for row in rows])
        ax.set_title(f"{name}, median over windows", loc="left", fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(frameon=False)
    return figure


def paths_figure(paths: Sequence[PathComparison]) -> Figure:
    """Measured and predicted paths of 5 s, in the frame of their start."""
    figure = Figure(figsize=(11.0, 2.9 * -(-len(paths) // 3)), layout="constrained", dpi=110)
    axes = np.atleast_1d(figure.subplots(-(-len(paths) // 3), min(3, len(paths)))).ravel()
    for ax in axes[len(paths) :]:
        ax.set_axis_off()
    for ax, path in zip(axes, paths, strict=False):
        for places, colour, width, label in (
            (path.measured, _MEASURED, 3.0, "measured"),
            (path.before, _BEFORE, 1.8, _NOMINAL),
            (path.after, _AFTER, 1.8, _WITH_EFFECTS),
        ):
            if places is not None:
                points = np.vstack([np.zeros(2), places[:, :2]])
                ax.plot(points[:, 0], points[:, 1], color=colour, lw=width, label=label, solid_capstyle="round")
                ax.plot(*points[-1], "o", color=colour, ms=5)
        ax.plot(0, 0, "+", color=_MEASURED, ms=9, mew=1.5)
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.15)
        ax.set_title(f"from {path.start:.0f} s on", loc="left", fontsize=10)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False)
    axes[0].set_xlabel("ahead [m]", fontsize=9)
    axes[0].set_ylabel("to the left [m]", fontsize=9)
    return figure


def map_figure(details: Details) -> Figure:
    """The driven path, coloured by the position error of the predictions that start there."""
    compared = next(c for c in details.compared if c.horizon == min(2.0, details.compared[-1].horizon))
    data = compared.data
    places = np.stack(
        [
            np.interp(compared.starts * 1.0, data.motion.stamps * 1.0, data.motion.positions[:, axis])
            for axis in range(2)
        ],
        axis=1,
    )
    sets = [(_NOMINAL, compared.before)]
    if compared.after is not None:
        sets.append((_WITH_EFFECTS, compared.after))
    errors = [compared.errors("position", values) for _, values in sets]
    top = max(float(np.quantile(errors[0], 0.95)), 0.02)
    figure = Figure(figsize=(5.5 * len(sets) + (1.5 if len(sets) == 1 else 0.0), 4.2), layout="constrained", dpi=110)
    axes = np.atleast_1d(figure.subplots(1, len(sets), sharex=True, sharey=True))
    # Nobody knows how the robot came from one stretch to the next.
    tracks = [data.motion.positions[part, :2] for part in details.stretches or (slice(None),)]
    for ax, (name, _), error in zip(axes, sets, errors, strict=True):
        ax.add_collection(LineCollection(tracks, colors=_PALE, linewidths=1.2))
        points = ax.scatter(*places.T, c=error, cmap="inferno_r", vmin=0, vmax=top, s=46, edgecolors="white", lw=0.4)
        if details.area is not None and isinstance(details.area.place, Circle):
            circle = details.area.place
            ax.add_patch(
                Disc(
                    (circle.x, circle.y),
                    circle.radius,
                    facecolor="#0b84a51f",
                    edgecolor=_AFTER,
                    ls="--",
                    label=details.area_meaning,
                )
            )
            ax.legend(frameon=False, loc="best", fontsize=9)
        ax.set_aspect("equal", adjustable="box")
        ax.set_title(name, loc="left", fontweight="bold")
        ax.set_xlabel("x [m]")
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("y [m]")
    figure.colorbar(points, ax=list(axes), label=f"position error after {compared.horizon:g} s [m]", shrink=0.85)
    return figure


def regime_figure(regimes: Sequence[RegimeRow]) -> Figure:
    """Median errors after 2 s in each motion regime, before and after."""
    rows = list(regimes)[::-1]
    figure = Figure(figsize=(11.0, 0.9 + 0.36 * len(rows)), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2, sharey=True)
    at = np.arange(len(rows))
    errors = (
        ("position error [m]", [(row.position_before, row.position_after) for row in rows]),
        ("heading error [deg]", [(row.heading_before, row.heading_after) for row in rows]),
    )
    for ax, (name, values) in zip(axes, errors, strict=True):
        before = [value for value, _ in values]
        after = [value for _, value in values if value is not None]
        if len(after) == len(rows):
            ax.hlines(at, after, before, color=_PALE, lw=3)
            ax.plot(after, at, "o", color=_AFTER, ms=7, label=_WITH_EFFECTS)
        ax.plot(before, at, "o", color=_BEFORE, ms=7, label=_NOMINAL)
        ax.set_xlim(left=0)
        ax.set_title(f"{name} after 2 s", loc="left", fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="x", color="#eef1f3")
        ax.set_axisbelow(True)
    axes[0].set_yticks(at, [f"{row.regime} ({100 * row.share_of_time:.0f} %)" for row in rows])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside upper right", ncols=2, frameon=False)
    return figure


def timeline_figure(details: Details) -> Figure:
    """Residuals at the end of each window over the recording."""
    data = details.data
    # Of the recording: windows may begin later, where an effect does.
    origin = int(data.motion.stamps[0])
    times = (data.starts - origin) * 1e-9
    compared = next((c for c in details.compared if c.horizon == data.horizon), None)
    figure = Figure(figsize=(11.0, 6.4), layout="constrained", dpi=110)
    axes = figure.subplots(4, 1, sharex=True)
    names = (("along [m]", 1.0), ("across [m]", 1.0), ("heading [deg]", 180 / np.pi))
    for axis, (ax, (name, factor)) in enumerate(zip(axes, names, strict=False)):
        band = 2 * factor * details.floor[-1, axis]
        ax.axhspan(-band, band, color=_FLOOR, alpha=0.25, lw=0)
        ax.plot(*with_gaps(times, factor * details.before[:, -1, axis]), color=_BEFORE, lw=1.4, label=_NOMINAL)
        if compared is not None and compared.after is not None:
            starts = (compared.starts - origin) * 1e-9
            ax.plot(starts, factor * compared.after[:, axis], ".", color=_AFTER, ms=5, label=_WITH_EFFECTS)
        ax.set_ylabel(name)
    commanded = data.commands.sample(data.starts)
    axes[3].plot(*with_gaps(times, commanded[:, 0]), color=_MEASURED, lw=1.2, label="speed [m/s]")
    axes[3].plot(*with_gaps(times, commanded[:, 1]), color=_FLOOR, lw=1.2, label="yaw rate [rad/s]")
    axes[3].set_ylabel("commands")
    axes[3].legend(frameon=False, ncols=2)
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_title(
        f"predicted minus measured after {data.horizon:g} s, by start of the window (grey: twice the noise floor)",
        loc="left",
        fontweight="bold",
    )
    axes[0].legend(frameon=False, ncols=2)
    axes[-1].set_xlabel("time in the recording [s]")
    return figure


def with_gaps(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and values with a NaN in each gap, so that no line is drawn across it.

    A gap is a step of more than one and a half times the median step: a window is missing.
    """
    steps = np.diff(times)
    if not len(steps):
        return times, values
    at = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1
    return np.insert(times, at, np.nan), np.insert(values.astype(float), at, np.nan)


def candidates_figure(diagnosis: Diagnosis) -> Figure:
    """The gain of each effect of the catalogue alone, from the first round of the search."""
    rows = [row for row in diagnosis.candidates if row.round == 1][:12][::-1]
    figure = Figure(figsize=(11.0, 0.6 + 0.32 * max(3, len(rows))), layout="constrained", dpi=110)
    ax = figure.subplots()
    found = {effect.name for effect in diagnosis.effects}
    colours = [_AFTER if row.name in found else _PALE for row in rows]
    ax.barh([row.name for row in rows], [max(row.gain, 0.0) for row in rows], color=colours)
    ax.set_xlabel("reduction of the robust loss by this effect alone")
    ax.set_title("effects tested one at a time", loc="left", fontweight="bold")
    ax.spines[["top", "right"]].set_visible(False)
    return figure
