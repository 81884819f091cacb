"""Case rows: options and loop of the commands that measure something on recorded drives of commissioned platforms."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from benchmark_case import SETS, Case, all_cases
from case_recording import CaseFiles
from diagnosis_run import commissioned_file
from tqdm import tqdm


def add_case_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose drives and the file of the rows."""
    parser.add_argument("--work", type=Path, default=Path("out/platforms"), help="folder of run.py (out/platforms)")
    parser.add_argument("--label", required=True, help="results of run.py whose commissioned platforms are used")
    parser.add_argument("--set", choices=sorted(SETS), default="choosing", help="set of seeds (choosing)")
    parser.add_argument("--cases", nargs="+", default=[""], metavar="TEXT", help="only names with one of these")
    parser.add_argument("--json", type=Path, help="write the rows to this file")


def measured_rows(
    options: argparse.Namespace,
    kinds: Sequence[str],
    measured: Callable[[Case, CaseFiles, Path], dict | None],
    line: Callable[[dict], str],
) -> list[dict]:
    """A row for every recorded drive of a commissioned platform; says so on standard error where there is none.

    Args:
        options: of :func:`add_case_arguments`.
        kinds: of drives.
        measured: the row of a drive and the commissioned file of its platform; None where there is nothing to measure.
        line: a row as one line, which is printed.
    """
    torch.set_num_threads(1)
    rows = []
    cases = [
        case
        for case in all_cases(options.set)
        if case.kind in kinds and any(text in case.name for text in options.cases)
    ]
    for case in tqdm(cases, unit="drive"):
        files = CaseFiles.of(case, options.work)
        nominal = commissioned_file(options.work / "results" / options.label / "nominal" / case.platform_name)
        row = measured(case, files, nominal) if files.truth.exists() and nominal is not None else None
        if row is not None:
            rows.append(row)
            tqdm.write(line(row))
    if not rows:
        print(f"no drive of these kinds is recorded and commissioned in {options.work}: run run.py", file=sys.stderr)
    return rows
