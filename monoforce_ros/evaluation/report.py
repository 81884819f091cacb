"""Reports of an evaluation: JSON for programs, a self-contained HTML page, and a table for the terminal."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from monoforce_ros.core import write_text
from monoforce_ros.evaluation.metrics import Summary
from monoforce_ros.evaluation.recording_evaluation import RecordingEvaluation
from monoforce_ros.reporting import card, definition_list, folded_list, page, picture_card, table

_REMARKS = 50
"""Largest number of remarks on a page."""


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    heading: str
    caption: str
    png: bytes


def summary_table(evaluation: RecordingEvaluation) -> dict[str, dict[float, tuple[Summary, Summary]]]:
    """Summary of every method at every horizon."""
    return {method: evaluation.summary(method) for method in evaluation.predicted}


def terminal_table(evaluation: RecordingEvaluation) -> str:
    """A short table of median errors at the horizons."""
    heads = [f"Δx {h:g} s [m]" for h in evaluation.horizons] + [f"ΔR {h:g} s [deg]" for h in evaluation.horizons]
    width = max(len(method) for method in evaluation.predicted) + 2
    lines = [" " * width + "".join(f"{head:>14}" for head in heads)]
    summaries = summary_table(evaluation)
    for method, rows in summaries.items():
        cells = [f"{rows[h][part].median:14.3f}" for part in (0, 1) for h in evaluation.horizons]
        lines.append(f"{method:<{width}}" + "".join(cells))
    first = next(iter(summaries.values()))
    counts = ", ".join(f"{first[h][0].windows} at {h:g} s" for h in evaluation.horizons)
    lines.append(f"medians over windows ({counts})")
    return "\n".join(lines)


def report_content(evaluation: RecordingEvaluation, settings: Mapping[str, object]) -> dict[str, object]:
    """The content of ``report.json``; numbers that are not finite become null."""
    methods = {
        method: {
            f"{horizon:g}": {
                "position_error_m": _numbers(asdict(position)),
                "rotation_error_deg": _numbers(asdict(rotation)),
            }
            for horizon, (position, rotation) in rows.items()
        }
        for method, rows in summary_table(evaluation).items()
    }
    return {
        "settings": dict(settings),
        "horizons_s": list(evaluation.horizons),
        "windows": len(evaluation.stamps),
        "methods": methods,
        "remarks": list(evaluation.remarks),
    }


def _numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def write_reports(
    folder: Path, evaluation: RecordingEvaluation, settings: Mapping[str, object], pictures: Sequence[Picture]
) -> tuple[Path, Path]:
    """Write ``report.json`` and ``report.html``.

    Args:
        folder: output folder.
        evaluation: the results.
        settings: the inputs and options of the evaluation.
        pictures: figures of the page, in this order.

    Returns:
        the paths of the JSON and the HTML file.
    """
    content = report_content(evaluation, settings)
    write_text(folder / "report.json", json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))
    write_text(folder / "report.html", _page(evaluation, settings, pictures))
    return folder / "report.json", folder / "report.html"


def _page(evaluation: RecordingEvaluation, settings: Mapping[str, object], pictures: Sequence[Picture]) -> str:
    remarks = folded_list(f"{len(evaluation.remarks)} remarks", evaluation.remarks[:_REMARKS])
    body = [
        card(_error_table(evaluation)),
        *(
            picture_card(entry.png, alt=entry.heading, heading=entry.heading, caption=entry.caption)
            for entry in pictures
        ),
        card(definition_list(settings) + remarks, heading="Settings"),
    ]
    return page(
        f"Evaluation of {settings.get('bag', 'a recording')}",
        "".join(body),
        heading="Predicted and measured motion",
        lead="Predictions start at many times of the recording, use the commands recorded afterwards, and are compared "
        "with the measured motion. A trajectory counts while it is on the predicted map. The smallest error is "
        "bold.",
    )


def _error_table(evaluation: RecordingEvaluation) -> str:
    rows = summary_table(evaluation)
    columns = [(part, h) for part in (0, 1) for h in evaluation.horizons]
    best: dict[tuple[int, float], str] = {}
    for part, horizon in columns:
        means = {method: row[horizon][part].mean for method, row in rows.items()}
        finite = {method: mean for method, mean in means.items() if math.isfinite(mean)}
        if finite:
            best[part, horizon] = min(finite, key=finite.__getitem__)
    head = [f"{('Δx [m]', 'ΔR [°]')[part]}<br>at {h:g} s" for part, h in columns]
    body = []
    for method, row in rows.items():
        cells = ""
        for part, horizon in columns:
            text = _mean_cell(row[horizon][part], digits=3 if part == 0 else 2)
            cells += f'<td class="{"best" if best.get((part, horizon)) == method else ""}">{text}</td>'
        body.append(f"<tr><td>{html.escape(method)}</td>{cells}</tr>")
    first = next(iter(rows.values()))
    counts = "".join(f"<td><small>{first[h][part].windows} windows</small></td>" for part, h in columns)
    body.append(f"<tr><td><small>number of windows</small></td>{counts}</tr>")
    return table(["method", *head], body) + (
        '<p class="muted">Mean error over windows, and below it the 95 % confidence interval of the mean (block '
        "bootstrap, because consecutive windows overlap).</p>"
    )


def _mean_cell(entry: Summary, *, digits: int) -> str:
    if not entry.windows:
        return "–"
    return f"{entry.mean:.{digits}f}<br><small>{entry.low:.{digits}f} – {entry.high:.{digits}f}</small>"
