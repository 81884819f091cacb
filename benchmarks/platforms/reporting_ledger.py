"""Reporting ledger: which platforms were reported by which code, so that figures are published of each only once.

Who has seen how a platform was judged may have changed the code for it; a second figure of it is not independent.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmark_case import Case

from monoforce_ros.core import write_text

LEDGER = Path(__file__).with_name("reported.json")


@dataclass(frozen=True)
class ReportedPlatforms:
    """Platforms of one engine that were reported.

    Attributes:
        engine: of ``benchmark_case.ENGINES``, or ``worlds``.
        first, last: seeds, both included.
        date: of the run, ISO 8601.
        code: fingerprint of the judged package, or the commit of a run that is older than the ledger.
    """

    engine: str
    first: int
    last: int
    date: str
    code: str

    def holds(self, case: Case) -> bool:
        """Whether the platform of a case is among them."""
        return case.engine == self.engine and self.first <= case.platform_seed <= self.last


def read_ledger(file: Path = LEDGER) -> list[ReportedPlatforms]:
    """What was reported so far; nothing without the file."""
    return [ReportedPlatforms(**entry) for entry in json.loads(file.read_text())] if file.exists() else []


def reported_before(cases: Sequence[Case], code: str, file: Path = LEDGER) -> list[ReportedPlatforms]:
    """Entries of platforms of these cases by other code.

    The same code gives the same answers: its table may be written again.
    """
    return [entry for entry in read_ledger(file) if entry.code != code and any(entry.holds(case) for case in cases)]


def add_to_ledger(cases: Sequence[Case], code: str, date: str, file: Path = LEDGER) -> None:
    """Add the platforms of cases whose results are about to be seen, unless this code is listed with them.

    A run adds each platform by itself: what was seen of an interrupted one is listed, too.
    """
    entries = read_ledger(file)
    known = [entry for entry in entries if entry.code == code]
    fresh = [case for case in cases if not any(entry.holds(case) for entry in known)]
    if not fresh:
        return
    for engine in dict.fromkeys(case.engine for case in fresh):
        seeds = {case.platform_seed for case in fresh if case.engine == engine}
        joined = [entry for entry in known if (entry.engine, entry.date) == (engine, date)]
        entries = [entry for entry in entries if entry not in joined]
        seeds.update(*(range(entry.first, entry.last + 1) for entry in joined))
        entries += [ReportedPlatforms(engine, first, last, date, code) for first, last in _ranges(sorted(seeds))]
    lines = ",\n".join(f" {json.dumps(asdict(entry))}" for entry in entries)
    write_text(file, f"[\n{lines}\n]\n")


def _ranges(seeds: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of each part of sorted seeds; two engines take turns, so that the seeds of one are two apart."""
    ends = [number for number, seed in enumerate(seeds[:-1]) if seeds[number + 1] - seed > 2]
    begins = [0, *(number + 1 for number in ends)]
    return [(seeds[begin], seeds[end]) for begin, end in zip(begins, [*ends, len(seeds) - 1], strict=True)]
