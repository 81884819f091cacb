"""Method tables: other methods on the same drives, and ``diagnose`` itself without a sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from benchmark_score import TITLES, Row, score_cell, scores

METHODS = {
    "refit": "refit of friction, track width and lag",
    "network": "neural residual",
    "sindy": "pysindy on the accelerations",
    "mujoco_sysid": "MuJoCo's `sysid`, all parameters free",
}
"""Of ``baselines.py``."""
_KINDS = {"single": "single effects", "pair": "pairs"}
_COMPARED = (
    "singles_named", "pairs_named", "false_alarms", "outside_named", "extra_effects", "intervals_with_truth",
    "gap_closed", "not_diagnosed",
)  # fmt: skip
"""Scores of an ablation."""


def baseline_table(rows: Sequence[Row]) -> str:
    """Position errors after 2 s of ``diagnose`` and other methods on held-out blocks as a Markdown table."""
    compared = [
        row for row in rows if set(METHODS) <= set(row.get("baselines", {})) and "position_2s" in row.get("gap", {})
    ]
    of_kind = {kind: part for kind in _KINDS if (part := [row for row in compared if row["kind"] == kind])}
    if not of_kind:
        return "No baselines."
    heads = [f"error on {len(part)} {_KINDS[kind]} [m] | gap closed" for kind, part in of_kind.items()]
    lines = [
        "| method | " + " | ".join(heads) + " | processor time of a drive, median |",
        "|---|" + "---|---|" * len(of_kind) + "---|",
    ]
    errors: dict[str, Callable[[Row], float]] = {"nominal model": lambda row: row["gap"]["position_2s"]["before"]}
    errors |= {title: lambda row, name=name: row["baselines"][name] for name, title in METHODS.items()}
    errors["diagnose"] = _after
    seconds: Mapping[str, Callable[[Row], float]] = {
        title: lambda row, name=name: row["baselines"]["seconds"][name] for name, title in METHODS.items()
    } | {"diagnose": lambda row: row["cpu_seconds"]}
    for name, error in errors.items():
        cells = []
        for part in of_kind.values():
            gaps = [row["gap"]["position_2s"] for row in part]
            before, noise = (np.array([gap[key] for gap in gaps]) for key in ("before", "noise"))
            left = np.array([error(row) for row in part])
            closed = np.median((before - left) / np.maximum(before - noise, 1e-6))
            cells.append(f"{np.median(left):.3f} | {100 * closed:.0f} %")
        spent = f"{np.median([seconds[name](row) for row in compared]):.0f} s" if name in seconds else "–"
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {spent} |")
    return "\n".join(lines)


def _after(row: Row) -> float:
    """Error after the diagnosis; that of the nominal model if no effect was added."""
    gap = row["gap"]["position_2s"]
    return gap["before"] if gap["after"] is None else gap["after"]


def ablation_table(rows: Sequence[Row], without: Mapping[str, Sequence[Row]]) -> str:
    """Scores without a sensor beside those of the same drives with it, as a Markdown table.

    Args:
        rows: with all sensors.
        without: rows by the sensor that was taken out of the recordings.
    """
    columns: dict[str, Sequence[Row]] = {}
    for sensor, part in without.items():
        names = {row["case"] for row in part}
        columns[f"with {sensor}"] = [row for row in rows if row["case"] in names]
        columns[f"without {sensor}"] = part
    found = {name: scores(part) for name, part in columns.items()}
    lines = ["| score | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for key in _COMPARED:
        lines.append(f"| {TITLES[key]} | " + " | ".join(score_cell(key, found[name][key]) for name in columns) + " |")
    return "\n".join(lines)
