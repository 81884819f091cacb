"""Report of a diagnosis: ``report.json`` for programs, one self-contained HTML page for people."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path

from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.figures import candidates_figure, gap_figure, timeline_figure
from monoforce_ros.evaluation.report import PAGE_STYLE, figure_png, write_text
from monoforce_ros.physics.effects import CATALOGUE

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
            lines.append(f"  {metric.split('_')[0]} error after 2 s: {change} (median)")
    lines += [f"  {entry['text']}" for entry in diagnosis.localisation[:3]]
    lines += [f"  hint: {told}" for told in diagnosis.advice]
    return lines


def _page(diagnosis: Diagnosis, content: dict) -> str:
    sentence, colour = _VERDICTS[diagnosis.verdict]
    parts = [
        f"<h1>Diagnosis</h1><p class='lead' style='font-size:20px;color:{colour}'><b>{sentence}</b></p>",
    ]
    if diagnosis.effects:
        rows = []
        for effect in diagnosis.effects:
            kind = CATALOGUE[effect["name"]]
            for key, entry in effect["parameters"].items():
                rows.append(
                    f"<tr><td><b>{effect['name']}</b><br><small>{html.escape(kind.summary)}</small></td>"
                    f"<td>{key}</td><td><b>{entry['value']:.3g}</b> {entry['unit']}</td>"
                    f"<td>{entry['low']:.3g} to {entry['high']:.3g}</td>"
                    f"<td>{html.escape(', '.join(effect['rivals'])) or '–'}</td></tr>"
                )
        parts.append(
            "<section class='card'><h2>What is missing</h2><table><tr><th>effect</th><th>parameter</th><th>value</th>"
            f"<th>95 % interval</th><th>cannot be told from</th></tr>{''.join(rows)}</table></section>"
        )
    if diagnosis.gap:
        rows = [
            f"<tr><td>{key.split('_')[0]} at {row['horizon_s']:g} s</td><td>{row['before']:.3g} {row['unit']}</td>"
            + (
                f"<td><b>{row['after']:.3g} {row['unit']}</b></td><td>{row['low']:.2g} to {row['high']:.2g}</td></tr>"
                if diagnosis.fitted
                else "<td>–</td><td>–</td></tr>"
            )
            for key, row in diagnosis.gap.items()
        ]
        parts.append(
            "<section class='card'><h2>The gap between simulation and measurement</h2>"
            f"{_image(gap_figure(diagnosis))}<table><tr><th>median error</th><th>before</th><th>after</th>"
            f"<th>mean gain, 95 % interval</th></tr>{''.join(rows)}</table>"
            "<p class='muted'>Every window is predicted by a fit that did not see it.</p></section>"
        )
    if diagnosis.localisation:
        items = "".join(
            f"<li>{html.escape(entry['text'])} (root mean square {entry['rms']:.3g} {entry['unit']}, "
            f"bias {entry['bias']:+.2g})</li>"
            for entry in diagnosis.localisation
        )
        parts.append(f"<section class='card'><h2>Where it lives</h2><ol>{items}</ol></section>")
    if "before" in diagnosis.details:
        parts.append(f"<section class='card'><h2>When</h2>{_image(timeline_figure(diagnosis))}</section>")
    if diagnosis.candidates:
        parts.append(f"<section class='card'><h2>What was tried</h2>{_image(candidates_figure(diagnosis))}</section>")
    if diagnosis.advice:
        told = "".join(f"<li>{html.escape(entry)}</li>" for entry in diagnosis.advice)
        parts.append(f"<section class='card'><h2>What would tell more</h2><ul>{told}</ul></section>")
    listed = "".join(
        f"<dt>{html.escape(str(key))}</dt><dd>{html.escape(str(value))}</dd>"
        for key, value in content["inputs"].items()
    )
    if content["robot_file"]:
        listed += f"<dt>robot file with the effect</dt><dd>{html.escape(content['robot_file'])}</dd>"
    parts.append(f"<section class='card'><h2>Inputs</h2><dl>{listed}</dl></section>")
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Diagnosis</title>"
        f"<style>{PAGE_STYLE}</style></head><body><main>{''.join(parts)}</main></body></html>"
    )


def _image(figure) -> str:
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(figure_png(figure)).decode()}'>"
