"""How a comparison of terrain sources is shown: JSON, Markdown, and a page with a figure."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
from matplotlib.figure import Figure

from monoforce_ros.evaluation.tables import SequenceErrors, System, mean_over, ratio_over
from monoforce_ros.reporting import PAGE_STYLE, figure_png

GROUNDS = {"rigid": "Rigid ground (as the paper's Table I)", "grass": "Tall grass (as the paper's Table II)"}
METRICS = {"position": ("Δx", "m", 3), "rotation": ("ΔR", "deg", 2)}
RATIOS = (("monoforce", "lss"), ("monoforce", "lidar"), ("monoforce", "no_geometric"), ("lss", "lidar"),
          ("monoforce_lidar", "lidar"), ("monoforce_lidar", "monoforce"))  # fmt: skip
_COLOURS = {"lidar": "#9b59b6", "lidar_network": "#c39bd3", "lss": "#e08214", "monoforce": "#0b84a5",
            "monoforce_lidar": "#2a9d5c", "no_geometric": "#7fb8c9",
            "flat": "#8a8f98", "constant": "#c4c8ce"}  # fmt: skip


def comparison(rows: Mapping[str, Sequence[Mapping[str, SequenceErrors]]], systems: Sequence[System]) -> dict:
    """Means, intervals and ratios of every ground, and every drive's own errors."""
    found: dict = {}
    for ground, listed in rows.items():
        values = {
            metric: {s.key: [getattr(row[s.key], metric) for row in listed] for s in systems} for metric in METRICS
        }
        present = {s.key for s in systems}
        found[ground] = {
            "drives": len(listed),
            "windows": sum(next(iter(row.values())).windows for row in listed),
            "systems": {s.key: {m: asdict(mean_over(values[m][s.key])) for m in METRICS} for s in systems},
            "ratios": {
                f"{one} / {other}": {m: asdict(ratio_over(values[m][one], values[m][other])) for m in METRICS}
                for one, other in RATIOS
                if {one, other} <= present
            },
            "sequences": [{key: asdict(errors) for key, errors in row.items()} for row in listed],
        }
    return found


def markdown(found: Mapping, systems: Sequence[System]) -> str:
    """The tables as Markdown."""
    lines: list[str] = []
    titles = {s.key: s.title for s in systems}
    for ground, entry in found.items():
        lines += [f"**{GROUNDS[ground]}**: {entry['drives']} drives, {entry['windows']} windows of 5 s", ""]
        lines += ["| input | terrain | Δx [m] | ΔR [deg] |", "|---|---|---|---|"]
        best = {m: min(systems, key=lambda s, m=m: _or_inf(entry["systems"][s.key][m]["value"])).key for m in METRICS}
        for system in systems:
            cells = []
            for metric, (_, _, digits) in METRICS.items():
                text = _interval(entry["systems"][system.key][metric], digits)
                cells.append(f"**{text}**" if best[metric] == system.key else text)
            lines.append(f"| {system.input} | {system.title} | {' | '.join(cells)} |")
        lines.append("")
        if entry["ratios"]:
            lines += ["| ratio | Δx | ΔR |", "|---|---|---|"]
            for name, ratio in entry["ratios"].items():
                one, other = (titles[key] for key in name.split(" / "))
                lines.append(f"| {one} / {other} | {' | '.join(_interval(ratio[m], 2) for m in METRICS)} |")
            lines.append("")
    return "\n".join(lines).rstrip()


def page(found: Mapping, systems: Sequence[System], bags: Mapping[str, Sequence[str]]) -> str:
    """A self-contained HTML page."""
    picture = base64.b64encode(figure_png(figure(found, systems))).decode()
    cards = ""
    titles = {s.key: s.title for s in systems}
    for ground, entry in found.items():
        rows = ""
        best = {m: min(systems, key=lambda s, m=m: _or_inf(entry["systems"][s.key][m]["value"])).key for m in METRICS}
        for system in systems:
            errors = entry["systems"][system.key]
            cells = "".join(
                f'<td class="{"best" if best[m] == system.key else ""}">{_html(errors[m], digits)}</td>'
                for m, (_, _, digits) in METRICS.items()
            )
            said = f"{html.escape(system.title)}<br><small>{html.escape(system.input)}</small>"
            rows += f"<tr><td>{said}</td>{cells}</tr>"
        for name, ratio in entry["ratios"].items():
            one, other = (titles[key] for key in name.split(" / "))
            cells = "".join(f"<td>× {_html(ratio[m], 2)}</td>" for m in METRICS)
            rows += f"<tr><td><small>{html.escape(one)}, relative to {html.escape(other)}</small></td>{cells}</tr>"
        cards += (
            f'<section class="card"><h2 style="margin-top:0">{GROUNDS[ground]}</h2><p class="muted">{entry["drives"]} '
            f"drives that no training saw, {entry['windows']} windows</p><table><tr><th>terrain</th><th>Δx [m]</th>"
            f"<th>ΔR [deg]</th></tr>{rows}</table></section>"
        )
    listed = "".join(f"<dt>{g}</dt><dd>{html.escape(', '.join(names))}</dd>" for g, names in bags.items())
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Terrain sources compared</title><style>{PAGE_STYLE}</style></head><body><main>"
        "<h1>Terrain sources compared</h1>"
        '<p class="lead">The same physics on different maps of the ground. From a moment of each second the motion of '
        "the next 5 s was predicted with the commands that followed, and compared with what the robot did, as long as "
        "it was on the map. Numbers are means over drives with 95 % intervals (drives resampled); bold is the "
        "smallest error.</p>"
        f'<section class="card"><img alt="errors by system" src="data:image/png;base64,{picture}"></section>{cards}'
        f'<section class="card"><h2 style="margin-top:0">Drives</h2><dl>{listed}</dl></section></main></body></html>'
    )


def figure(found: Mapping, systems: Sequence[System]) -> Figure:
    """Errors of every system on every ground, with intervals and each drive as a dot."""
    picture = Figure(figsize=(11.0, 2.0 + 0.42 * len(systems) * len(found)), layout="constrained", dpi=110)
    axes = picture.subplots(len(found), len(METRICS), squeeze=False)
    for row, (ground, entry) in enumerate(found.items()):
        for column, (metric, (symbol, unit, digits)) in enumerate(METRICS.items()):
            ax = axes[row, column]
            for place, system in enumerate(systems):
                mean = entry["systems"][system.key][metric]
                colour = _COLOURS.get(system.key, "#888888")
                ax.barh(place, mean["value"], color=colour, alpha=0.85, height=0.62)
                ax.plot([mean["low"], mean["high"]], [place, place], color="#1c2733", lw=1.6)
                dots = [entry["sequences"][i][system.key][metric] for i in range(entry["drives"])]
                ax.scatter(dots, np.full(len(dots), place), s=9, color="white", edgecolor="#1c2733", lw=0.5, zorder=3)
                ax.text(mean["high"], place - 0.36, f" {mean['value']:.{digits}f}", va="center", fontsize=8)
            ax.set_yticks(range(len(systems)), [s.title for s in systems] if column == 0 else [""] * len(systems))
            ax.invert_yaxis()
            ax.set_xlim(left=0.0)
            ax.set_title(f"{symbol} [{unit}], {ground}", fontsize=10)
    return picture


def _or_inf(value: float) -> float:
    return value if math.isfinite(value) else math.inf


def _interval(entry: Mapping[str, float], digits: int) -> str:
    return f"{entry['value']:.{digits}f} ({entry['low']:.{digits}f} – {entry['high']:.{digits}f})"


def _html(entry: Mapping[str, float], digits: int) -> str:
    return f"{entry['value']:.{digits}f}<br><small>{entry['low']:.{digits}f} – {entry['high']:.{digits}f}</small>"
