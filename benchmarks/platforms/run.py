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
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from pathlib import Path

from benchmark_case import CASE_KINDS, ENGINES, SETS, WORLD_GROUNDS, Case, all_cases
from benchmark_score import ENGINES as SCORED
from benchmark_score import baseline_table, row_line, scores, table
from case_recording import CaseFiles, record_platform, record_together
from diagnosis_run import ABLATIONS, Judged, add_baselines, code_version, commission_platform, diagnose_case, forget
from drive_session import DriveJob, Trace
from tqdm import tqdm

from monoforce_ros.core import write_text
from monoforce_ros.reporting import write_between

QUICK_PLATFORMS = 6
"""Of ``--quick``, alternating between the engines."""


def main() -> int:
    options = build_parser().parse_args()
    cases = chosen_cases(options)
    if not cases:
        print("no case matches the options", file=sys.stderr)
        return 1
    record(cases, options)
    if options.record_only:
        return 0
    code = options.code.resolve()
    label = options.label or code_version(code)
    results = options.work / "results" / "-".join(part for part in (label, options.without) if part)
    judged = Judged(code, results, options.without or "", options.timeout)
    print(f"{len(cases)} cases, code {code} ({label}), results in {results}", flush=True)
    if options.again:
        for case in cases:
            forget(case, judged)
    rows = [row for row in in_parallel(cases, options, judged) if row is not None]
    if options.baselines:
        rows = with_baselines(rows, cases, options, judged)
    rows.sort(key=lambda row: (CASE_KINDS.index(row["kind"]), row["case"]))
    text = table(rows) + ("\n\n" + baseline_table(rows) if options.baselines else "")
    print("\n" + text)
    if options.json:
        found = {"all": scores(rows)}
        found |= {engine: scores([row for row in rows if row["engine"] == engine]) for engine in SCORED}
        write_text(options.json, json.dumps({"label": label, "scores": found, "rows": rows}, indent=1) + "\n")
    if options.docs:
        write_between(options.docs, "platforms", text)
    return 0


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
    parser.add_argument("--quick", action="store_true", help=f"only the first {QUICK_PLATFORMS} platforms: 15 minutes")
    parser.add_argument("--without", choices=ABLATIONS, help="take this sensor out of every recording")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--timeout", type=float, default=300.0, help="of a diagnosis [s] (%(default)s)")
    parser.add_argument("--record-only", action="store_true", help="record, do not diagnose")
    parser.add_argument("--again", action="store_true", help="diagnose again where a result exists")
    parser.add_argument(
        "--code", type=Path, default=Path(__file__).parents[2], help="repository to judge (the one of this file)"
    )
    parser.add_argument("--label", help="name of the results' folder (by default a fingerprint of the code)")
    parser.add_argument("--baselines", action="store_true", help="compare with other methods on single effects")
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


def in_parallel(cases: Sequence[Case], options: argparse.Namespace, judged: Judged) -> list[dict | None]:
    """The rows of cases; each platform is commissioned before its first case."""
    platforms: dict[str, list[Case]] = {}
    for case in cases:
        platforms.setdefault(case.platform_name, []).append(case)
    rows: list[dict | None] = []
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
                rows.append(result)
                bar.update()
                if result is not None:
                    bar.write(row_line(result))
    return rows


def with_baselines(
    rows: Sequence[dict], cases: Sequence[Case], options: argparse.Namespace, judged: Judged
) -> list[dict]:
    """The rows, those of diagnosed single effects with the errors of other methods."""
    known = {case.name: case for case in cases}
    singles = [row for row in rows if row["kind"] == "single" and "gap" in row]
    others = [row for row in rows if row not in singles]
    with _pool(options.jobs) as pool, tqdm(total=len(singles), desc="baselines", unit="case") as bar:
        running = [pool.submit(add_baselines, known[row["case"]], options.work, judged) for row in singles]
        for done in as_completed(running):
            others.append(done.result())
            bar.update()
    return others


def _pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


if __name__ == "__main__":
    sys.exit(main())
