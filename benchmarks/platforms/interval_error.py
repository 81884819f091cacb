"""How far values of effects are from the truth, beyond their intervals, where the effects are hidden in another engine.

    scripts/run.sh python benchmarks/platforms/interval_error.py --results out/platforms/results/LABEL [LABEL ...]

Prints which share of the 95 % intervals would hold the truth if values had a further error, proportional to the size of
their effects: it calibrates ``formula_error`` of ``discrepancy/thresholds.py``. Needs results of run.py for choosing;
of a case with several results the last counts.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from benchmark_score import platform_of, true_value
from diagnosis_run import commissioned_file, healthy_values

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.estimates import effect_sizes
from monoforce_ros.discrepancy.fit import neutral_values
from monoforce_ros.discrepancy.thresholds import Thresholds

SHARES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""Errors as shares of the size of an effect."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, nargs="+", required=True, help="folders of results of run.py")
    parser.add_argument(
        "--included", type=float, default=Thresholds().formula_error,
        help="formula_error of the code that was judged: it is taken out of its intervals (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, help="write the values to this file")
    options = parser.parse_args()
    cases = {
        file.name: _row(file, folder)
        for folder in options.results
        for file in sorted((folder / "cases").glob("*.json"))
    }
    rows = [row for case in cases.values() for row in values_of(case, options.included)]
    if not rows:
        print(f"no effect with a known value was named in {options.results}: run run.py", file=sys.stderr)
        return 1
    for row in rows:
        print("{case:60s} {parameter:34s} {truth:10.4g} {value:10.4g} ± {half_width:.2g}".format(**row))
    print(f"\n{len(rows)} values; share of intervals with the truth, if their formulas' error is")
    for share in SHARES:
        print(f"  {share:5.2f} of the effect: {100 * coverage(rows, share):.0f} %")
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def _row(file: Path, folder: Path) -> dict:
    """A row, with the values of the healthy robot also where an earlier version of run.py wrote it."""
    row = json.loads(file.read_text())
    nominal = commissioned_file(folder / "nominal" / platform_of(row))
    if "healthy" not in row and nominal is not None:
        row["healthy"] = healthy_values(nominal)
    return row


def values_of(case: dict, included: float) -> list[dict]:
    """Values that were named rightly, with half widths of their intervals without the error that is included."""
    rows = []
    for hidden in case.get("hidden", []):
        for effect in case.get("effects", []):
            if effect["name"] != hidden["name"]:
                continue
            values = {key: found["value"] for key, found in effect["parameters"].items()}
            healthy = case.get("healthy", {}).get(effect["name"], {})
            neutral = neutral_values(((effect["name"], values),))
            own = np.array([healthy.get(key, none) for key, none in zip(values, neutral, strict=True)])
            sizes = effect_sizes(effect["name"], values, own)
            for key, size in zip(values, sizes, strict=True):
                if key not in hidden["estimated"]:
                    continue
                found = effect["parameters"][key]
                half_width = 0.5 * (found["high"] - found["low"])
                rows.append(
                    {
                        "case": case["case"],
                        "parameter": f"{effect['name']} {key}",
                        "truth": true_value(case, effect["name"], key, hidden["values"][key]),
                        "value": found["value"],
                        "half_width": float(np.sqrt(max(half_width**2 - (2.0 * included * size) ** 2, 0.0))),
                        "size": float(size),
                    }
                )
    return rows


def coverage(rows: list[dict], share: float) -> float:
    """Share of the intervals that hold the truth with a further error of a share of each effect's size."""
    inside = [abs(r["truth"] - r["value"]) <= np.hypot(r["half_width"], 2.0 * share * r["size"]) for r in rows]
    return float(np.mean(inside))


if __name__ == "__main__":
    sys.exit(main())
