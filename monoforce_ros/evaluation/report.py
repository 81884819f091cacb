"""Reports of an evaluation: JSON for programs, one self-contained HTML page for people, a table for the terminal."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from matplotlib.figure import Figure

from monoforce_ros.evaluation.drive import DriveEvaluation
from monoforce_ros.evaluation.metrics import Summary

PAGE_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2733; background: #f5f7f8; margin: 0; }
main { max-width: 1120px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 36px 0 10px; }
p.lead { color: #51606e; margin: 0 0 20px; max-width: 80ch; }
section.card { background: white; border-radius: 10px; padding: 18px 22px; margin: 18px 0;
  box-shadow: 0 1px 3px #0002; }
img { max-width: 100%; display: block; margin: 0 auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: 6px 10px; text-align: right; border-bottom: 1px solid #e3e8ec; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td.best { font-weight: 700; color: #0b6e4f; }
small, .muted { color: #6b7a88; }
details { margin-top: 12px; } summary { cursor: pointer; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0; }
dt { color: #6b7a88; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def summary_table(evaluation: DriveEvaluation) -> dict[str, dict[float, tuple[Summary, Summary]]]:
    """Summary of every method at every horizon."""
    return {method: evaluation.summary(method) for method in evaluation.predicted}


def terminal_table(evaluation: DriveEvaluation) -> str:
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


def report_content(evaluation: DriveEvaluation, settings: dict[str, object]) -> dict[str, object]:
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


def write_text(path: Path, text: str) -> None:
    """Write a file beside its target and rename it, so that a reader never meets half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.unfinished-{os.getpid()}")
    try:
        unfinished.write_text(text, encoding="utf-8")
        unfinished.rename(path)
    except OSError:
        # A full disk: what was there stays, and what could not be finished does not fill it further.
        unfinished.unlink(missing_ok=True)
        raise


def write_between(document: Path, name: str, text: str) -> None:
    """Put a text into a document, between its comments ``<!-- NAME -->`` and ``<!-- end of NAME -->``.

    Raises:
        ValueError: the document has no such comments.
    """
    content = document.read_text(encoding="utf-8")
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if begin not in content or end not in content:
        raise ValueError(f"{document}: no {begin} and {end} to write between")
    before, _, rest = content.partition(begin)
    write_text(document, f"{before}{begin}\n{text.strip()}\n{end}{rest.partition(end)[2]}")


def figure_png(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def write_reports(
    folder: Path,
    evaluation: DriveEvaluation,
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


def _page(evaluation: DriveEvaluation, settings: dict[str, object], figures: Sequence[tuple[str, str, bytes]]) -> str:
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


def _table(evaluation: DriveEvaluation) -> str:
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
