"""Report of a diagnosis: ``report.json`` for programs, one self-contained HTML page for people."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.figures import (
    candidates_figure,
    gap_figure,
    map_figure,
    paths_figure,
    regime_figure,
    timeline_figure,
)
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.reporting import PAGE_STYLE, figure_png

_VERDICTS = {
    "effect_found": ("Something is missing in the model, and it was named.", "#0b6e4f"),
    "no_discrepancy": ("Nothing is missing that this drive could show.", "#0b6e4f"),
    "unknown_effect": ("Something is missing that the catalogue does not hold.", "#b3540e"),
    "not_identifiable": ("This drive cannot tell.", "#b3540e"),
    "no_improvement": ("There is a disagreement, but no effect explains enough of it to be added.", "#b3540e"),
}


def report_content(diagnosis: Diagnosis, inputs: dict, robot_file: Path | None) -> dict:
    """The content of ``report.json``."""
    return {
        "verdict": diagnosis.verdict,
        "effects": list(diagnosis.effects),
        "localisation": list(diagnosis.localisation),
        "gap": diagnosis.gap,
        "noise_floor": diagnosis.floor,
        "robot_file": None if robot_file is None else str(robot_file),
        "inputs": inputs,
        "advice": list(diagnosis.advice),
        "candidates": list(diagnosis.candidates),
        "regimes": list(diagnosis.regimes),
        "remarks": list(diagnosis.remarks),
        "numbers": diagnosis.numbers,
        "held_out": diagnosis.held_out,
    }


def write_diagnosis(folder: Path, diagnosis: Diagnosis, inputs: dict, robot_file: Path | None) -> tuple[Path, Path]:
    """Write ``report.json`` and ``report.html``; returns both."""
    content = report_content(diagnosis, inputs, robot_file)
    write_text(folder / "report.json", json.dumps(content, indent=2))
    write_text(folder / "report.html", _page(diagnosis, content))
    return folder / "report.json", folder / "report.html"


def summary_lines(diagnosis: Diagnosis) -> list[str]:
    """The outcome in a few lines for a terminal."""
    lines = [f"{diagnosis.verdict}: {_VERDICTS[diagnosis.verdict][0]}"]
    lines += [f"  {remark}" for remark in diagnosis.remarks]
    for effect in diagnosis.effects:
        values = ", ".join(
            f"{key} {entry['value']:.3g} {entry['unit']} ({entry['low']:.3g} to {entry['high']:.3g})"
            for key, entry in effect["parameters"].items()
        )
        rivals = f"; this data cannot tell it from {', '.join(effect['rivals'])}" if effect["rivals"] else ""
        lines.append(f"  {effect['name']}: {values}{rivals}")
    for metric in ("position_2s", "heading_2s"):
        if metric in diagnosis.gap and diagnosis.fitted:
            row = diagnosis.gap[metric]
            change = f"{row['before']:.3g} → {row['after']:.3g} {row['unit']}"
            if "closed" in row:
                change += f", {100 * row['closed']:.0f} % of the reducible gap closed"
            lines.append(f"  {metric.split('_')[0]} error after 2 s, median: {change}")
    for name, table in diagnosis.held_out.items():
        row = table.get("position_2s")
        if row:
            lines.append(f"  held out, {name}: position {row['before']:.3g} → {row['after']:.3g} m after 2 s")
    lines += [f"  {entry['text']}" for entry in diagnosis.localisation[:3]]
    lines += [f"  hint: {told}" for told in diagnosis.advice]
    return lines


def _page(diagnosis: Diagnosis, content: dict) -> str:
    sentence, colour = _VERDICTS[diagnosis.verdict]
    remarks = "; ".join(diagnosis.remarks)
    parts = [
        f"<h1>Diagnosis</h1><p class='lead' style='font-size:20px;color:{colour};margin-bottom:4px'>"
        f"<b>{sentence}</b></p>"
        f"<p class='lead'>{html.escape(remarks)}</p>",
    ]
    if diagnosis.effects:
        parts.append(_effects_card(diagnosis))
    if diagnosis.gap:
        parts.append(_gap_card(diagnosis))
    if diagnosis.held_out:
        parts.append(_held_out_card(diagnosis))
    if diagnosis.details.get("paths"):
        parts.append(
            _card(
                "Predicted and measured paths",
                f"{_image(paths_figure(diagnosis))}<p class='muted'>Five seconds each, seen from above, ahead is to "
                "the right; from the largest error down to a middling one.</p>",
            )
        )
    if diagnosis.localisation or diagnosis.regimes:
        items = "".join(
            f"<li>{html.escape(entry['text'])} (root mean square {entry['rms']:.3g} {entry['unit']}, "
            f"bias {entry['bias']:+.2g})</li>"
            for entry in diagnosis.localisation[:5]
        )
        figure = _image(regime_figure(diagnosis)) if diagnosis.regimes else ""
        parts.append(_card("Where the disagreement lives", f"<ol>{items}</ol>{figure}"))
    if diagnosis.details.get("compared"):
        parts.append(_card("On the map", _image(map_figure(diagnosis))))
        parts.append(_card("In time", _image(timeline_figure(diagnosis))))
    if diagnosis.candidates:
        parts.append(_card("What was tried", _image(candidates_figure(diagnosis))))
    if diagnosis.advice:
        told = "".join(f"<li>{html.escape(entry)}</li>" for entry in diagnosis.advice)
        parts.append(_card("What would tell more", f"<ul>{told}</ul>"))
    listed = "".join(
        f"<dt>{html.escape(str(key))}</dt><dd>{html.escape(str(value))}</dd>"
        for key, value in content["inputs"].items()
    )
    if content["robot_file"]:
        listed += f"<dt>robot file with what was found</dt><dd>{html.escape(content['robot_file'])}</dd>"
    parts.append(_card("Inputs", f"<dl>{listed}</dl>"))
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Diagnosis</title>"
        f"<style>{PAGE_STYLE}</style></head><body><main>{''.join(parts)}</main></body></html>"
    )


def _effects_card(diagnosis: Diagnosis) -> str:
    rows = []
    for effect in diagnosis.effects:
        kind = CATALOGUE[effect["name"]]
        for number, (key, entry) in enumerate(effect["parameters"].items()):
            name = f"<b>{effect['name']}</b><br><small>{html.escape(kind.summary)}</small>" if number == 0 else ""
            rivals = html.escape(", ".join(effect["rivals"])) or "–"
            rows.append(
                f"<tr><td style='white-space:normal'>{name}</td><td>{key}</td>"
                f"<td><b>{entry['value']:.3g}</b> {entry['unit']}</td>"
                f"<td>{entry['low']:.3g} to {entry['high']:.3g}</td>"
                f"<td>{rivals if number == 0 else ''}</td></tr>"
            )
    unknown = diagnosis.verdict == "unknown_effect"
    title = "The formula that explains it best" if unknown else "What is missing"
    return _card(
        title,
        "<table><tr><th>effect</th><th>parameter</th><th>value</th><th>95 % interval</th><th>cannot be told from</th>"
        f"</tr>{''.join(rows)}</table>",
    )


def _gap_card(diagnosis: Diagnosis) -> str:
    rows = []
    for key, row in diagnosis.gap.items():
        cells = [
            f"<td>{_metric(key, row)}</td>",
            f"<td>{row['noise']:.2g} {row['unit']}</td>",
            f"<td>{row['before']:.3g} {row['unit']}</td>",
        ]
        if diagnosis.fitted:
            closed = f"{100 * row['closed']:.0f} %" if "closed" in row else "–"
            cells.append(
                f"<td><b>{row['after']:.3g} {row['unit']}</b></td><td>{row['low']:.2g} to {row['high']:.2g}</td>"
                f"<td>{closed}</td>"
            )
        else:
            cells.append("<td>–</td><td>–</td><td>–</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    told = (
        "Every window is predicted by a fit that did not see it, nor anything that happens in it. "
        if (diagnosis.fitted)
        else ""
    )
    return _card(
        "The gap between simulation and measurement",
        f"{_image(gap_figure(diagnosis))}<table><tr><th>median error</th><th>noise alone</th><th>before</th>"
        "<th>after</th><th>mean gain, 95 % interval</th><th>of the reducible gap closed</th></tr>"
        f"{''.join(rows)}</table><p class='muted'>{told}The reducible gap is what is above the noise of the poses.</p>",
    )


def _metric(key: str, row: dict) -> str:
    if not row["horizon_s"]:
        return "yaw rate against the gyro"
    return f"{key.split('_')[0]} after {row['horizon_s']:g} s"


def _held_out_card(diagnosis: Diagnosis) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(name) if number == 0 else ''}</td>"
        f"<td>{_metric(key, row)}</td>"
        f"<td>{row['before']:.3g} {row['unit']}</td><td><b>{row['after']:.3g} {row['unit']}</b></td>"
        f"<td>{row['low']:.2g} to {row['high']:.2g}</td></tr>"
        for name, table in diagnosis.held_out.items()
        for number, (key, row) in enumerate(table.items())
    )
    return _card(
        "On drives that no fit saw",
        "<table><tr><th>bag</th><th>median error</th><th>before</th><th>after</th>"
        "<th>mean gain, 95 % interval</th></tr>"
        f"{rows}</table>",
    )


def _card(title: str, content: str) -> str:
    return f"<section class='card'><h2>{title}</h2>{content}</section>"


def _image(figure) -> str:
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(figure_png(figure)).decode()}'>"
