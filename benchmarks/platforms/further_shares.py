"""What further effects of a diagnosis explain, beside those that were found before them.

    scripts/run.sh python benchmarks/platforms/further_shares.py --results out/platforms/results/LABEL [LABEL ...]

Prints, for every effect but the first, its gain as a share of what the effects found so far explain, and whether it is
hidden in the drive: it calibrates ``further_share`` of ``discrepancy/thresholds.py``. Needs results and reports of
run.py for choosing, of code with a ``further_share`` of 0; of a case with several results the last counts.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from benchmark_score import named, says

from monoforce_ros.core import write_text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, nargs="+", required=True, help="folders of results of run.py")
    parser.add_argument("--json", type=Path, help="write the values to this file")
    options = parser.parse_args()
    cases: dict[str, list[dict]] = {}
    for folder in options.results:
        for file in sorted((folder / "cases").glob("*.json")):
            case = json.loads(file.read_text())
            report = folder / "reports" / case["case"] / "report.json"
            if report.is_file():
                cases[file.name] = further_effects(case, json.loads(report.read_text()))
    rows = [row for found in cases.values() for row in found]
    if not rows:
        print(f"no diagnosis with several effects in {options.results}: run run.py", file=sys.stderr)
        return 1
    for row in sorted(rows, key=lambda row: row["share"]):
        hidden = "hidden" if row["hidden"] else "not there"
        print(f"{row['share']:6.3f} {hidden:9s} {row['effect']:22s} {row['case']}")
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    return 0


def further_effects(case: dict, report: dict) -> list[dict]:
    """Effects of a diagnosis that were found in a later round than the first.

    An effect that was exchanged for another one, which the recording does not distinguish from it, has the gain of that
    one. A hidden effect counts for one effect of the report.
    """
    gains: dict[str, dict[int, float]] = {}
    for candidate in report["candidates"]:
        if candidate["judged"]:
            gains.setdefault(candidate["name"], {})[candidate["round"]] = candidate["gain"]
    found, taken = [], set()
    left = list(case["hidden"])
    for effect in named(case):
        is_hidden = next((hidden for hidden in left if says(effect, hidden)), None)
        if is_hidden is not None:
            left.remove(is_hidden)
        # Judged in several rounds, it was added in the last one that no other effect was added in.
        rounds = [
            (name, max(free))
            for name in (effect["name"], *effect["indistinguishable"])
            if (free := [number for number, gain in gains.get(name, {}).items() if number not in taken and gain > 0])
        ]
        if rounds:
            name, number = rounds[0]
            taken.add(number)
            found.append((number, gains[name][number], effect["name"], is_hidden is not None))
    found.sort()
    rows, explained = [], 0.0
    for position, (_, gain, name, hidden) in enumerate(found):
        if position:
            rows.append({"case": case["case"], "effect": name, "hidden": hidden, "share": gain / max(explained, 1e-9)})
        explained += gain
    return rows


if __name__ == "__main__":
    sys.exit(main())
