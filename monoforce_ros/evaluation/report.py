"""Reports of an evaluation: JSON for programs, one self-contained HTML page for people, a table for the terminal."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from monoforce_ros.core import write_text
from monoforce_ros.evaluation.metrics import Summary
from monoforce_ros.evaluation.recording_evaluation import RecordingEvaluation
from monoforce_ros.reporting import PAGE_STYLE


def summary_table(evaluation: RecordingEvaluation) -> dict[str, dict[float, tuple[Summary, Summary]]]:
    """Summary of every method at every horizon."""
    return {method: evaluation.summary(method) for method in evaluation.predicted}


def terminal_table(evaluation: RecordingEvaluation) -> str:
    """A short table of median errors at the horizons."""
    heads = [f"Δx {h:g} s [m]" for h in evaluation.horizons] + [f"ΔR {h:g} s [deg]" for h in evaluation.horizons]
    width = max(len(method) for method in evaluation.predicted) + 2
    lines = [" " * width + "".join(f"{head:>14}" for head in heads)]
    for method, rows in summary_table(evaluation).items():
        cells = [f"{rows[h][part].median:14.3f}" for part in (0, 1) for h in evaluation.horizons]
        lines.append(f"{method:<{width}}" + "".join(cells))
    first = next(iter(summary_table(evaluation).values()))
    counts = ", ".join(f"{first[h][0].windows} at {h:g} s" for h in evaluation.horizons)
    lines.append(f"medians over windows ({counts})")
    return "\n".join(lines)


def report_content(evaluation: RecordingEvaluation, settings: dict[str, object]) -> dict[str, object]:
    """The content of ``report.json``; numbers that do not exist are null."""
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
        "settings": settings,
        "horizons_s": list(evaluation.horizons),
        "windows": len(evaluation.stamps),
        "methods": methods,
        "remarks": list(evaluation.remarks),
    }


def _numbers(values: dict) -> dict:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }


def write_reports(
    folder: Path,
    evaluation: RecordingEvaluation,
    settings: dict[str, object],
    figures: Sequence[tuple[str, str, bytes]],
) -> tuple[Path, Path]:
    """Write ``report.json`` and ``report.html``.

    Args:
        folder: where to.
        evaluation: what to report.
        settings: how it was made, for the record.
        figures: heading, caption and PNG of each picture.

    Returns:
        the paths of the JSON and the HTML.
    """
    content = report_content(evaluation, settings)
    write_text(folder / "report.json", json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))
    write_text(folder / "report.html", _page(evaluation, settings, figures))
    return folder / "report.json", folder / "report.html"


def _page(
    evaluation: RecordingEvaluation, settings: dict[str, object], figures: Sequence[tuple[str, str, bytes]]
) -> str:
    pictures = "".join(
        f'<section class="card"><h2 style="margin-top:0">{html.escape(heading)}</h2>'
        f'<p class="muted">{html.escape(caption)}</p>'
        f'<img alt="{html.escape(heading)}" src="data:image/png;base64,{base64.b64encode(png).decode()}"></section>'
        for heading, caption, png in figures
    )
    listed = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(str(v))}</dd>" for k, v in settings.items())
    remarks = "".join(f"<li>{html.escape(remark)}</li>" for remark in evaluation.remarks[:50])
    remarks = f"<details><summary>{len(evaluation.remarks)} remarks</summary><ul>{remarks}</ul></details>" * bool(
        remarks
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Evaluation of {html.escape(str(settings.get('bag', 'a drive')))}</title>"
        f"<style>{PAGE_STYLE}</style></head>"
        "<body><main><h1>Predicted against measured motion</h1>"
        '<p class="lead">From moments along the drive the motion was predicted with the commands that followed, and '
        "compared with what the robot then did. Only the part of a trajectory that lies on the predicted map counts. "
        "Bold marks the smallest error.</p>"
        f'<section class="card">{_table(evaluation)}</section>{pictures}'
        f'<section class="card"><h2 style="margin-top:0">How it was made</h2><dl>{listed}</dl>{remarks}</section>'
        "</main></body></html>"
    )


def _table(evaluation: RecordingEvaluation) -> str:
    rows = summary_table(evaluation)
    columns = [(part, h) for part in (0, 1) for h in evaluation.horizons]
    best = {}
    for part, horizon in columns:
        means = {m: r[horizon][part].mean for m, r in rows.items() if math.isfinite(r[horizon][part].mean)}
        best[part, horizon] = min(means, key=means.get) if means else None
    head = "".join(f"<th>{('Δx [m]', 'ΔR [°]')[part]}<br>at {h:g} s</th>" for part, h in columns)
    body = ""
    for method, row in rows.items():
        cells = ""
        for part, horizon in columns:
            entry = row[horizon][part]
            digits = 3 if part == 0 else 2
            text = (
                f"{entry.mean:.{digits}f}<br><small>{entry.low:.{digits}f} – {entry.high:.{digits}f}</small>"
                if entry.windows
                else "–"
            )
            cells += f'<td class="{"best" if best[part, horizon] == method else ""}">{text}</td>'
        body += f"<tr><td>{html.escape(method)}</td>{cells}</tr>"
    first = next(iter(rows.values()))
    counts = "".join(f"<td><small>{first[h][part].windows} windows</small></td>" for part, h in columns)
    return (
        f"<table><tr><th>method</th>{head}</tr>{body}<tr><td><small>windows counted</small></td>{counts}</tr></table>"
        '<p class="muted">Mean error over windows, below it the 95 % interval of the mean (block bootstrap: '
        "neighbouring windows overlap).</p>"
    )
