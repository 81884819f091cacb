"""Hidden effects: MuJoCo drives with physics injected in them, diagnosed as a user would.

    scripts/run.sh python benchmarks/hidden_effects.py [--jobs 2] [--json FILE] [--docs docs/discrepancy.md]

Drives are recorded once and kept in the folder, reports too. A healthy drive commissions the nominal robot file; every
other drive is diagnosed with it: ones with nothing hidden, one effect at two strengths, over hills with a lidar map and
at other noise, pairs, and effects that the catalogue does not hold. The truth beside a bag is read only to score.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from hidden_drives import SEED, SINGLES, Case, all_cases, record_case
from matplotlib.figure import Figure
from tqdm import tqdm

from monoforce_ros.reporting import figure_png, write_between

STRONG = 2.0
"""Gap over noise and a healthy robot's, root mean squares, from which on an effect is strong enough to matter.
Half the square of it is the loss per window that goes with it."""
KINDS = ("empty", "single", "pair", "outsider")
CLASSES = (frozenset({"command_delay", "pose_clock_offset", "command_clock_offset"}),)
"""Effects that count as one name; docs/discrepancy.md says why."""
DRAGS = frozenset({"viscous_drag", "quadratic_drag"})
"""Resistance that grows with speed: a drive at about one speed cannot tell how; reports list the other as a rival."""


def commissioned(folder: Path, seed: int) -> Path:
    """The robot file of the healthy drive; made once."""
    from monoforce_ros.discrepancy.cli import main as diagnose

    case = next(case for case in all_cases(seed) if case.kind == "healthy")
    bag, out = record_case(case, folder), folder / f"nominal-{seed}"
    if not (out / "husky.yaml").exists():
        diagnose(["--commission", str(bag), "--robot", "husky", "--out", str(out), "--quiet"])
    return out / "husky.yaml"


def run_case(case: Case, folder: Path, robot: Path, options: argparse.Namespace) -> dict:
    """Record and diagnose a drive; returns its row."""
    import torch

    from monoforce_ros.discrepancy.cli import main as diagnose

    torch.set_num_threads(1)
    bag = record_case(case, folder)
    out = folder / "reports" / case.name
    row = out / "row.json"
    if row.exists() and not options.again:
        known = json.loads(row.read_text())
        return with_baselines(known, bag, robot, row) if options.baselines else known
    began = time.monotonic()
    terrain = "lidar" if case.ground == "hills" else "flat"
    status = diagnose([str(bag), "--robot", str(robot), "--terrain", terrain, "--out", str(out), "--quiet"])
    seconds = time.monotonic() - began
    report = json.loads((out / "report.json").read_text()) if status == 0 else {"verdict": "error"}
    truth = json.loads(bag.with_name(f"{bag.name}.hidden.json").read_text())["hidden"]
    result = {
        "case": case.name, "kind": case.kind, "ground": case.ground, "noise": case.noise, "truth": truth,
        "verdict": report["verdict"], "effects": report.get("effects", []), "gap": report.get("gap", {}),
        "numbers": report.get("numbers", {}), "remarks": report.get("remarks", []), "seconds": seconds,
        "candidates": report.get("candidates", [])[:6],
    }  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    row.write_text(json.dumps(result, indent=1))
    return with_baselines(result, bag, robot, row) if options.baselines else result


def with_baselines(result: dict, bag: Path, robot: Path, row: Path) -> dict:
    """The row with what other methods reach on the same held-out blocks; single effects on level ground alone."""
    alike = (result["kind"], result["ground"], result["noise"]) == ("single", "flat", "usual")
    if not alike or "baselines" in result or result["verdict"] == "error":
        return result
    from baselines import baseline_errors

    from monoforce_ros.discrepancy.bag_diagnosis import read_drive
    from monoforce_ros.discrepancy.gap import noise_floor, noisy_motions, residual_scale
    from monoforce_ros.discrepancy.hypothesis import window_starts
    from monoforce_ros.robots import load_robot, read_nominal_residual

    model = load_robot(robot)
    drive, _ = read_drive(bag, model, "lidar" if result["ground"] == "hills" else "flat")
    starts = window_starts(drive.smoothed.motion, drive.smoothed.stretches, 2.0, 1.0)
    data = drive.cut(starts, np.array([0.5, 1.0, 1.5, 2.0]))
    floor = noise_floor(drive.smoothed.motion, noisy_motions(drive.smoothed), data)
    errors = baseline_errors(drive, data, model, residual_scale(floor, read_nominal_residual(robot, data.samples)))
    result["baselines"] = {name: float(np.median(np.hypot(e[:, 0], e[:, 1]))) for name, e in errors.items()}
    row.write_text(json.dumps(result, indent=1))
    return result


def same(one: str, other: str) -> bool:
    """Whether two names count as one."""
    return one == other or any({one, other} <= group for group in CLASSES)


def gap_over_noise(row: dict) -> float:
    """Largest median error at 2 s over what the noise alone leaves."""
    shown = [entry for key, entry in row["gap"].items() if key.endswith("_2s")]
    return max((entry["before"] / max(entry["noise"], 1e-6) for entry in shown), default=float("nan"))


def named(row: dict) -> list[str]:
    """Effects of the catalogue that a report names."""
    return [effect["name"] for effect in row["effects"]] if row["verdict"] == "effect_found" else []


def drag_with_its_rival(row: dict) -> bool:
    """Whether the other drag was named, and the right one said to do as well."""
    truth = row["truth"][0]["name"]
    if not named(row) or not {truth, named(row)[0]} <= DRAGS:
        return False
    rivals = row["effects"][0]["rivals"]
    return truth in {rival["name"] if isinstance(rival, dict) else rival for rival in rivals}


def scores(rows: list[dict]) -> dict:
    """Shares by kind, over drives strong enough to matter where that is said."""

    def strong(row: dict) -> bool:
        return row["numbers"].get("loss_before", 0.0) >= 0.5 * STRONG**2

    singles = [row for row in rows if row["kind"] == "single"]
    matter = [row for row in singles if strong(row)]
    pairs = [row for row in rows if row["kind"] == "pair" and strong(row)]
    empty = [row for row in rows if row["kind"] == "empty"]
    outsiders = [row for row in rows if row["kind"] == "outsider"]
    strange = [row for row in outsiders if strong(row)]
    first = [row for row in matter if named(row) and same(named(row)[0], row["truth"][0]["name"])]
    drag = [row for row in matter if row not in first and drag_with_its_rival(row)]
    only = [row for row in first if len(named(row)) == 1]
    both = [row for row in pairs if all(any(same(t["name"], n) for n in named(row)) for t in row["truth"])]
    errors = []
    for row in first:
        values = {key: entry["value"] for key, entry in row["effects"][0]["parameters"].items()}
        truth = row["truth"][0]["parameters"]
        if row["effects"][0]["name"] == row["truth"][0]["name"] and set(values) & set(truth):
            main = max(set(values) & set(truth), key=lambda key: abs(truth[key]))
            if row["truth"][0]["name"] not in ("turning_scrub", "friction_scale", "payload"):
                errors.append(abs(values[main] - truth[main]) / max(abs(truth[main]), 1e-6))
    closed = [closed_share(row) for row in [*first, *both]]
    closed = [value for value in closed if np.isfinite(value)]

    def share(part: list, whole: list) -> dict:
        return {"share": len(part) / max(1, len(whole)), "count": len(part), "of": len(whole)}

    result = {
        "singles_named_first": share(first, matter),
        "singles_named_or_as_rival_drag": share([*first, *drag], matter),
        "singles_named_alone": share(only, matter),
        "weak_singles": {
            "count": len(singles) - len(matter),
            "named": sum(bool(named(r)) and same(named(r)[0], r["truth"][0]["name"]) for r in singles if not strong(r)),
        },
        "pairs_both_named": share(both, pairs),
        "false_alarms": share([row for row in empty if row["verdict"] == "effect_found"], empty),
        "empty_not_said_to_be": share([row for row in empty if row["verdict"] != "no_discrepancy"], empty),
        "outsiders_named_as_catalogue": share([row for row in outsiders if named(row)], outsiders),
        "outsiders_unknown": share([row for row in strange if row["verdict"] == "unknown_effect"], strange),
        "parameter_error_median": float(np.median(errors)) if errors else float("nan"),
        "reducible_gap_closed_median": float(np.median(closed)) if closed else float("nan"),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "seconds_most": float(np.max([row["seconds"] for row in rows])),
    }
    compared = [row for row in matter if "baselines" in row and "position_2s" in row["gap"]]
    if compared:
        result["baselines"] = _baseline_scores(compared)
    return result


def _baseline_scores(rows: list[dict]) -> dict[str, dict]:
    """Median over drives of the median position error after 2 s, and of the share of the reducible gap closed."""
    methods = {"model as it was": lambda row: row["gap"]["position_2s"]["before"]}
    titles = {
        "refit": "refit of friction, track width and lag",
        "network": "neural residual",
        "sindy": "pysindy on the accelerations",
    }
    for key, title in titles.items():
        methods[title] = lambda row, key=key: row["baselines"][key]
    methods["diagnose"] = lambda row: row["gap"]["position_2s"]["after"]
    table = {}
    for name, error in methods.items():
        errors = np.array([error(row) for row in rows])
        before = np.array([row["gap"]["position_2s"]["before"] for row in rows])
        noise = np.array([row["gap"]["position_2s"]["noise"] for row in rows])
        closed = (before - errors) / np.maximum(before - noise, 1e-6)
        table[name] = {"error": float(np.median(errors)), "closed": float(np.median(closed))}
    return table


def closed_share(row: dict) -> float:
    """Of the reducible gap after 2 s, in the metric that was furthest off before; NaN where nothing was found."""
    shown = [entry for key, entry in row["gap"].items() if key.endswith("_2s") and "closed" in entry]
    if not shown:
        return float("nan")
    return max(shown, key=lambda entry: entry["before"] / max(entry["noise"], 1e-6))["closed"]


def confusion(rows: list[dict]) -> dict[str, Counter]:
    """By hidden effect of single drives and outsiders: what was said first."""
    table: dict[str, Counter] = {}
    for row in rows:
        if row["kind"] == "pair":
            continue
        truth = row["truth"][0]["name"] if row["truth"] else "nothing"
        said = named(row)[0] if named(row) else row["verdict"]
        table.setdefault(truth, Counter())[said] += 1
    return table


def print_rows(rows: list[dict]) -> None:
    """One line a drive."""
    for row in sorted(rows, key=lambda row: (row["kind"], row["case"])):
        shown = [
            f"{effect['name']}(" + ",".join(f"{k}={v['value']:.3g}" for k, v in effect["parameters"].items()) + ")"
            for effect in row["effects"]
        ]
        numbers = row["numbers"]
        losses = f"{numbers.get('loss_before', np.nan):.2f}→{numbers.get('loss_after', np.nan):.2f}"
        print(
            f"{row['case']:64s} {row['verdict']:16s} ×{gap_over_noise(row):4.1f} {losses:12s} "
            f"f{numbers.get('loss_by_formula', np.nan):.2f} s{numbers.get('share_explained', np.nan):.2f} "
            f"d{numbers.get('share_by_drift', np.nan):.2f} {row['seconds']:3.0f}s {' + '.join(shown)}"
        )


def confusion_figure(rows: list[dict]) -> Figure:
    """Matrix of what was hidden and what was said first, as a picture."""
    table = confusion(rows)
    verdicts = ["no_discrepancy", "no_improvement", "unknown_effect", "not_identifiable"]
    order = ["nothing", *(text[0].partition(":")[0] for text in SINGLES)]
    order += sorted({row["truth"][0]["name"] for row in rows if row["kind"] == "outsider"})
    order = [truth for truth in order if truth in table]
    said = [name for name in order if any(name in counts for counts in table.values())]
    said += sorted({n for counts in table.values() for n in counts} - set(said) - set(verdicts))
    said += [verdict for verdict in verdicts if any(verdict in counts for counts in table.values())]
    values = np.array([[table[truth][name] for name in said] for truth in order], float)
    shares = values / values.sum(axis=1, keepdims=True)
    figure = Figure(figsize=(12.0, 9.5), layout="constrained", dpi=110)
    ax = figure.subplots()
    ax.imshow(shares, cmap="BuGn", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(values):
        if count:
            ax.text(column, row, f"{count:.0f}", ha="center", va="center", fontsize=10)
    ax.set_xticks(range(len(said)), said, rotation=55, ha="right")
    ax.set_yticks(range(len(order)), order)
    ax.set_xlabel("said first")
    ax.set_ylabel("hidden")
    ax.set_title("drives by what was hidden and what was said", loc="left", fontweight="bold")
    ax.spines[:].set_visible(False)
    return figure


def section(rows: list[dict], found: dict, figure: Path | None, folder: Path) -> str:
    """What a document says of a run."""

    def share(key: str) -> str:
        return f"{found[key]['count']} of {found[key]['of']} ({100 * found[key]['share']:.0f} %)"

    lines = [
        "| question | reach | measured |",
        "|---|---|---|",
        f"| single effect, strong enough to matter, named first | 90 % | {share('singles_named_first')} |",
        f"| … or as the other drag, with the right one as its rival | – | {share('singles_named_or_as_rival_drag')} |",
        f"| … named first and nothing else beside it | – | {share('singles_named_alone')} |",
        f"| pair, both named | 80 % | {share('pairs_both_named')} |",
        f"| drive with nothing hidden on which an effect is found | 5 % at most | {share('false_alarms')} |",
        f"| drive with nothing hidden with any verdict but `no_discrepancy` | – | {share('empty_not_said_to_be')} |",
        f"| effect outside the catalogue named as one of it | 20 % at most | {share('outsiders_named_as_catalogue')} |",
        f"| … said to be `unknown_effect` | – | {share('outsiders_unknown')} |",
        f"| parameter, median error | 15 % | {100 * found['parameter_error_median']:.0f} % |",
        "| reducible gap closed on held-out blocks, median | 80 % | "
        f"{100 * found['reducible_gap_closed_median']:.0f} % |",
        f"| time of a diagnosis of 60 s, median and longest, two at a time on two cores | 180 s | "
        f"{found['seconds_median']:.0f} s, {found['seconds_most']:.0f} s |",
        "",
    ]
    if "baselines" in found:
        lines += [
            "Position error after 2 s [m] on held-out blocks; medians over level drives, one strong effect:",
            "",
        ]
        lines += ["| method | error | of the reducible gap closed |", "|---|---|---|"]
        lines += [
            f"| {name} | {entry['error']:.3f} | {100 * entry['closed']:.0f} % |"
            for name, entry in found["baselines"].items()
        ]
        lines.append("")
    if figure is not None:
        lines += [f"![what was hidden and what was said]({figure.name})", ""]
    lines += ["| hidden | ground, noise | gap over noise | verdict | found | closed |", "|---|---|---|---|---|---|"]
    for row in sorted(rows, key=lambda row: (KINDS.index(row["kind"]), row["case"])):
        if row["kind"] == "empty":
            continue
        truth = ", ".join(
            f"{t['name']} {' '.join(f'{k} {v:g}' for k, v in t['parameters'].items() if v)}" for t in row["truth"]
        )
        said = ", ".join(
            f"{e['name']} {' '.join(f'{k} {v["value"]:.3g}' for k, v in e['parameters'].items())}"
            for e in row["effects"]
        )
        closed = closed_share(row)
        lines.append(
            f"| {truth} | {row['ground']}, {row['noise']} | {gap_over_noise(row):.1f} | `{row['verdict']}` | "
            f"{said or '–'} | {'–' if np.isnan(closed) else f'{100 * closed:.0f} %'} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("out/hidden"), help="for drives and reports (%(default)s)")
    parser.add_argument("--seed", type=int, default=SEED, help="the drives' first one (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="drives at a time (%(default)s)")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="drives whose name holds one of these")
    parser.add_argument("--again", action="store_true", help="diagnose drives that have a report too")
    parser.add_argument("--baselines", action="store_true", help="compare with other ways to close a gap (pysindy)")
    parser.add_argument("--json", type=Path, help="write rows and scores to this file")
    parser.add_argument(
        "--docs", type=Path, metavar="FILE", help="write the tables into this document, a PNG beside it"
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    robot = commissioned(options.folder, options.seed)
    cases = [c for c in all_cases(options.seed) if c.kind != "healthy" and any(text in c.name for text in options.only)]
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        running = [pool.submit(run_case, case, options.folder, robot, options) for case in cases]
        with tqdm(total=len(cases), unit="drive") as bar:
            for done in as_completed(running):
                rows.append(done.result())
                bar.update()
    print_rows(rows)
    found = scores(rows)
    print(json.dumps(found, indent=1))
    for truth, said in sorted(confusion(rows).items()):
        print(f"{truth:24s} " + ", ".join(f"{name} {count}" for name, count in said.most_common()))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"scores": found, "rows": rows}, indent=1) + "\n")
    if options.docs:
        picture = options.docs.with_name("hidden_effects.png")
        picture.write_bytes(figure_png(confusion_figure(rows)))
        write_between(options.docs, "hidden effects", section(rows, found, picture, options.folder))


if __name__ == "__main__":
    main()
