"""Real recordings: diagnose the Warthog of the DRIVE dataset and the labelled drives of doughnut_calib.

    scripts/run.sh python benchmarks/warthog_reports.py DATA [--only TEXT…] [--json FILE] [--docs docs/discrepancy.md]

``DATA`` holds ``drive`` (windows and a log, which are converted to bags) and ``doughnut`` (bags). Each recording is
diagnosed with the shipped robot file on the ground that is found in it; recordings of other days on the same ground are
held out. What is known of each stands beside what was found, and errors after steps of the command beside those of a
kinematic fit. ``--docs`` replaces the lines of the recordings that were run.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch

from monoforce_ros.core import write_text
from monoforce_ros.datasets import DriveRecording, drive_to_bag
from monoforce_ros.discrepancy import diagnose_bag
from monoforce_ros.reporting import write_between


@dataclass(frozen=True)
class RealDrive:
    """A recording and what is known of it.

    Attributes:
        ground: name, by which the document's lines are found.
        file: in the folder of the data; a folder is a bag.
        known: label, or what its publishers and the wheels measured.
        robot: whose shipped file is the nominal model.
        held_out: recordings of the same ground on other days.
    """

    ground: str
    file: str
    known: str
    robot: str = "warthog"
    held_out: tuple[str, ...] = ()


_DRIVES = "dead time 0.35–0.65 s, lag 0.3–0.4 s, above 3.6 m/s in part"
DRIVES = (
    RealDrive(
        "asphalt", "drive/warthog_wheels_asphalt.npz", f"{_DRIVES}; yaw rate 0.60 of the ideal; poses 0.60–0.75 s late",
        held_out=("drive/warthog_wheels_asphalt_2024_8_7_11h30s30.npz", "doughnut/warthog_asphalt_2024_09_25"),
    ),
    RealDrive(
        "asphalt, another day", "drive/warthog_wheels_asphalt_2024_8_7_11h30s30.npz",
        f"{_DRIVES}; yaw rate 0.60; poses 0.60–0.75 s late",
    ),
    RealDrive("asphalt, a third day", "doughnut/warthog_asphalt_2024_09_25", "36 m on asphalt"),
    RealDrive(
        "gravel", "drive/warthog_wheels_gravel_2024_8_6_11h37s32.npz",
        f"{_DRIVES}; yaw rate 0.60; poses 0.60–0.75 s late",
    ),
    RealDrive(
        "sand", "drive/warthog_wheels_sand_2024_9_25_14h13s47.npz",
        f"{_DRIVES}; yaw rate 0.53, speed 0.88; poses 0.85 s late",
    ),
    RealDrive(
        "not stated", "drive/test_warthog.npz", f"{_DRIVES}; yaw rate 0.58, speed 0.88; poses 0.25 s late"
    ),
    RealDrive("grass, windows", "drive/warthog_wheels_grass.npz", "slow; yaw rate 0.55, speed 0.95"),
    RealDrive(
        "grass, one log", "drive/warthog_wheels_grass_continuous_20hz.csv.gz", "slow; yaw rate 0.55, speed 0.95"
    ),
    RealDrive(
        "Husky, wet grass", "doughnut/husky_wet_grass",
        "limits of 1.0 rad/s, 1.9 m/s² and 1.9 rad/s², dead time 0.20 s; yaw rate 0.51 of what the wheels say",
        robot="husky",
    ),
    RealDrive(
        "Husky, wheels in the air", "doughnut/husky_wheels_in_the_air", "jacked up: wheels turn, the robot does not",
        robot="husky",
    ),
)  # fmt: skip
_HEADS = (
    "| ground | known | verdict | found | after 2 s [m] | after 5 s [m] | heading after 2 s [°] | time | code |",
    "| ground | windows | nominal | effects of the table above | kinematic fit | ahead by | measured wheels and gyro |",
)
"""Of the two tables: all windows, and those that begin with a step of the command."""


def bag_of(source: Path, folder: Path) -> Path:
    """The recording as a bag; converted once."""
    if source.is_dir():
        return source
    bag = folder / "bags" / source.name.split(".")[0]
    if not bag.exists():
        drive_to_bag(DriveRecording.open(source), bag)
    return bag


def run(drive: RealDrive, data: Path, folder: Path) -> dict:
    """Diagnose a recording; returns its row."""
    began, used = time.monotonic(), time.process_time()
    bag = bag_of(data / drive.file, folder)
    out = folder / "reports" / bag.name
    held_out = [bag_of(data / name, folder) for name in drive.held_out]
    found = diagnose_bag(bag, drive.robot, out, held_out=held_out)
    report = json.loads(found.report.read_text(encoding="utf-8"))
    keys = ("verdict", "headline", "effects", "known_parts", "gap", "steps", "held_out", "remarks", "advice")
    return {key: report[key] for key in (*keys, "robot_file")} | {
        "ground": drive.ground, "file": drive.file, "known": drive.known,
        "localisation": [entry["text"] for entry in report["localisation"][:3]],
        "seconds": time.monotonic() - began, "processor_seconds": time.process_time() - used,
        "code": code_version(), "date": datetime.now(UTC).date().isoformat(),
    }  # fmt: skip


def code_version() -> str:
    """The last commit that changed the package or its files; with a plus sign where they differ from it."""

    def git(*arguments: str) -> str:
        command = ["git", *arguments, "--", "monoforce_ros", "config"]
        done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    return (git("log", "-1", "--format=%h") or "–") + ("+" if git("status", "--short") else "")


def whole_line(row: dict) -> str:
    """A recording as a line of the first table."""

    def change(metric: str) -> str:
        entry = row["gap"].get(metric)
        if entry is None:
            return "–"
        after = "–" if entry["after"] is None else f"{entry['after']:.2f}"
        return f"{entry['before']:.2f} → {after}"

    named = [*row["effects"], *row["known_parts"]]
    found = ", ".join(
        f"`{effect['name']}` " + " ".join(f"{v['value']:.3g} {v['unit']}" for v in effect["parameters"].values())
        for effect in named
    )
    # The verdict alone does not say that predictions grow worse, or that something is missing still.
    top = row["headline"]
    found = found or " ".join(text.split(" (")[0] for text in top["findings"][:1]) or "–"
    return (
        f"| {row['ground']} | {row['known']} | `{row['verdict']}`. {top['sentence']} | {found} | "
        f"{change('position_2s')} | {change('position_5s')} | {change('heading_2s')} | {row['seconds']:.0f} s | "
        f"{row['code']} |"
    )


def step_line(row: dict) -> str | None:
    """A recording as a line of the second table; None where no window begins with a step."""
    steps = row["steps"]
    if steps is None:
        return None

    def length(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f} m"

    ahead = "–" if steps["ahead"] is None else "[{:.2f}, {:.2f}] m".format(*steps["ahead"])
    return (
        f"| {row['ground']} | {steps['windows']} | {length(steps['before'])} | {length(steps['after'])} | "
        f"{length(steps['kinematic'])} | {ahead} | {length(steps['reckoned'])} |"
    )


def held_out_lines(row: dict) -> list[str]:
    """What the effects of a recording do to the held-out ones, a line each."""
    lines = []
    for name, table in row["held_out"].items():
        entry = table.get("position_2s")
        if entry and entry["after"] is not None:
            lines.append(
                f"- Effects found on {row['ground']}, on the held-out recording `{name}`: position error after 2 s "
                f"{entry['before']:.2f} → {entry['after']:.2f} m (mean gain {entry['low']:.2f} to "
                f"{entry['high']:.2f} m)."
            )
    return lines


def section(rows: Sequence[dict], before: str = "") -> str:
    """Section of the document: both tables, and the held-out recordings.

    Args:
        rows: of the recordings that were run.
        before: the section as it is; its lines of other recordings stay.
    """
    new = {row["ground"]: row for row in rows}
    tables: list[list[str]] = [[], []]
    held_out: list[str] = []
    for ground in (drive.ground for drive in DRIVES):
        if ground in new:
            row = new[ground]
            tables[0].append(whole_line(row))
            tables[1] += [line for line in [step_line(row)] if line is not None]
            held_out += held_out_lines(row)
            continue
        old = [line for line in before.splitlines() if line.startswith(f"| {ground} |")]
        for table, head in zip(tables, _HEADS, strict=True):
            table += [line for line in old if line.count(" | ") == head.count(" | ")]
        held_out += [line for line in before.splitlines() if line.startswith(f"- Effects found on {ground},")]
    parts = []
    for head, lines in zip(_HEADS, tables, strict=True):
        parts.append("\n".join([head, "|---" * (head.count(" | ") + 1) + "|", *lines]))
    parts.insert(
        1,
        "After steps of the command (medians after 2 s; all tested on parts without which they were fitted; "
        "brackets: 95 % interval of how far the effects are ahead of the kinematic fit):",
    )
    return "\n\n".join([*parts, *(["\n".join(held_out)] if held_out else [])])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder that holds drive and doughnut")
    parser.add_argument("--folder", type=Path, default=Path("out/warthog"), help="bags and reports (%(default)s)")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="TEXT", help="only grounds whose name contains one of these"
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the tables into this document")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for drive in DRIVES:
        if not any(text in drive.ground for text in options.only):
            continue
        if not (options.data / drive.file).exists():
            print(f"[real drives] {drive.ground}: no {options.data / drive.file}")
            continue
        rows.append(run(drive, options.data, options.folder))
        print(whole_line(rows[-1]), flush=True)
    print("\n" + section(rows))
    if options.json:
        write_text(options.json, json.dumps(rows, indent=1) + "\n")
    if options.docs:
        document = options.docs.read_text(encoding="utf-8")
        before = re.search(r"<!-- real drives -->\n(.*?)<!-- end of real drives -->", document, re.DOTALL)
        write_between(options.docs, "real drives", section(rows, before.group(1) if before else ""))


if __name__ == "__main__":
    main()
