"""Report of a diagnosis: ``report.json`` for programs, lines for a terminal; the page is in :mod:`page`."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.areas import Area, Circle
from monoforce_ros.discrepancy.comparison import GapRow
from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.gap import Localisation, NoiseFloor
from monoforce_ros.discrepancy.headline import headline
from monoforce_ros.discrepancy.page import diagnosis_page
from monoforce_ros.discrepancy.verdict import Losses


def effect_entry(effect: EffectEstimate) -> dict:
    """An effect as in ``report.json`` and for :func:`monoforce_ros.robots.write_robot`.

    ``rivals`` is the former name of ``indistinguishable``; this release writes both.
    """
    others = list(effect.indistinguishable)
    return {
        "name": effect.name,
        "parameters": {key: asdict(parameter) for key, parameter in effect.parameters.items()},
        "products": {key: asdict(product) for key, product in effect.products.items()},
        "indistinguishable": others,
        "rivals": others,
        "found_again": None if effect.found_again is None else list(effect.found_again),
        "named_otherwise": list(effect.named_otherwise),
    }


def report_content(
    diagnosis: Diagnosis,
    inputs: Mapping[str, object],
    robot_file: Path | None,
    complaints: Sequence[str] = (),
    written: Collection[str] | None = None,
) -> dict:
    """The content of ``report.json``; see :func:`diagnosis_page` for the arguments."""
    names = [effect.name for effect in diagnosis.effects]
    top = headline(diagnosis, complaints)
    return {
        "verdict": str(diagnosis.verdict),
        "headline": {**asdict(top), "tone": str(top.tone)},
        "complaints": list(complaints),
        "effects": [effect_entry(effect) for effect in diagnosis.effects],
        "known_parts": [effect_entry(effect) for effect in diagnosis.known_parts],
        "localisation": [_localisation_entry(entry) for entry in diagnosis.localisation],
        "gap": _gap_entries(diagnosis.gap),
        "noise_floor": _noise_entries(diagnosis.noise_floor),
        "localisation_error_deg": diagnosis.localisation_error,
        "robot_file": None if robot_file is None else str(robot_file),
        "in_robot_file": [name for name in names if robot_file is not None and (written is None or name in written)],
        "inputs": dict(inputs),
        "advice": list(diagnosis.advice),
        "part": diagnosis.part or None,
        "partial": list(diagnosis.partial),
        "area": None if diagnosis.details is None else _area_entry(diagnosis.details.area),
        "candidates": [asdict(candidate) for candidate in diagnosis.candidates],
        "regimes": [asdict(row) for row in diagnosis.regimes],
        "remarks": list(diagnosis.remarks),
        "numbers": _loss_entries(diagnosis.losses),
        "steps": None if diagnosis.steps is None else asdict(diagnosis.steps),
        "held_out": {name: _gap_entries(table) for name, table in diagnosis.held_out.items()},
    }


def _area_entry(area: Area | None) -> dict | None:
    """Where effects act alone, or errors of an unknown one are largest: a circle in the odometry frame, or a class of
    ground."""
    return None if area is None else {"circle" if isinstance(area.place, Circle) else "ground": asdict(area.place)}


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
        "variance_ratio": losses.variance_ratio,
    }
    return {key: value for key, value in entries.items() if value is not None}


def write_diagnosis(
    folder: Path,
    diagnosis: Diagnosis,
    inputs: Mapping[str, object],
    robot_file: Path | None,
    complaints: Sequence[str] = (),
    written: Collection[str] | None = None,
) -> tuple[Path, Path]:
    """Write ``report.json`` and ``report.html``; returns both paths. See :func:`diagnosis_page` for the arguments."""
    content = report_content(diagnosis, inputs, robot_file, complaints, written)
    write_text(folder / "report.json", json.dumps(content, indent=2))
    write_text(folder / "report.html", diagnosis_page(diagnosis, inputs, robot_file, complaints, written))
    return folder / "report.json", folder / "report.html"


def summary_lines(diagnosis: Diagnosis, complaints: Sequence[str] = ()) -> list[str]:
    """The result in a few lines for a terminal: what stays unexplained, what is wrong, how sure, what to do."""
    top = headline(diagnosis, complaints)
    lines = [f"{diagnosis.verdict}: {top.sentence}"]
    lines += [f"  {top.unexplained}"] if top.unexplained else []
    lines += [f"  {text}" for text in top.findings]
    lines += [f"  doubt: {text}" for text in top.doubts]
    lines += [f"  {text}" for text in top.confidence]
    for effect in diagnosis.effects:
        values = ", ".join(
            f"{key} {parameter.value:.3g}{_unit(parameter.unit)} ({parameter.low:.3g} to {parameter.high:.3g})"
            for key, parameter in effect.shown.items()
        )
        others = ", ".join(effect.indistinguishable)
        lines.append(f"  {effect.name}: {values}{f'; indistinguishable from {others}' if others else ''}")
    lines += [f"  {entry.text}" for entry in diagnosis.localisation[:3]]
    lines += [f"  to do: {action}" for action in top.actions]
    return lines


def _unit(unit: str) -> str:
    """A unit behind a number; of what has none nothing."""
    return "" if unit == "-" else f" {unit}"
