"""How healthy robots follow commands that change harder than in their commissioning drive.

    scripts/run.sh python benchmarks/platforms/uncovered_changes.py --work out/platforms --label LABEL

For several response times (``RESPONSE_TIME`` of ``discrepancy/command_changes.py``) it prints the spread of
the logarithm of the loss ratio over the empty drives whose commands change harder than covered, and beside it that of
the other empty drives. The value with the smallest spread is the one to choose.
Needs recordings and commissioned platforms: run.py makes both.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from benchmark_case import Case
from case_recording import CaseFiles
from case_rows import add_case_arguments, measured_rows
from case_search import search_of

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy import command_changes
from monoforce_ros.discrepancy.fit import robust

_HARDER = 0.3
"""Change beyond the covered one from which a drive counts as harder [m/s, rad/s]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_case_arguments(parser)
    parser.add_argument(
        "--times", type=float, nargs="+", default=[0.0, 0.04, 0.05, 0.06, 0.08, 0.1], help="response times [s]"
    )
    options = parser.parse_args()
    rows = measured_rows(
        options, ("empty",), lambda case, files, nominal: measured(case, files, nominal, options.times), row_line
    )
    if not rows:
        return 1
    for harder in (True, False):
        chosen = [row for row in rows if (row["harder"] > _HARDER) == harder]
        if not chosen:
            continue
        logarithms = np.log([row["loss_ratios"] for row in chosen])
        kind = "harder than commissioned" if harder else "as commissioned"
        for time, values in zip(options.times, logarithms.T, strict=True):
            print(
                f"{len(chosen)} drives {kind}, response time {time:.2f} s: logarithm of the loss ratio "
                f"{np.mean(values):+.2f} mean, {np.sqrt(np.mean(values**2)):.2f} RMS"
            )
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def row_line(row: dict) -> str:
    """One line about a drive."""
    ratios = ", ".join(f"{ratio:.2f}" for ratio in row["loss_ratios"])
    return f"{row['case']:32s} {row['harder']:4.2f} harder, loss of healthy: {ratios}"


def measured(case: Case, files: CaseFiles, nominal_file: Path, times: Sequence[float]) -> dict | None:
    """The row of a drive; None where nothing can be compared."""
    search = search_of(files, nominal_file) if json.loads(files.truth.read_text())["usable"] else None
    if search is None or search.nominal is None or search.nominal.changes is None:
        return None
    nominal, data = search.nominal, search.data
    residuals = np.nan_to_num(search.predictions.residuals([()])[0])
    uncovered = command_changes.uncovered_residual(data, nominal.changes)
    known = np.maximum(search.scale**2 - uncovered**2, 0.0)
    scales = [np.sqrt(known + (time / command_changes.RESPONSE_TIME * uncovered) ** 2) for time in times]
    beyond = command_changes.largest_changes(data)[:, -1] - nominal.changes
    return {
        "case": case.name,
        "harder": float(beyond.max()),
        "loss_ratios": [float(robust(residuals / scale).mean()) / nominal.loss for scale in scales],
    }


if __name__ == "__main__":
    sys.exit(main())
