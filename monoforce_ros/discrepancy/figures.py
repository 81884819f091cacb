"""Figures of a diagnosis: the gap, where and when it arises, paths, and the effects that were tried."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from monoforce_ros.discrepancy.diagnosis import Diagnosis

_BEFORE, _AFTER, _FLOOR, _MEASURED = "#e08214", "#0b84a5", "#8a95a0", "#20262b"
_UNTRIED = "#c9d3da"


def gap_figure(diagnosis: Diagnosis) -> Figure:
    """Median position and heading error at each horizon, before and after, with what the noise alone leaves."""
    figure = Figure(figsize=(11.0, 3.8), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2)
    for ax, metric, name in ((axes[0], "position", "position error [m]"), (axes[1], "heading", "heading error [deg]")):
        rows = [row for key, row in diagnosis.gap.items() if key.startswith(metric)]
        at = np.arange(len(rows))
        ax.bar(at - 0.2, [row["before"] for row in rows], 0.38, color=_BEFORE, label="model as it was")
        if diagnosis.fitted:
            ax.bar(at + 0.2, [row["after"] for row in rows], 0.38, color=_AFTER, label="with what was found")
        for place, row in enumerate(rows):
            label = "noise of the poses" if place == 0 else None
            ax.plot([place - 0.42, place + 0.42], 2 * [row["noise"]], color=_FLOOR, lw=2, ls=":", label=label)
        ax.set_xticks(at, [f"after {row['horizon_s']:g} s" for row in rows])
        ax.set_title(f"{name}, median over windows", loc="left", fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(frameon=False)
    return figure


def paths_figure(diagnosis: Diagnosis) -> Figure:
    """Measured and predicted paths of 5 s, in the axes of their start."""
    shown = diagnosis.details["paths"]
    figure = Figure(figsize=(11.0, 2.9 * -(-len(shown) // 3)), layout="constrained", dpi=110)
    axes = np.atleast_1d(figure.subplots(-(-len(shown) // 3), min(3, len(shown)))).ravel()
    for ax in axes[len(shown) :]:
        ax.set_axis_off()
    for ax, path in zip(axes, shown, strict=False):
        for key, colour, width, label in (
            ("measured", _MEASURED, 3.0, "measured"),
            ("before", _BEFORE, 1.8, "model as it was"),
            ("after", _AFTER, 1.8, "with what was found"),
        ):
            if path[key] is not None:
                points = np.vstack([np.zeros(2), path[key][:, :2]])
                ax.plot(points[:, 0], points[:, 1], color=colour, lw=width, label=label, solid_capstyle="round")
                ax.plot(*points[-1], "o", color=colour, ms=5)
        ax.plot(0, 0, "+", color=_MEASURED, ms=9, mew=1.5)
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.15)
        ax.set_title(f"from {path['start_s']:.0f} s on", loc="left", fontsize=10)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False)
    axes[0].set_xlabel("ahead [m]", fontsize=9)
    axes[0].set_ylabel("to the left [m]", fontsize=9)
    return figure


def map_figure(diagnosis: Diagnosis) -> Figure:
    """The driven path, coloured by the position error of the predictions that start there."""
    details = diagnosis.details
    compared = next(c for c in details["compared"] if c.horizon == min(2.0, details["compared"][-1].horizon))
    data = compared.data
    places = np.stack(
        [
            np.interp(compared.starts * 1.0, data.motion.stamps * 1.0, data.motion.positions[:, axis])
            for axis in range(2)
        ],
        axis=1,
    )
    sets = [("model as it was", compared.before)]
    if compared.after is not None:
        sets.append(("with what was found", compared.after))
    errors = [compared.errors("position", values) for _, values in sets]
    top = max(float(np.quantile(errors[0], 0.95)), 0.02)
    figure = Figure(figsize=(11.0, 4.2), layout="constrained", dpi=110)
    axes = np.atleast_1d(figure.subplots(1, len(sets), sharex=True, sharey=True))
    track = data.motion.positions[:, :2]
    for ax, (name, _), error in zip(axes, sets, errors, strict=True):
        ax.add_collection(LineCollection([track], colors=_UNTRIED, linewidths=1.2))
        points = ax.scatter(*places.T, c=error, cmap="inferno_r", vmin=0, vmax=top, s=46, edgecolors="white", lw=0.4)
        ax.set_aspect("equal", adjustable="box")
        ax.set_title(name, loc="left", fontweight="bold")
        ax.set_xlabel("x [m]")
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("y [m]")
    figure.colorbar(points, ax=list(axes), label="position error after 2 s [m]", shrink=0.85)
    return figure


def regime_figure(diagnosis: Diagnosis) -> Figure:
    """Median errors after 2 s in each way of driving, before and after."""
    rows = list(diagnosis.regimes)[::-1]
    figure = Figure(figsize=(11.0, 0.9 + 0.36 * len(rows)), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2, sharey=True)
    at = np.arange(len(rows))
    for ax, metric, name in ((axes[0], "position", "position error [m]"), (axes[1], "heading", "heading error [deg]")):
        before, after = ([row[f"{metric}_{when}"] for row in rows] for when in ("before", "after"))
        if diagnosis.fitted:
            ax.hlines(at, after, before, color=_UNTRIED, lw=3)
            ax.plot(after, at, "o", color=_AFTER, ms=7, label="with what was found")
        ax.plot(before, at, "o", color=_BEFORE, ms=7, label="model as it was")
        ax.set_xlim(left=0)
        ax.set_title(f"{name} after 2 s", loc="left", fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="x", color="#eef1f3")
        ax.set_axisbelow(True)
    axes[0].set_yticks(at, [f"{row['regime']} ({100 * row['share_of_time']:.0f} %)" for row in rows])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside upper right", ncols=2, frameon=False)
    return figure


def timeline_figure(diagnosis: Diagnosis) -> Figure:
    """Residuals at the end of each window over the drive."""
    details = diagnosis.details
    data = details["data"]
    times = (details["starts"] - details["starts"][0]) * 1e-9
    compared = next((c for c in details["compared"] if c.horizon == data.horizon), None)
    figure = Figure(figsize=(11.0, 6.4), layout="constrained", dpi=110)
    axes = figure.subplots(4, 1, sharex=True)
    names = (("along [m]", 1.0), ("across [m]", 1.0), ("heading [deg]", 180 / np.pi))
    for axis, (ax, (name, factor)) in enumerate(zip(axes, names, strict=False)):
        band = 2 * factor * details["floor"][-1, axis]
        ax.axhspan(-band, band, color=_FLOOR, alpha=0.25, lw=0)
        ax.plot(times, factor * details["before"][:, -1, axis], color=_BEFORE, lw=1.4, label="model as it was")
        if compared is not None and compared.after is not None:
            own = (compared.starts - details["starts"][0]) * 1e-9
            ax.plot(own, factor * compared.after[:, axis], ".", color=_AFTER, ms=5, label="with what was found")
        ax.set_ylabel(name)
    told = data.commands.sample(details["starts"])
    axes[3].plot(times, told[:, 0], color=_MEASURED, lw=1.2, label="speed [m/s]")
    axes[3].plot(times, told[:, 1], color=_FLOOR, lw=1.2, label="yaw rate [rad/s]")
    axes[3].set_ylabel("commands")
    axes[3].legend(frameon=False, ncols=2)
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_title(
        f"predicted minus measured after {data.horizon:g} s, by the start of the window (grey: twice the noise)",
        loc="left",
        fontweight="bold",
    )
    axes[0].legend(frameon=False, ncols=2)
    axes[-1].set_xlabel("time in the drive [s]")
    return figure


def candidates_figure(diagnosis: Diagnosis) -> Figure:
    """What each effect of the catalogue would gain, in the first round."""
    rows = [row for row in diagnosis.candidates if row["round"] == 1][:12][::-1]
    figure = Figure(figsize=(11.0, 0.6 + 0.32 * max(3, len(rows))), layout="constrained", dpi=110)
    ax = figure.subplots()
    found = {effect["name"] for effect in diagnosis.effects}
    colours = [_AFTER if row["name"] in found else _UNTRIED for row in rows]
    ax.barh([row["name"] for row in rows], [max(row["gain"], 0.0) for row in rows], color=colours)
    ax.set_xlabel("how much better windows are predicted with it alone (robust loss)")
    ax.set_title("effects that were tried, one at a time", loc="left", fontweight="bold")
    ax.spines[["top", "right"]].set_visible(False)
    return figure
