"""Comparison of terrain sources, and its output as JSON, Markdown and an HTML page with a figure."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from matplotlib.figure import Figure

from monoforce_ros.evaluation.tables import Mean, SequenceErrors, System, mean_over, ratio_over
from monoforce_ros.reporting import card, definition_list, figure_png, page, picture_card, table

GROUNDS = {"rigid": "Rigid ground (as the paper's Table I)", "grass": "Tall grass (as the paper's Table II)"}


@dataclass(frozen=True)
class Metric:
    """An error that the tables list."""

    key: str
    """Field of :class:`SequenceErrors`."""
    symbol: str
    unit: str
    digits: int


METRICS = (Metric("position", "Δx", "m", 3), Metric("rotation", "ΔR", "deg", 2))
RATIOS = (("monoforce", "lss"), ("monoforce", "lidar"), ("monoforce", "no_geometric"), ("lss", "lidar"),
          ("monoforce_lidar", "lidar"), ("monoforce_lidar", "monoforce"))  # fmt: skip
_COLOURS = {"lidar": "#9b59b6", "lidar_network": "#c39bd3", "lss": "#e08214", "monoforce": "#0b84a5",
            "monoforce_lidar": "#2a9d5c", "no_geometric": "#7fb8c9",
            "flat": "#8a8f98", "constant": "#c4c8ce"}  # fmt: skip

Row = Mapping[str, SequenceErrors]
"""Errors of each system on one recording."""


@dataclass(frozen=True)
class GroundComparison:
    """Errors of all systems on the recordings of one kind of ground."""

    rows: tuple[Row, ...]
    means: Mapping[str, Mapping[str, Mean]]
    """By system and metric."""
    ratios: Mapping[tuple[str, str], Mapping[str, Mean]]
    """By pair of systems and metric."""

    @property
    def windows(self) -> int:
        """Number of compared windows."""
        return sum(next(iter(row.values())).windows for row in self.rows)

    def best(self, metric: Metric) -> str:
        """The system with the smallest mean error."""
        means = {key: entry[metric.key].value for key, entry in self.means.items()}
        return min(means, key=lambda key: means[key] if math.isfinite(means[key]) else math.inf)

    def as_json(self) -> dict[str, object]:
        """The entry of ``tables.json``."""
        return {
            "recordings": len(self.rows),
            "drives": len(self.rows),  # the former name of ``recordings``, kept for one release
            "windows": self.windows,
            "systems": {key: {m: asdict(mean) for m, mean in entry.items()} for key, entry in self.means.items()},
            "ratios": {
                " / ".join(pair): {m: asdict(ratio) for m, ratio in entry.items()}
                for pair, entry in self.ratios.items()
            },
            "sequences": [{key: asdict(errors) for key, errors in row.items()} for row in self.rows],
        }


def compare(rows: Sequence[Row], systems: Sequence[System]) -> GroundComparison:
    """Means and ratios, with intervals, over the recordings of one kind of ground."""
    present = [system.key for system in systems]
    values = {m.key: {key: [getattr(row[key], m.key) for row in rows] for key in present} for m in METRICS}
    return GroundComparison(
        tuple(rows),
        {key: {m.key: mean_over(values[m.key][key]) for m in METRICS} for key in present},
        {
            (one, other): {m.key: ratio_over(values[m.key][one], values[m.key][other]) for m in METRICS}
            for one, other in RATIOS
            if {one, other} <= set(present)
        },
    )


def markdown(comparisons: Mapping[str, GroundComparison], systems: Sequence[System]) -> str:
    """The tables as Markdown."""
    lines: list[str] = []
    titles = {s.key: s.title for s in systems}
    for ground, found in comparisons.items():
        lines += [f"**{GROUNDS[ground]}**: {len(found.rows)} recordings, {found.windows} windows of 5 s", ""]
        lines += ["| input | terrain | Δx [m] | ΔR [deg] |", "|---|---|---|---|"]
        for system in systems:
            cells = []
            for metric in METRICS:
                text = _interval(found.means[system.key][metric.key], metric.digits)
                cells.append(f"**{text}**" if found.best(metric) == system.key else text)
            lines.append(f"| {system.input} | {system.title} | {' | '.join(cells)} |")
        lines.append("")
        if found.ratios:
            lines += ["| ratio | Δx | ΔR |", "|---|---|---|"]
            for (one, other), ratio in found.ratios.items():
                cells = [_interval(ratio[metric.key], 2) for metric in METRICS]
                lines.append(f"| {titles[one]} / {titles[other]} | {' | '.join(cells)} |")
            lines.append("")
    return "\n".join(lines).rstrip()


def html_page(
    comparisons: Mapping[str, GroundComparison], systems: Sequence[System], bags: Mapping[str, Iterable[str]]
) -> str:
    """A self-contained HTML page.

    Args:
        comparisons: comparisons by kind of ground.
        systems: systems in the order of the tables.
        bags: names of the recordings by kind of ground.
    """
    body = [picture_card(figure_png(figure(comparisons, systems)), alt="errors by system")]
    head = ["terrain", *(f"{metric.symbol} [{metric.unit}]" for metric in METRICS)]
    for ground, found in comparisons.items():
        caption = f"{len(found.rows)} recordings that were not used for training, {found.windows} windows"
        body.append(card(table(head, _html_rows(found, systems)), heading=GROUNDS[ground], caption=caption))
    body.append(card(definition_list({ground: ", ".join(names) for ground, names in bags.items()}), heading="Bags"))
    return page(
        "Comparison of terrain sources",
        "".join(body),
        lead="The same physics on different terrain maps. Once per second the motion of the next 5 s was predicted "
        "with the recorded commands and compared with the measured motion, while the robot was on the map. "
        "Numbers are means over recordings with 95 % confidence intervals (recordings resampled). The smallest error "
        "is bold.",
    )


def _html_rows(found: GroundComparison, systems: Sequence[System]) -> Iterable[str]:
    titles = {s.key: html.escape(s.title) for s in systems}
    for system in systems:
        cells = "".join(
            f'<td class="{"best" if found.best(metric) == system.key else ""}">'
            f"{_html_interval(found.means[system.key][metric.key], metric.digits)}</td>"
            for metric in METRICS
        )
        yield f"<tr><td>{titles[system.key]}<br><small>{html.escape(system.input)}</small></td>{cells}</tr>"
    for (one, other), ratio in found.ratios.items():
        cells = "".join(f"<td>× {_html_interval(ratio[metric.key], 2)}</td>" for metric in METRICS)
        yield f"<tr><td><small>{titles[one]}, relative to {titles[other]}</small></td>{cells}</tr>"


def figure(comparisons: Mapping[str, GroundComparison], systems: Sequence[System]) -> Figure:
    """Errors of every system on every ground, with intervals, and each recording as a dot."""
    picture = Figure(figsize=(11.0, 2.0 + 0.42 * len(systems) * len(comparisons)), layout="constrained", dpi=110)
    axes = picture.subplots(len(comparisons), len(METRICS), squeeze=False)
    for row, (ground, found) in enumerate(comparisons.items()):
        for column, metric in enumerate(METRICS):
            ax = axes[row, column]
            for place, system in enumerate(systems):
                mean = found.means[system.key][metric.key]
                colour = _COLOURS.get(system.key, "#888888")
                ax.barh(place, mean.value, color=colour, alpha=0.85, height=0.62)
                ax.plot([mean.low, mean.high], [place, place], color="#1c2733", lw=1.6)
                dots = [getattr(errors[system.key], metric.key) for errors in found.rows]
                ax.scatter(dots, np.full(len(dots), place), s=9, color="white", edgecolor="#1c2733", lw=0.5, zorder=3)
                ax.text(mean.high, place - 0.36, f" {mean.value:.{metric.digits}f}", va="center", fontsize=8)
            ax.set_yticks(range(len(systems)), [s.title for s in systems] if column == 0 else [""] * len(systems))
            ax.invert_yaxis()
            ax.set_xlim(left=0.0)
            ax.set_title(f"{metric.symbol} [{metric.unit}], {ground}", fontsize=10)
    return picture


def _interval(mean: Mean, digits: int) -> str:
    return f"{mean.value:.{digits}f} ({mean.low:.{digits}f} – {mean.high:.{digits}f})"


def _html_interval(mean: Mean, digits: int) -> str:
    return f"{mean.value:.{digits}f}<br><small>{mean.low:.{digits}f} – {mean.high:.{digits}f}</small>"
