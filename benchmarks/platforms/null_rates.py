"""How often healthy drives would raise a false alarm, by ``drive_share`` and by ``drive_spread``.

    scripts/run.sh python benchmarks/platforms/null_rates.py --work out/platforms --label LABEL

For every recorded drive it prints the adjusted p-value of the most significant effect alone, for several values of the
variance between healthy drives of one robot as a share of that between segments of its commissioning drive
(``drive_share`` of ``discrepancy/thresholds.py``), and for all drives the share below ``effect_rate``. The smallest
value at which healthy drives stay above that rate as often as stated is the one to choose. So it is with
``drive_spread``, by which losses of healthy drives differ beyond what their blocks and the segments of the
commissioning drive explain: it prints how many drives are too large at half of ``fit_rate``.
Needs recordings and commissioned platforms: run.py makes both.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmark_case import CASE_KINDS, Case
from case_recording import CaseFiles
from case_rows import add_case_arguments, measured_rows
from case_search import search_of

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.residual_size import residual_size
from monoforce_ros.discrepancy.thresholds import Thresholds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_case_arguments(parser)
    parser.add_argument(
        "--kind", choices=CASE_KINDS, nargs="+", default=["empty", "single"], help="kinds of drives (empty single)"
    )
    parser.add_argument(
        "--shares", type=float, nargs="+", default=[0.0, 0.1, 0.25, 0.5, 0.8, 1.25], help="values of drive_share"
    )
    parser.add_argument(
        "--spreads", type=float, nargs="+", default=[0.1, 0.15, 0.175, 0.2, 0.25, 0.3], help="values of drive_spread"
    )
    options = parser.parse_args()
    rows = measured_rows(
        options,
        options.kind,
        lambda case, files, nominal: measured(case, files, nominal, options.shares, options.spreads),
        row_line,
    )
    if not rows:
        return 1
    for kind in options.kind:
        print(summary(kind, [row for row in rows if row["kind"] == kind], options.shares, options.spreads))
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def measured(
    case: Case, files: CaseFiles, nominal_file: Path, shares: Sequence[float], spreads: Sequence[float]
) -> dict | None:
    """The row of a drive; None where nothing can be compared."""
    truth = json.loads(files.truth.read_text())
    search = search_of(files, nominal_file) if truth["usable"] else None
    if search is None or search.nominal is None:
        return None
    smallest = []
    for share in shares:
        results = search.screening.tested_as_if(search.known, replace(search.thresholds, drive_share=share))
        best = min(results, key=lambda result: result.adjusted)
        smallest.append((best.name, best.adjusted))
    losses, healthy = search.loss_of(()), search.nominal
    sizes = [
        residual_size(
            losses, search.data.starts, healthy.loss, healthy, replace(search.thresholds, drive_spread=spread)
        )
        for spread in spreads
    ]
    return {
        "case": case.name,
        "kind": case.kind,
        "hidden": [entry["name"] for entry in truth["hidden"]],
        "loss_ratio": float(losses.mean()) / healthy.loss,
        "sizes": [size.p for size in sizes],
        "smallest": smallest,
    }


def row_line(row: dict) -> str:
    """One line about a drive."""
    hidden = "+".join(row["hidden"]) or "nothing"
    text = ", ".join(f"{p:.3f} {name}" for name, p in row["smallest"])
    return f"{row['case']:44s} {hidden:24s} loss {row['loss_ratio']:5.2f} of healthy: {text}"


def summary(kind: str, rows: Sequence[dict], shares: Sequence[float], spreads: Sequence[float]) -> str:
    """Numbers of drives with a significant effect, and of those whose residuals are too large."""
    if not rows:
        return f"{kind}: no drive"
    rate = Thresholds().effect_rate
    text = f"{kind}: of {len(rows)} drives with an effect below {rate:g}:"
    for number, share in enumerate(shares):
        text += f" {sum(row['smallest'][number][1] <= rate for row in rows)} at {share:g},"
    rate = 0.5 * Thresholds().fit_rate
    text = f"{text[:-1]}; too large at {rate:g}:"
    for number, spread in enumerate(spreads):
        text += f" {sum(row['sizes'][number] <= rate for row in rows)} at {spread:g},"
    logarithms = np.log([row["loss_ratio"] for row in rows])
    return f"{text[:-1]}; RMS of the logarithm of the loss ratio {float(np.sqrt(np.mean(logarithms**2))):.2f}"


if __name__ == "__main__":
    sys.exit(main())
