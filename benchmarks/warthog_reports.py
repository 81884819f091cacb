"""Real recordings: diagnose the Warthog of the DRIVE dataset on asphalt, gravel, sand and grass.

    scripts/run.sh python benchmarks/warthog_reports.py FOLDER [--json FILE] [--docs docs/discrepancy.md]

Each recording is converted to a bag and diagnosed with the shipped Warthog file on the ground that is found in it; the
recording of another day on asphalt is held out for the first. Each ground gets a robot file with its effects.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from monoforce_ros.datasets import DriveRecording, drive_to_bag
from monoforce_ros.discrepancy import diagnose_bag
from monoforce_ros.reporting import write_between

GROUNDS = {
    "asphalt": "warthog_wheels_asphalt.npz",
    "asphalt, another day": "warthog_wheels_asphalt_2024_8_7_11h30s30.npz",
    "gravel": "warthog_wheels_gravel_2024_8_6_11h37s32.npz",
    "sand": "warthog_wheels_sand_2024_9_25_14h13s47.npz",
    "not stated": "test_warthog.npz",
    "grass, one log": "warthog_wheels_grass_continuous_20hz.csv.gz",
}


def bag_of(source: Path, folder: Path) -> Path:
    """The recording as a bag; converted once."""
    bag = folder / "bags" / source.name.split(".")[0]
    if not bag.exists():
        drive_to_bag(DriveRecording.open(source), bag)
    return bag


def run(source: Path, folder: Path, ground: str, held_out: list[Path]) -> dict:
    """Diagnose a recording; returns its row."""
    began = time.monotonic()
    bag = bag_of(source, folder)
    out = folder / "reports" / bag.name
    found = diagnose_bag(bag, "warthog", out, held_out=[bag_of(other, folder) for other in held_out])
    report = json.loads(found.report.read_text(encoding="utf-8"))
    return {
        "ground": ground, "file": source.name, "verdict": report["verdict"], "effects": report["effects"],
        "gap": report["gap"], "held_out": report["held_out"], "remarks": report["remarks"],
        "localisation": [entry["text"] for entry in report["localisation"][:3]],
        "robot_file": report["robot_file"], "seconds": time.monotonic() - began,
    }  # fmt: skip


def section(rows: list[dict]) -> str:
    """Section of the document."""
    lines = [
        "| ground | verdict | found | position after 2 s [m] | after 5 s [m] | heading after 2 s [deg] | time |",
        "|---|---|---|---|---|---|---|",
    ]

    def change(row: dict, metric: str) -> str:
        entry = row["gap"].get(metric)
        if entry is None:
            return "–"
        after = "–" if entry["after"] is None else f"{entry['after']:.2f}"
        return f"{entry['before']:.2f} → {after}"

    for row in rows:
        found = ", ".join(
            f"`{e['name']}` " + " ".join(f"{v['value']:.3g} {v['unit']}" for v in e["parameters"].values())
            for e in row["effects"]
        )
        lines.append(
            f"| {row['ground']} | `{row['verdict']}` | {found or '–'} | {change(row, 'position_2s')} | "
            f"{change(row, 'position_5s')} | {change(row, 'heading_2s')} | {row['seconds']:.0f} s |"
        )
    lines.append("")
    for row in rows:
        for name, table in row["held_out"].items():
            entry = table.get("position_2s")
            if entry and entry["after"] is not None:
                lines.append(
                    f"Effects found on {row['ground']}, on the held-out recording `{name}`: position error after 2 s "
                    f"{entry['before']:.2f} → {entry['after']:.2f} m (mean gain {entry['low']:.2f} to "
                    f"{entry['high']:.2f} m)."
                )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="folder of the dataset's files")
    parser.add_argument("--folder", type=Path, default=Path("out/warthog"), help="bags and reports (%(default)s)")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="TEXT", help="only grounds whose name contains one of these"
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the table into this document")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for ground, name in GROUNDS.items():
        if not any(text in ground for text in options.only):
            continue
        held_out = [options.source / GROUNDS["asphalt, another day"]] if ground == "asphalt" else []
        rows.append(run(options.source / name, options.folder, ground, held_out))
        print(section(rows[-1:]).splitlines()[2], flush=True)
    text = section(rows)
    print("\n" + text)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.docs:
        write_between(options.docs, "real drives", text)


if __name__ == "__main__":
    main()
