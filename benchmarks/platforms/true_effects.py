"""How well the formulas of the catalogue hold where their own effects are hidden in another engine.

    scripts/run.sh python benchmarks/platforms/true_effects.py --work out/platforms --label LABEL --kind single pair

Fits the effects that are truly hidden in recorded drives, without a search, and prints for each drive which share of
what exceeds a healthy robot's loss they explain, and how large their formula's error is beside what they change. The
numbers calibrate ``explained_share`` and ``model_error`` of ``discrepancy/thresholds.py``. Outside the catalogue
nothing true can be fitted: there the effects that a search selects are measured, which should explain less.
Needs recordings and commissioned platforms: run.py makes both.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from benchmark_case import Case
from case_recording import CaseFiles
from case_rows import add_case_arguments, measured_rows
from case_search import search_of

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.fit import first_values, fit_effects
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import excess_share
from monoforce_ros.effects import CATALOGUE

KINDS = ("single", "pair", "outside")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_case_arguments(parser)
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=["single"], help="kinds of drives (single)")
    options = parser.parse_args()
    rows = measured_rows(options, options.kind, measured, row_line)
    if not rows:
        return 1
    for kind in options.kind:
        print(summary(kind, [row for row in rows if row["kind"] == kind]))
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def measured(case: Case, files: CaseFiles, nominal_file: Path) -> dict | None:
    """The row of a drive; None where nothing can be fitted to it."""
    truth = json.loads(files.truth.read_text())
    if not truth["usable"]:
        return None
    # A late effect explains what is measured after its onset.
    onset = max((entry["onset_s"] for entry in truth["hidden"]), default=0.0)
    search = search_of(files, nominal_file, onset)
    if search is None or search.nominal is None:
        return None
    nominal = search.nominal
    effects = selected(search) if case.kind == "outside" else fitted_truth(search, truth["hidden"])
    if not effects:
        return None
    trial = search.judge(effects)
    before = float(search.loss_of(()).mean())
    change = 0.5 * search.directions.mean_square(search.refit(trial.effects).effects, 0)
    return {
        "case": case.name,
        "kind": case.kind,
        "hidden": [entry["name"] for entry in truth["hidden"]],
        "fitted": list(trial.names),
        "healthy": nominal.loss,
        "before": before,
        "after": trial.loss,
        # A loss within the spread of healthy drives has no excess to explain.
        "visible": before > nominal.loss * float(np.exp(search.thresholds.drive_spread)),
        "explained": excess_share(before, trial.loss, nominal.loss),
        "error": float(np.sqrt(max(trial.loss - nominal.loss, 0.0) / max(change, 1e-9))),
    }


def fitted_truth(search: Search, hidden: list[dict]) -> Effects:
    """The hidden effects, each as the one of its class that fits best; empty where the catalogue has none."""
    base: Effects = ()
    for entry in hidden:
        names = [name for name in entry["names"] if name in CATALOGUE and CATALOGUE[name].identified]
        fits = [
            fit_effects(
                search.predictions,
                [base + start for start in first_values(CATALOGUE[name], search.robot)],
                search.scale,
                iterations=6,
            )
            for name in names
        ]
        if not fits:
            return ()
        base = min(fits, key=lambda fit: float(fit.loss.mean())).effects
    return base


def selected(search: Search) -> Effects:
    """What a search selects where nothing of the catalogue is hidden."""
    return search.run(4, exchange=False).best.effects


def row_line(row: dict) -> str:
    """One line about a drive."""
    share = f"{100 * row['explained']:4.0f} %" if row["visible"] else "   – "
    return f"{row['case']:60s} {'+'.join(row['fitted']):40s} explain {share}, error {100 * row['error']:4.0f} %"


def summary(kind: str, rows: list[dict]) -> str:
    """The spread over drives whose error is visible at all."""
    visible = [row for row in rows if row["visible"]]
    if not visible:
        return f"{kind}: none of {len(rows)} drives exceeds the healthy robot's loss visibly"
    text = f"{kind}: {len(visible)} of {len(rows)} drives visible"
    for key, words in (("explained", "share explained"), ("error", "error of the formula")):
        low, middle, high = np.quantile([row[key] for row in visible], (0.1, 0.5, 0.9))
        text += f"; {words}: 10 % quantile {low:.2f}, median {middle:.2f}, 90 % quantile {high:.2f}"
    return text


if __name__ == "__main__":
    sys.exit(main())
