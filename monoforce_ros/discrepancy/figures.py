"""Figures of a diagnosis: the gap before and after, when it arises, and the effects that were tried."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from monoforce_ros.discrepancy.diagnosis import Diagnosis

_BEFORE, _AFTER, _FLOOR = "#e08214", "#0b84a5", "#8a95a0"


def gap_figure(diagnosis: Diagnosis) -> Figure:
    """Median position and heading error at each horizon, before and after."""
    figure = Figure(figsize=(11.0, 3.8), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2)
    for ax, metric, name in ((axes[0], "position", "position error [m]"), (axes[1], "heading", "heading error [deg]")):
        rows = [row for key, row in diagnosis.gap.items() if key.startswith(metric)]
        at = np.arange(len(rows))
        ax.bar(at - 0.2, [row["before"] for row in rows], 0.38, color=_BEFORE, label="model as it was")
        if diagnosis.fitted:
            ax.bar(at + 0.2, [row["after"] for row in rows], 0.38, color=_AFTER, label="with what was found")
        if "along" in diagnosis.floor and len(rows) > 1:
            floor = (
                np.hypot(diagnosis.floor["along"]["value"], diagnosis.floor["across"]["value"])
                if metric == "position"
                else np.degrees(diagnosis.floor["heading"]["value"])
            )
            ax.plot(
                [at[1] - 0.45, at[1] + 0.45], [floor, floor], color=_FLOOR, lw=2, ls=":", label="noise of the poses"
            )
        ax.set_xticks(at, [f"{row['horizon_s']:g} s" for row in rows])
        ax.set_title(f"{name}, median over windows", loc="left", fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(frameon=False)
    return figure


def timeline_figure(diagnosis: Diagnosis) -> Figure:
    """Residuals at the end of each window over the drive."""
    details = diagnosis.details
    times = (details["starts"] - details["starts"][0]) * 1e-9
    figure = Figure(figsize=(11.0, 5.4), layout="constrained", dpi=110)
    axes = figure.subplots(3, 1, sharex=True)
    names = (("along [m]", 1.0), ("across [m]", 1.0), ("heading [deg]", 180 / np.pi))
    for axis, (ax, (name, factor)) in enumerate(zip(axes, names, strict=True)):
        band = 2 * factor * details["floor"][-1, axis]
        ax.axhspan(-band, band, color=_FLOOR, alpha=0.25, lw=0)
        ax.plot(times, factor * details["before"][:, -1, axis], color=_BEFORE, lw=1.4, label="model as it was")
        if "after" in details and len(details["after"]) == len(times):
            ax.plot(times, factor * details["after"][:, axis], color=_AFTER, lw=1.4, label="with what was found")
        ax.set_ylabel(name)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_title(
        "predicted minus measured after 2 s, by the start of the window (grey: twice the noise)",
        loc="left",
        fontweight="bold",
    )
    axes[0].legend(frameon=False, ncols=2)
    axes[-1].set_xlabel("time in the drive [s]")
    return figure


def candidates_figure(diagnosis: Diagnosis) -> Figure:
    """What each effect of the catalogue would gain on data that its fit did not see, in the first round."""
    rows = [row for row in diagnosis.candidates if row["round"] == 1][:12][::-1]
    figure = Figure(figsize=(11.0, 0.6 + 0.32 * max(3, len(rows))), layout="constrained", dpi=110)
    ax = figure.subplots()
    found = {effect["name"] for effect in diagnosis.effects}
    colours = [_AFTER if row["name"] in found else "#c9d3da" for row in rows]
    ax.barh([row["name"] for row in rows], [max(row["gain"], 0.0) for row in rows], color=colours)
    ax.set_xlabel("how much better unseen windows are predicted (robust loss)")
    ax.set_title("effects that were tried, one at a time", loc="left", fontweight="bold")
    ax.spines[["top", "right"]].set_visible(False)
    return figure
