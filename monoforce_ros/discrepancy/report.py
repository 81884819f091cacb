"""Report of a diagnosis: ``report.json`` for programs, and a self-contained HTML page."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path

from matplotlib.figure import Figure

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.comparison import GapRow
from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.figures import (
    candidates_figure,
    gap_figure,
    map_figure,
    paths_figure,
    regime_figure,
    timeline_figure,
)
from monoforce_ros.discrepancy.gap import Localisation, NoiseFloor
from monoforce_ros.discrepancy.verdict import Losses, Verdict
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.reporting import card, definition_list, figure_png, page, picture, table

_VERDICTS = {
    Verdict.EFFECT_FOUND: ("The model lacks a known effect.", "#0b6e4f"),
    Verdict.NO_DISCREPANCY: ("The model agrees with this recording.", "#0b6e4f"),
    Verdict.UNKNOWN_EFFECT: ("Unexplained error: no known effect fits.", "#b3540e"),
    Verdict.NOT_IDENTIFIABLE: ("This recording is not sufficient for a diagnosis.", "#b3540e"),
    Verdict.NO_IMPROVEMENT: ("The model has an error, but no effect reduces it reliably.", "#b3540e"),
}
_CROSS_VALIDATED = (
    "Each window is predicted with parameters fitted to other blocks of the recording. Two things are not held out: "
    "values measured by the gyro or the wheel speeds come from the whole recording, and the effects were selected on "
    "these same blocks. The improvement is therefore somewhat optimistic; check it on another recording (--held-out)."
)


def effect_entry(effect: EffectEstimate) -> dict:
    """An effect as in ``report.json`` and for :func:`monoforce_ros.robots.write_robot`.

    ``rivals`` is the former name of ``indistinguishable``; this release writes both.
    """
    others = list(effect.indistinguishable)
    return {
        "name": effect.name,
        "parameters": {key: asdict(parameter) for key, parameter in effect.parameters.items()},
        "indistinguishable": others,
        "rivals": others,
    }


def report_content(diagnosis: Diagnosis, inputs: Mapping[str, object], robot_file: Path | None) -> dict:
    """The content of ``report.json``."""
    return {
        "verdict": str(diagnosis.verdict),
        "effects": [effect_entry(effect) for effect in diagnosis.effects],
        "known_parts": [effect_entry(effect) for effect in diagnosis.known_parts],
        "localisation": [_localisation_entry(entry) for entry in diagnosis.localisation],
        "gap": _gap_entries(diagnosis.gap),
        "noise_floor": _noise_entries(diagnosis.noise_floor),
        "robot_file": None if robot_file is None else str(robot_file),
        "inputs": dict(inputs),
        "advice": list(diagnosis.advice),
        "candidates": [asdict(candidate) for candidate in diagnosis.candidates],
        "regimes": [asdict(row) for row in diagnosis.regimes],
        "remarks": list(diagnosis.remarks),
        "numbers": _loss_entries(diagnosis.losses),
        "held_out": {name: _gap_entries(table) for name, table in diagnosis.held_out.items()},
    }


def _localisation_entry(entry: Localisation) -> dict:
    return {key: value for key, value in asdict(entry).items() if key != "horizon"} | {"text": entry.text}


def _gap_entries(table: Mapping[str, GapRow]) -> dict[str, dict]:
    """Rows by metric; ``after``, ``low`` and ``high`` are null where no effect was added."""
    return {
        metric: {
            "horizon_s": row.horizon,
            "before": row.before,
            "after": row.after,
            "low": row.gain_low,
            "high": row.gain_high,
            "unit": row.unit,
            "noise": row.noise,
        }
        | ({} if row.closed is None else {"closed": row.closed})
        for metric, row in table.items()
    }


def _noise_entries(floor: NoiseFloor | None) -> dict[str, dict]:
    if floor is None:
        return {}
    values = {"along": (floor.along, "m"), "across": (floor.across, "m"), "heading": (floor.heading, "rad")}
    return {name: {"horizon_s": floor.horizon, "value": value, "unit": unit} for name, (value, unit) in values.items()}


def _loss_entries(losses: Losses | None) -> dict[str, float]:
    """Losses by their names in the report, without unused ones."""
    if losses is None:
        return {}
    entries = {
        "loss_before": losses.before,
        "loss_after": losses.after,
        "loss_of_a_healthy_robot": losses.healthy,
        "share_explained": losses.share_explained,
        "loss_by_formula": losses.by_formula,
        "p_rest": losses.p_rest,
    }
    return {key: value for key, value in entries.items() if value is not None}


def write_diagnosis(
    folder: Path, diagnosis: Diagnosis, inputs: Mapping[str, object], robot_file: Path | None
) -> tuple[Path, Path]:
    """Write ``report.json`` and ``report.html``; returns both paths."""
    content = report_content(diagnosis, inputs, robot_file)
    write_text(folder / "report.json", json.dumps(content, indent=2))
    write_text(folder / "report.html", _page(diagnosis, inputs, robot_file))
    return folder / "report.json", folder / "report.html"


def summary_lines(diagnosis: Diagnosis) -> list[str]:
    """The result in a few lines for a terminal."""
    lines = [f"{diagnosis.verdict}: {_VERDICTS[diagnosis.verdict][0]}"]
    lines += [f"  {remark}" for remark in diagnosis.remarks]
    for effect in diagnosis.effects:
        values = ", ".join(
            f"{key} {parameter.value:.3g} {parameter.unit} ({parameter.low:.3g} to {parameter.high:.3g})"
            for key, parameter in effect.parameters.items()
        )
        others = ", ".join(effect.indistinguishable)
        lines.append(f"  {effect.name}: {values}{f'; indistinguishable from {others}' if others else ''}")
    for metric in ("position_2s", "heading_2s"):
        row = diagnosis.gap.get(metric)
        if row is not None and row.after is not None:
            change = f"{row.before:.3g} → {row.after:.3g} {row.unit}"
            if row.closed is not None:
                change += f", {100 * row.closed:.0f} % of the reducible gap closed"
            lines.append(f"  {metric.split('_')[0]} error after 2 s, median, cross-validated: {change}")
    for name, metrics in diagnosis.held_out.items():
        row = metrics.get("position_2s")
        if row is not None and row.after is not None:
            lines.append(f"  held-out {name}: position error after 2 s {row.before:.3g} → {row.after:.3g} m")
        elif row is not None:
            lines.append(f"  held-out {name}: position error after 2 s {row.before:.3g} m, no effect was added")
    lines += [f"  {entry.text}" for entry in diagnosis.localisation[:3]]
    lines += [f"  hint: {hint}" for hint in diagnosis.advice]
    return lines


def _page(diagnosis: Diagnosis, inputs: Mapping[str, object], robot_file: Path | None) -> str:
    sentence, colour = _VERDICTS[diagnosis.verdict]
    remarks = "; ".join(diagnosis.remarks)
    parts = [
        f"<p class='lead' style='font-size:20px;color:{colour};margin-bottom:4px'><b>{sentence}</b></p>"
        f"<p class='lead'>{html.escape(remarks)}</p>",
    ]
    details = diagnosis.details
    if diagnosis.effects:
        parts.append(_effects_card(diagnosis))
    if diagnosis.gap:
        parts.append(_gap_card(diagnosis))
    if diagnosis.held_out:
        parts.append(_held_out_card(diagnosis))
    if details is not None and details.paths:
        parts.append(
            card(
                _image(paths_figure(details.paths), "predicted and measured paths from above"),
                heading="Predicted and measured paths",
                caption="Five seconds each, seen from above, the start heading to the right; from the largest error "
                "down to the median.",
            )
        )
    if diagnosis.localisation or diagnosis.regimes:
        items = _list_items(
            f"{entry.text} (RMS {entry.rms:.3g} {entry.unit}, mean {entry.bias:+.2g} {entry.unit})"
            for entry in diagnosis.localisation[:5]
        )
        figure = _image(regime_figure(diagnosis.regimes), "error by motion regime") if diagnosis.regimes else ""
        parts.append(card(f"<ol>{items}</ol>{figure}", heading="Where the error is largest"))
    if details is not None and details.compared:
        parts.append(card(_image(map_figure(details), "errors on the map"), heading="On the map"))
        parts.append(card(_image(timeline_figure(details), "errors over time"), heading="Over time"))
    if diagnosis.candidates:
        parts.append(card(_image(candidates_figure(diagnosis), "gain of each effect"), heading="Effects tested"))
    if diagnosis.advice:
        parts.append(card(f"<ul>{_list_items(diagnosis.advice)}</ul>", heading="What to record next"))
    entries: dict[str, object] = dict(inputs)
    if robot_file is not None:
        entries["robot file with the added effects"] = robot_file
    parts.append(card(definition_list(entries), heading="Inputs"))
    return page("Diagnosis", "".join(parts))


def _effects_card(diagnosis: Diagnosis) -> str:
    rows = []
    for effect in diagnosis.effects:
        kind = CATALOGUE[effect.name]
        for number, (key, parameter) in enumerate(effect.parameters.items()):
            name = f"<b>{effect.name}</b><br><small>{html.escape(kind.summary)}</small>" if number == 0 else ""
            others = html.escape(", ".join(effect.indistinguishable)) or "–"
            rows.append(
                f"<tr><td style='white-space:normal'>{name}</td><td>{key}</td>"
                f"<td><b>{parameter.value:.3g}</b> {parameter.unit}</td>"
                f"<td>{parameter.low:.3g} to {parameter.high:.3g}</td>"
                f"<td>{others if number == 0 else ''}</td></tr>"
            )
    unknown = diagnosis.verdict == Verdict.UNKNOWN_EFFECT
    title = "Best formula for the error" if unknown else "Effects missing in the model"
    head = ("effect", "parameter", "value", "95 % confidence interval", "indistinguishable from")
    return card(table(head, rows), heading=title)


def _gap_card(diagnosis: Diagnosis) -> str:
    rows = []
    for metric, row in diagnosis.gap.items():
        closed = "–" if row.closed is None else f"{100 * row.closed:.0f} %"
        rows.append(
            f"<tr><td>{_metric(metric, row)}</td><td>{row.noise:.2g} {row.unit}</td>"
            f"<td>{row.before:.3g} {row.unit}</td>{_after_cells(row)}<td>{closed}</td></tr>"
        )
    note = f"{_CROSS_VALIDATED} " if diagnosis.fitted else ""
    head = ("median error", "noise floor", "before", "after", "mean gain, 95 % interval", "reducible gap closed")
    return card(
        _image(gap_figure(diagnosis), "errors before and after") + table(head, rows),
        heading="Prediction error",
        caption=f"{note}The reducible gap is the error above the noise floor.",
    )


def _after_cells(row: GapRow) -> str:
    if row.after is None:
        return "<td>–</td><td>–</td>"
    return f"<td><b>{row.after:.3g} {row.unit}</b></td><td>{row.gain_low:.2g} to {row.gain_high:.2g}</td>"


def _metric(metric: str, row: GapRow) -> str:
    if not row.horizon:
        return "yaw rate against the gyro"
    return f"{metric.split('_')[0]} after {row.horizon:g} s"


def _held_out_card(diagnosis: Diagnosis) -> str:
    rows = [
        f"<tr><td>{html.escape(name) if number == 0 else ''}</td><td>{_metric(metric, row)}</td>"
        f"<td>{row.before:.3g} {row.unit}</td>{_after_cells(row)}</tr>"
        for name, metrics in diagnosis.held_out.items()
        for number, (metric, row) in enumerate(metrics.items())
    ]
    return card(
        table(("recording", "median error", "before", "after", "mean gain, 95 % interval"), rows),
        heading="On held-out recordings",
        caption="Nothing was fitted to or selected on these recordings.",
    )


def _list_items(texts: Iterable[str]) -> str:
    return "".join(f"<li>{html.escape(text)}</li>" for text in texts)


def _image(figure: Figure, alt: str) -> str:
    return picture(figure_png(figure), alt=alt)
