"""Benchmark score: shares over rows of the benchmark, each with its count and its binomial confidence interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import binomtest

from monoforce_ros.effects import CATALOGUE

Row = dict
ENGINES = ("mujoco", "newton", "worlds")


def named(row: Row) -> list[dict]:
    """The effects that a report names; none with any verdict but ``effect_found``."""
    return row["effects"] if row["verdict"] == "effect_found" else []


def says(effect: dict, hidden: dict) -> bool:
    """Whether an effect of a report is the hidden one: its name or one of those reported as indistinguishable."""
    return bool({effect["name"], *effect.get("indistinguishable", [])} & set(hidden["names"]))


def found_all(row: Row) -> bool:
    """Whether every hidden effect is named, each by another effect of the report; a single one by the first."""
    effects = named(row)
    if len(row["hidden"]) == 1:
        return bool(effects) and says(effects[0], row["hidden"][0])
    first, second = row["hidden"]
    return any(
        says(one, first) and says(other, second)
        for number, one in enumerate(effects)
        for index, other in enumerate(effects)
        if number != index
    )


def named_exactly(row: Row) -> bool:
    """Whether the first effect of a report has the very name of the only hidden one."""
    effects = named(row)
    return bool(effects) and effects[0]["name"] == row["hidden"][0]["name"]


def true_value(row: Row, name: str, key: str, injected: float) -> float:
    """Value of a parameter in truth: what was injected in addition to what commissioning found on the healthy robot.

    A report states both together: a robot whose commands take 0.08 s to act and are delayed by 0.2 s more has a delay
    of 0.28 s.
    """
    healthy = row.get("healthy", {}).get(name, {}).get(key)
    if healthy is None:
        return injected
    neutral = next(parameter.neutral for parameter in CATALOGUE[name].parameters if parameter.name == key)
    if not np.isfinite(neutral):
        return min(injected, healthy)
    return injected * healthy if neutral == 1.0 else injected + healthy


def covered(row: Row) -> list[bool]:
    """For each parameter with a known truth, whether the interval of the effect of that name contains it."""
    results = []
    for hidden in row["hidden"]:
        if hidden["onset_s"]:
            continue
        for effect in named(row):
            if effect["name"] != hidden["name"]:
                continue
            for key in hidden["estimated"]:
                parameter = effect["parameters"].get(key)
                if parameter is not None:
                    truth = true_value(row, effect["name"], key, hidden["values"][key])
                    results.append(parameter["low"] <= truth <= parameter["high"])
    return results


METRICS = ("position_2s", "heading_2s")


def closed_share(gap: dict[str, dict], healthy: Mapping[str, float] | None = None) -> float | None:
    """Closed share of the reducible gap after 2 s in the metric with the largest error over its noise.

    0 where nothing was added to the model; None where the error is within 10 % of its noise, so that there is no gap.

    Args:
        gap: errors by metric.
        healthy: error of the healthy robot by metric, which no effect reduces, to be taken for the noise where it is
            larger; None where its metric is unknown.
    """
    entries = {key: gap[key] for key in METRICS if key in gap and gap[key]["before"] > 1.1 * gap[key]["noise"]}
    if not entries:
        return None
    metric = max(entries, key=lambda key: entries[key]["before"] / max(entries[key]["noise"], 1e-6))
    worst, least = entries[metric], entries[metric]["noise"]
    if healthy is not None:
        if metric not in healthy:
            return None
        least = max(least, healthy[metric])
        if worst["before"] <= 1.1 * least:
            return None
    after = worst["before"] if worst["after"] is None else worst["after"]
    return (worst["before"] - after) / (worst["before"] - least)


def healthy_errors(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Errors of each platform's healthy robot by metric: the mean over its empty drives, as the model is without
    effects."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row["kind"] == "empty":
            for metric in METRICS:
                if metric in row.get("gap", {}):
                    errors = found.setdefault(platform_of(row), {}).setdefault(metric, [])
                    errors.append(row["gap"][metric]["before"])
    return {name: {metric: float(np.mean(part)) for metric, part in errors.items()} for name, errors in found.items()}


def platform_of(row: Row) -> str:
    """Name of a row's platform: engine, ground and seed."""
    return "-".join(row["case"].split("-")[:3])


def share(part: Sequence[object], whole: Sequence[object]) -> dict:
    """A share with its exact 95 % interval (Clopper and Pearson 1934)."""
    count, total = len(part), len(whole)
    if not total:
        return {"share": None, "count": 0, "of": 0}
    low, high = binomtest(count, total).proportion_ci()
    return {"share": count / total, "count": count, "of": total, "low": float(low), "high": float(high)}


def _median(values: Sequence[float]) -> dict:
    if not values:
        return {"median": None, "of": 0}
    return {"median": float(np.median(values)), "mean": float(np.mean(np.clip(values, -1, 1))), "of": len(values)}


def scores(rows: Sequence[Row]) -> dict[str, dict]:
    """The scores of some rows."""
    of_kind = {kind: [row for row in rows if row["kind"] == kind] for kind in ("empty", "single", "pair", "outside")}
    stuck = [row for row in rows if row["kind"] == "stuck"]
    empty, singles, pairs, outside = of_kind.values()
    hidden = [*singles, *pairs, *outside]
    right = [row for row in (*singles, *pairs) if found_all(row)]
    inside = [hit for row in rows for hit in covered(row)]
    closed = [value for row in hidden if (value := closed_share(row.get("gap", {}))) is not None]
    errors = healthy_errors(empty)
    above = [
        value
        for row in hidden
        if (value := closed_share(row.get("gap", {}), errors.get(platform_of(row), {}))) is not None
    ]
    checked = [
        value
        for row in hidden
        for table in row.get("held_out", {}).values()
        if (value := closed_share(table)) is not None
    ]
    sizes = [row["numbers"] for row in empty if "loss_of_a_healthy_robot" in row.get("numbers", {})]
    logarithms = [np.log(size["loss_before"] / size["loss_of_a_healthy_robot"]) for size in sizes]
    ratios = [row["numbers"]["variance_ratio"] for row in empty if "variance_ratio" in row.get("numbers", {})]
    return {
        "variance_ratio": {"value": float(np.mean(ratios)) if ratios else None, "of": len(ratios)},
        # Compare with those of discrepancy/thresholds.py.
        "drive_spread": {"value": float(np.sqrt(np.mean(np.square(logarithms)))) if sizes else None, "of": len(sizes)},
        "singles_named": share([row for row in singles if found_all(row)], singles),
        "singles_named_exactly": share([row for row in singles if named_exactly(row)], singles),
        "pairs_named": share([row for row in pairs if found_all(row)], pairs),
        "false_alarms": share([row for row in empty if row["verdict"] != "no_discrepancy"], empty),
        "empty_named": share([row for row in empty if named(row)], empty),
        "outside_named": share([row for row in outside if named(row)], outside),
        "outside_unknown": share([row for row in outside if row["verdict"] == "unknown_effect"], outside),
        "wheels_in_the_air_misnamed": share(
            [row for row in stuck if any(not says(effect, row["hidden"][0]) for effect in named(row))], stuck
        ),
        "extra_effects": share([row for row in right if len(named(row)) > len(row["hidden"])], right),
        "intervals_with_truth": share([hit for hit in inside if hit], inside),
        "gap_closed": _median(closed),
        "gap_closed_above_healthy": _median(above),
        "gap_closed_on_second_drive": _median(checked),
        "not_diagnosed": share([row for row in rows if row["verdict"] in ("error", "not_identifiable")], rows),
        "seconds": _median([row["seconds"] for row in rows]) | {"mean": None},
        "processor_seconds": _median([row["cpu_seconds"] for row in rows]) | {"mean": None},
    }


TARGETS = {
    "singles_named": "≥ 90 %", "pairs_named": "≥ 85 %", "false_alarms": "1 to 5 %", "outside_named": "≤ 15 %",
    "extra_effects": "≤ 10 %", "intervals_with_truth": "≥ 90 %", "gap_closed": "≥ 80 %", "seconds": "≤ 60 s",
}  # fmt: skip
TITLES = {
    "singles_named": "single effects named (first; its class counts)",
    "singles_named_exactly": "… by exactly the injected name",
    "pairs_named": "pairs, both named",
    "false_alarms": "false alarms: any verdict but no_discrepancy on empty drives",
    "empty_named": "… an effect named",
    "outside_named": "outside the catalogue, yet an effect named",
    "outside_unknown": "… unknown_effect",
    "wheels_in_the_air_misnamed": "wheels in the air, yet another effect named",
    "extra_effects": "more effects than hidden ones, of the rightly named",
    "intervals_with_truth": "95 % intervals that contain the truth",
    "gap_closed": "reducible gap closed, cross-validated, median over all drives with something hidden",
    "gap_closed_above_healthy": "… of the part above the healthy robot's error on its empty drives",
    "gap_closed_on_second_drive": "… on a second drive with the same effect",
    "not_diagnosed": "no diagnosis (counts as missed)",
    "seconds": "time of a diagnosis of 60 s, median",
    "processor_seconds": "… processor time",
}


def table(rows: Sequence[Row]) -> str:
    """Scores of all rows and by engine as a Markdown table."""
    columns = {"all": list(rows)} | {engine: [r for r in rows if r["engine"] == engine] for engine in ENGINES}
    found = {name: scores(part) for name, part in columns.items()}
    lines = ["| score | target | " + " | ".join(columns) + " |", "|---|---|" + "---|" * len(columns)]
    for key, title in TITLES.items():
        cells = [score_cell(key, found[name][key]) for name in columns]
        lines.append(f"| {title} | {TARGETS.get(key, '–')} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def score_cell(key: str, entry: dict) -> str:
    """A score of a key of :data:`TITLES` as a cell of a table."""
    if not entry["of"]:
        return "–"
    if "median" in entry:
        value = entry["median"]
        text = f"{value:.0f} s" if "seconds" in key else f"{100 * value:.0f} %"
        return f"{text} of {entry['of']}"
    low, high = 100 * entry["low"], 100 * entry["high"]
    return f"{100 * entry['share']:.0f} % [{low:.0f}, {high:.0f}] ({entry['count']}/{entry['of']})"


def row_line(row: Row) -> str:
    """One line for a terminal."""
    effects = [
        f"{effect['name']}(" + ", ".join(f"{k} {v['value']:.3g}" for k, v in effect["parameters"].items()) + ")"
        for effect in row.get("effects", [])
    ]
    if row["kind"] == "empty":
        mark = "ok " if row["verdict"] == "no_discrepancy" else "BAD"
    elif row["kind"] in ("single", "pair"):
        mark = "ok " if found_all(row) else "BAD"
    else:
        mark = "ok " if not named(row) else "BAD"
    values = [
        f"{hidden['name']} " + " ".join(f"{key} {value:.3g}" for key, value in hidden["values"].items())
        for hidden in row["hidden"]
    ]
    answer = f"{' + '.join(values)} → {' + '.join(effects)}"
    return f"{mark} {row['case']:64s} {row['verdict']:16s} {row['seconds']:4.0f} s  {answer}"
