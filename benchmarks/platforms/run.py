"""Judge ``diagnose`` on drives of platforms drawn at random, recorded by two engines unrelated to the package.

    scripts/run.sh python benchmarks/platforms/run.py --work out/platforms --set choosing --kind empty --limit 10

Recordings are made once; a case whose result exists is not diagnosed again. Results are kept by version of the judged
code. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from benchmark_case import CASE_KINDS, ENGINES, SETS, WORLD_GROUNDS, Case, all_cases
from benchmark_score import ENGINES as SCORED
from benchmark_score import row_line, scores, table
from case_recording import CaseFiles, record_platform, record_together
from diagnosis_run import (
    ABLATIONS,
    Judged,
    add_baselines,
    code_version,
    commission_platform,
    diagnose_case,
    forget,
    has_result,
)
from drive_session import DriveJob, Trace
from method_table import ablation_table, baseline_table
from reporting_ledger import LEDGER, ReportedPlatforms, add_to_ledger, reported_before
from tqdm import tqdm

from monoforce_ros.core import write_text
from monoforce_ros.reporting import write_between

QUICK_PLATFORMS = 6
"""Of ``--quick``, alternating between the engines."""


BASELINE_DRIVES = 20
"""Single effects of ``--baselines``, and half as many pairs: some 140 s of a processor each."""
ABLATION_PLATFORMS = 16
"""Platforms of ``--ablations``."""


def main() -> int:
    options = build_parser().parse_args()
    cases = chosen_cases(options)
    if not cases:
        print("no case matches the options", file=sys.stderr)
        return 1
    code = options.code.resolve()
    label = options.label or code_version(code)
    reported = reported_before(cases, label, options.ledger) if options.set == "reporting" else []
    if reported and not (options.again or options.record_only):
        print(refusal(reported), file=sys.stderr)
        return 1
    began = time.monotonic()
    record(cases, options)
    if options.record_only:
        return 0
    spent = {"recording": time.monotonic() - began}
    results = options.work / "results" / "-".join(part for part in (label, options.without) if part)
    judged = Judged(code, results, options.without or "", options.timeout)
    print(f"{len(cases)} cases, code {code} ({label}), results in {results}", flush=True)
    seen = _listing(label, options)
    # Of an earlier call, which may have been interrupted.
    seen([case for case in cases if has_result(case, judged)])
    if options.again:
        for case in cases:
            forget(case, judged)
    began = time.monotonic()
    rows = in_parallel(cases, options, judged, seen)
    spent["diagnoses"] = time.monotonic() - began
    if options.baselines:
        began = time.monotonic()
        rows = with_baselines(rows, cases, options, judged)
        spent["baselines"] = time.monotonic() - began
    began = time.monotonic()
    ablated = without_sensors(cases, options, judged) if options.ablations else {}
    if ablated:
        spent["ablations"] = time.monotonic() - began
    if reported:
        rows = [row | {"independent": False} for row in rows]
    rows.sort(key=lambda row: (CASE_KINDS.index(row["kind"]), row["case"]))
    text = "\n\n".join(sections(rows, ablated, options, spent, independent=not reported))
    print("\n" + text)
    if options.json:
        found = {"all": scores(rows)}
        found |= {engine: scores([row for row in rows if row["engine"] == engine]) for engine in SCORED}
        found |= {f"without {sensor}": scores(part) for sensor, part in ablated.items()}
        content = {"label": label, "scores": found, "rows": rows, "without": ablated, "seconds": spent}
        write_text(options.json, json.dumps(content, indent=1) + "\n")
    if options.docs:
        write_between(options.docs, "platforms", text)
    if options.set == "reporting":
        print(f"listed as reported in {options.ledger}: commit it")
    return 0


def _listing(label: str, options: argparse.Namespace) -> Callable[[Sequence[Case]], None]:
    """What lists platforms as reported by this code before their results are shown: whoever has seen these may change
    the code for them."""
    date = datetime.now(UTC).date().isoformat()

    def listed(cases: Sequence[Case]) -> None:
        if options.set == "reporting":
            add_to_ledger(cases, label, date, options.ledger)

    return listed


def refusal(reported: Sequence[ReportedPlatforms]) -> str:
    """Why platforms are not reported by other code again."""
    entries = ", ".join(f"{e.engine} {e.first} to {e.last} ({e.date}, code {e.code})" for e in reported)
    return (
        f"these platforms were reported before: {entries}. Their figures have been seen, so that a second one is not "
        "independent. Set the first seed of SETS and WORLDS in benchmark_case.py behind them, or say --again, which "
        "marks every row and the table as not independent"
    )


def sections(
    rows: Sequence[dict],
    ablated: dict[str, list[dict]],
    options: argparse.Namespace,
    spent: dict[str, float],
    *,
    independent: bool,
) -> list[str]:
    """The tables, and what they took."""
    parts = [] if independent else ["**Not independent**: these platforms had been reported before."]
    parts.append(table(rows))
    if options.baselines:
        parts.append(baseline_table(rows))
    if ablated:
        parts.append(ablation_table(rows, ablated))
    processor = sum(row["cpu_seconds"] for rows_of in (rows, *ablated.values()) for row in rows_of)
    now = ", ".join(f"{name} {seconds / 60:.0f} min" for name, seconds in spent.items())
    parts.append(
        f"{len(rows)} drives; the diagnoses took {processor / 3600:.1f} h of a processor. This call, with "
        f"{options.jobs} at a time and what was kept of earlier ones: {now}."
    )
    return parts


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("out/platforms"), help="folder of all files (%(default)s)")
    parser.add_argument("--set", choices=SETS, default="choosing", help="set of seeds (%(default)s)")
    parser.add_argument("--engine", choices=(*ENGINES, "worlds"), help="only recordings of this engine")
    parser.add_argument("--ground", choices=("level", "hills", *WORLD_GROUNDS), help="only recordings on this ground")
    parser.add_argument("--kind", choices=CASE_KINDS, nargs="+", default=CASE_KINDS, help="only cases of these kinds")
    parser.add_argument("--cases", nargs="+", default=[""], metavar="TEXT", help="only names with one of these")
    parser.add_argument("--limit", type=int, metavar="N", help="only the first N of them")
    parser.add_argument("--platforms", type=int, metavar="N", help="only the first N platforms of the set")
    parser.add_argument("--quick", action="store_true", help=f"only the first {QUICK_PLATFORMS} platforms")
    parser.add_argument("--without", choices=ABLATIONS, help="take this sensor out of every recording")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--timeout", type=float, default=300.0, help="of a diagnosis [s] (%(default)s)")
    parser.add_argument("--record-only", action="store_true", help="record, do not diagnose")
    parser.add_argument(
        "--again",
        action="store_true",
        help="diagnose again where a result exists; of platforms that were reported before, as not independent",
    )
    parser.add_argument("--ledger", type=Path, default=LEDGER, help="list of the platforms that were reported")
    parser.add_argument(
        "--code", type=Path, default=Path(__file__).parents[2], help="repository to judge (the one of this file)"
    )
    parser.add_argument("--label", help="name of the results' folder (by default a fingerprint of the code)")
    parser.add_argument(
        "--baselines",
        type=int,
        nargs="?",
        const=BASELINE_DRIVES,
        metavar="N",
        help="compare with other methods on the first N single effects and N/2 pairs (%(const)s)",
    )
    parser.add_argument(
        "--ablations",
        type=int,
        nargs="?",
        const=ABLATION_PLATFORMS,
        metavar="N",
        help="diagnose the drives of the first N platforms once more without wheel speeds and without IMU (%(const)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write rows and scores to this file")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the table into this document")
    return parser


def chosen_cases(options: argparse.Namespace) -> list[Case]:
    """The cases that the options select."""
    platforms = QUICK_PLATFORMS if options.quick else options.platforms
    listed = all_cases(options.set)
    seeds = list(dict.fromkeys(case.platform_seed for case in listed))[:platforms]
    cases = [
        case
        for case in listed
        if case.platform_seed in seeds
        and case.kind in options.kind
        and options.engine in (None, case.engine)
        and options.ground in (None, case.ground)
        and any(text in case.name for text in options.cases)
    ]
    return cases[: options.limit]


def record(cases: Sequence[Case], options: argparse.Namespace) -> None:
    """Record what is missing."""
    missing: dict[str, list[Case]] = {}
    for case in cases:
        if not CaseFiles.of(case, options.work).truth.exists():
            missing.setdefault(case.platform_name, []).append(case)
    newton = [platform for platform in missing.values() if platform[0].engine == "newton"]
    if newton:
        # One process and one model for each job: a step costs the same for one robot as for a hundred.
        parts = [part for part in (newton[number :: options.jobs] for number in range(options.jobs)) if part]
        with _pool(options.jobs) as pool:
            print(f"record {len(newton)} platforms with newton", flush=True)
            for done in as_completed([pool.submit(_record_with_newton, part, options.work) for part in parts]):
                done.result()
    jobs = [platform for platform in missing.values() if platform[0].engine != "newton"]
    with _pool(options.jobs) as pool, tqdm(total=len(jobs), desc="record", unit="platform", disable=not jobs) as bar:
        for done in as_completed([pool.submit(_record_alone, platform, options.work) for platform in jobs]):
            done.result()
            bar.update()


def _record_alone(platform: Sequence[Case], work: Path) -> None:
    if platform[0].engine == "worlds":
        from world_recording import record_world

        record_world(platform, work)
    else:
        record_platform(platform, work)


def _record_with_newton(platforms: Sequence[Sequence[Case]], work: Path) -> None:
    import newton_engine

    def simulate(jobs: Sequence[DriveJob]) -> list[Trace]:
        longest = max(job.duration for job in jobs)
        with tqdm(total=round(longest), desc=f"newton, {len(jobs)} drives", unit="s", mininterval=5.0) as bar:
            return newton_engine.simulate_together(jobs, bar.update)

    record_together(platforms, work, simulate)


def in_parallel(
    cases: Sequence[Case],
    options: argparse.Namespace,
    judged: Judged,
    seen: Callable[[Sequence[Case]], None] = lambda cases: None,
) -> list[dict]:
    """The rows of the cases that can be judged; each platform is commissioned before its first case.

    ``seen`` gets the cases of a platform before a row of it is shown.
    """
    platforms: dict[str, list[Case]] = {}
    for case in cases:
        platforms.setdefault(case.platform_name, []).append(case)
    rows: list[dict] = []
    with _pool(options.jobs) as pool, tqdm(total=len(cases), desc="diagnose", unit="case") as bar:
        waiting = {
            pool.submit(commission_platform, platform[0], options.work, judged): platform
            for platform in platforms.values()
        }
        running: set[Future] = set(waiting)
        while running:
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for done in finished:
                result = done.result()
                if done in waiting:
                    running |= {pool.submit(diagnose_case, case, options.work, judged) for case in waiting.pop(done)}
                    continue
                bar.update()
                if result is not None:
                    seen([case for case in cases if case.name == result["case"]])
                    rows.append(result)
                    bar.write(row_line(result))
    return rows


def with_baselines(
    rows: Sequence[dict], cases: Sequence[Case], options: argparse.Namespace, judged: Judged
) -> list[dict]:
    """The rows, those of the first diagnosed single effects and pairs with the errors of other methods."""
    known = {case.name: case for case in cases}
    order = {case.name: number for number, case in enumerate(cases)}
    listed = sorted((row for row in rows if "gap" in row), key=lambda row: order[row["case"]])
    compared = [row for row in listed if row["kind"] == "single"][: options.baselines]
    compared += [row for row in listed if row["kind"] == "pair"][: options.baselines // 2]
    others = [row for row in rows if row not in compared]
    with _pool(options.jobs) as pool, tqdm(total=len(compared), desc="baselines", unit="case") as bar:
        running = [pool.submit(add_baselines, known[row["case"]], options.work, judged) for row in compared]
        for done in as_completed(running):
            others.append(done.result())
            bar.update()
    return others


def without_sensors(cases: Sequence[Case], options: argparse.Namespace, judged: Judged) -> dict[str, list[dict]]:
    """The rows of the first platforms' drives by the sensor that was taken out; platforms that lack it are left out."""
    seeds = list(dict.fromkeys(case.platform_seed for case in cases))[: options.ablations]
    chosen = [case for case in cases if case.platform_seed in seeds]
    found = {}
    for sensor in ABLATIONS:
        results = judged.results.with_name(f"{judged.results.name}-{sensor}")
        part = replace(judged, results=results, without=sensor)
        print(f"without {sensor}: results in {results}", flush=True)
        if options.again:
            for case in chosen:
                forget(case, part)
        rows = in_parallel(chosen, options, part)
        found[sensor] = sorted(rows, key=lambda row: (CASE_KINDS.index(row["kind"]), row["case"]))
    return found


def _pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


if __name__ == "__main__":
    sys.exit(main())
