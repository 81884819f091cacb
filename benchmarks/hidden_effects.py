"""Hidden effects: diagnose MuJoCo recordings with injected faults through the user interface.

    scripts/run.sh python benchmarks/hidden_effects.py [--jobs 2] [--json FILE] [--docs docs/discrepancy.md]

Recordings and reports are created once and kept in the folder. A recording of the healthy robot commissions the nominal
robot file, which is used to diagnose all others: without a fault, with one effect at two strengths, over hills with a
lidar map, with different noise, with pairs, and with out-of-catalogue effects. The ground truth next to a bag is used
only for scoring.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np
from hidden_drives import SEED, SINGLES, Case, all_cases, record_case
from matplotlib.figure import Figure
from tqdm import tqdm

from monoforce_ros.reporting import figure_png, write_between

STRONG = 2.0
"""RMS residual, divided by its scale (noise and nominal residual), above which an effect is strong. The corresponding
robust loss is half its square."""
KINDS = ("empty", "single", "pair", "out-of-catalogue")
CLASSES = (frozenset({"command_delay", "pose_clock_offset", "command_clock_offset"}),)
"""Effects that count as the same; see docs/discrepancy.md for the reason."""
DRAGS = frozenset({"viscous_drag", "quadratic_drag"})
"""Resistance that grows with speed; indistinguishable in a recording at nearly constant speed."""


def commissioned(folder: Path, seed: int) -> Path:
    """The robot file commissioned on the healthy recording; created once."""
    from monoforce_ros.discrepancy.cli import main as diagnose

    case = next(case for case in all_cases(seed) if case.kind == "healthy")
    bag, out = record_case(case, folder), folder / f"nominal-{seed}"
    if not (out / "husky.yaml").exists():
        diagnose(["--commission", str(bag), "--robot", "husky", "--out", str(out), "--quiet"])
    return out / "husky.yaml"


def run_case(case: Case, folder: Path, robot: Path, options: argparse.Namespace) -> dict:
    """Create and diagnose a recording; returns its row."""
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
    """Add the errors of other methods to the row, for single effects on level ground only."""
    comparable = (result["kind"], result["ground"], result["noise"]) == ("single", "flat", "usual")
    if not comparable or "baselines" in result or result["verdict"] == "error":
        return result
    from baselines import baseline_errors

    from monoforce_ros.discrepancy import read_evidence
    from monoforce_ros.discrepancy.evidence import MOTION, window_starts
    from monoforce_ros.discrepancy.gap import noise_floor, noisy_motions, residual_scale
    from monoforce_ros.discrepancy.nominal import NominalModel
    from monoforce_ros.robots import load_robot

    model = load_robot(robot)
    evidence, _ = read_evidence(bag, model, "lidar" if result["ground"] == "hills" else "flat")
    evidence = replace(evidence, components=MOTION)
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, 2.0, 1.0)
    data = evidence.cut(starts, np.array([0.5, 1.0, 1.5, 2.0]))
    floor = noise_floor(smoothed.motion, noisy_motions(smoothed), data)
    nominal = NominalModel.read(robot, tuple(float(sample) for sample in data.samples))
    nominal = None if nominal is None else nominal.of_motion()
    scale = np.sqrt((residual_scale(floor, data, nominal) ** 2).reshape(-1, *floor.shape).mean(axis=0))
    errors = baseline_errors(evidence, data, model, scale)
    result["baselines"] = {name: entry.median for name, entry in errors.items()}
    row.write_text(json.dumps(result, indent=1))
    return result


def same(one: str, other: str) -> bool:
    """Whether two effect names count as the same."""
    return one == other or any({one, other} <= group for group in CLASSES)


def gap_over_noise(row: dict) -> float:
    """Largest median error at 2 s over its noise floor."""
    entries = [entry for key, entry in row["gap"].items() if key.endswith("_2s")]
    return max((entry["before"] / max(entry["noise"], 1e-6) for entry in entries), default=float("nan"))


def named(row: dict) -> list[str]:
    """Names of the effects found in a report."""
    return [effect["name"] for effect in row["effects"]] if row["verdict"] == "effect_found" else []


def named_as_other_drag(row: dict) -> bool:
    """Whether the wrong drag was named, with the right one listed as indistinguishable."""
    truth = row["truth"][0]["name"]
    if not named(row) or not {truth, named(row)[0]} <= DRAGS:
        return False
    effect = row["effects"][0]
    return truth in effect.get("indistinguishable", effect.get("rivals", []))


def diagnosed(row: dict) -> bool:
    """Whether the recording could be diagnosed."""
    return row["verdict"] not in ("error", "not_identifiable")


def strong(row: dict) -> bool:
    """Whether the effect is strong; an undiagnosed one, of unknown strength, counts as strong and missed."""
    return not diagnosed(row) or row["numbers"].get("loss_before", 0.0) >= 0.5 * STRONG**2


def parameter_error(row: dict) -> float | None:
    """Relative error of the largest injected parameter; None if the effect has no parameter of this name.

    ``turning_scrub`` has none: it is injected as a longer wheelbase and estimated as a factor on the track width.
    """
    truth, effect = row["truth"][0], row["effects"][0]
    common = set(effect["parameters"]) & set(truth["parameters"])
    if effect["name"] != truth["name"] or not common:
        return None
    main = max(common, key=lambda key: abs(truth["parameters"][key]))
    value = truth["parameters"][main]
    return abs(effect["parameters"][main]["value"] - value) / max(abs(value), 1e-6)


def scores(rows: list[dict]) -> dict:
    """Scores by kind; every share includes its denominator."""
    singles = [row for row in rows if row["kind"] == "single"]
    matter = [row for row in singles if strong(row)]
    pairs = [row for row in rows if row["kind"] == "pair" and strong(row)]
    empty = [row for row in rows if row["kind"] == "empty"]
    outside = [row for row in rows if row["kind"] == "out-of-catalogue"]
    strong_outside = [row for row in outside if strong(row)]
    first = [row for row in matter if named(row) and same(named(row)[0], row["truth"][0]["name"])]
    drag = [row for row in matter if row not in first and named_as_other_drag(row)]
    only = [row for row in first if len(named(row)) == 1]
    both = [row for row in pairs if all(any(same(t["name"], n) for n in named(row)) for t in row["truth"])]
    errors = [error for row in first if (error := parameter_error(row)) is not None]
    closed = [value for row in [*first, *both] if np.isfinite(value := closed_share(row))]

    def share(part: list, whole: list) -> dict:
        return {"share": len(part) / max(1, len(whole)), "count": len(part), "of": len(whole)}

    def median(values: list[float], whole: list) -> dict:
        return {
            "median": float(np.median(values)) if values else float("nan"),
            "count": len(values),
            "of": len(whole),
        }

    result = {
        "singles_named_first": share(first, matter),
        "singles_named_or_as_other_drag": share([*first, *drag], matter),
        "singles_named_alone": share(only, matter),
        "weak_singles": {
            "count": len(singles) - len(matter),
            "named": sum(bool(named(r)) and same(named(r)[0], r["truth"][0]["name"]) for r in singles if not strong(r)),
        },
        "pairs_both_named": share(both, pairs),
        "false_alarms": share([row for row in empty if row["verdict"] == "effect_found"], empty),
        "empty_with_another_verdict": share([row for row in empty if row["verdict"] != "no_discrepancy"], empty),
        "out_of_catalogue_named": share([row for row in outside if named(row)], outside),
        "out_of_catalogue_unknown": share(
            [row for row in strong_outside if row["verdict"] == "unknown_effect"], strong_outside
        ),
        "not_diagnosed": share([row for row in rows if not diagnosed(row)], rows),
        "parameter_error": median(errors, matter),
        "reducible_gap_closed": median(closed, [*matter, *pairs]),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "seconds_most": float(np.max([row["seconds"] for row in rows])),
    }
    compared = [row for row in matter if "baselines" in row and "position_2s" in row["gap"]]
    if compared:
        result["baselines"] = _baseline_scores(compared)
    return result


def _baseline_scores(rows: list[dict]) -> dict[str, dict]:
    """Medians over recordings: median position error after 2 s, and closed share of the reducible gap."""
    methods = {"nominal model": lambda row: row["gap"]["position_2s"]["before"]}
    titles = {
        "refit": "refit of friction, track width and lag",
        "network": "neural residual",
        "sindy": "pysindy on the accelerations",
    }
    for key, title in titles.items():
        methods[title] = lambda row, key=key: row["baselines"][key]
    methods["diagnose"] = lambda row: _after(row["gap"]["position_2s"])
    table = {}
    for name, error in methods.items():
        errors = np.array([error(row) for row in rows])
        before = np.array([row["gap"]["position_2s"]["before"] for row in rows])
        noise = np.array([row["gap"]["position_2s"]["noise"] for row in rows])
        closed = (before - errors) / np.maximum(before - noise, 1e-6)
        table[name] = {"error": float(np.median(errors)), "closed": float(np.median(closed))}
    return table


def _after(entry: dict) -> float:
    """Error after the diagnosis; that of the nominal model if no effect was added."""
    return entry["before"] if entry["after"] is None else entry["after"]


def closed_share(row: dict) -> float:
    """Closed share of the reducible gap after 2 s, in the metric with the largest error before; NaN without effects."""
    entries = [entry for key, entry in row["gap"].items() if key.endswith("_2s") and "closed" in entry]
    if not entries:
        return float("nan")
    return max(entries, key=lambda entry: entry["before"] / max(entry["noise"], 1e-6))["closed"]


def confusion(rows: list[dict]) -> dict[str, Counter]:
    """Counts by injected effect, without pairs, of the effect named first, or of the verdict if none was named."""
    table: dict[str, Counter] = {}
    for row in rows:
        if row["kind"] == "pair":
            continue
        truth = row["truth"][0]["name"] if row["truth"] else "nothing"
        answer = named(row)[0] if named(row) else row["verdict"]
        table.setdefault(truth, Counter())[answer] += 1
    return table


def print_rows(rows: list[dict]) -> None:
    """Print one line per recording."""
    for row in sorted(rows, key=lambda row: (row["kind"], row["case"])):
        effects = [
            f"{effect['name']}(" + ",".join(f"{k}={v['value']:.3g}" for k, v in effect["parameters"].items()) + ")"
            for effect in row["effects"]
        ]
        numbers = row["numbers"]
        losses = f"{numbers.get('loss_before', np.nan):.2f}→{numbers.get('loss_after', np.nan):.2f}"
        print(
            f"{row['case']:64s} {row['verdict']:16s} ×{gap_over_noise(row):4.1f} {losses:12s} "
            f"f{numbers.get('loss_by_formula', np.nan):.2f} s{numbers.get('share_explained', np.nan):.2f} "
            f"p{numbers.get('p_rest', np.nan):.3f} {row['seconds']:3.0f}s {' + '.join(effects)}"
        )


def confusion_figure(rows: list[dict]) -> Figure:
    """Confusion matrix of injected effects and first answers."""
    table = confusion(rows)
    verdicts = ["no_discrepancy", "no_improvement", "unknown_effect", "not_identifiable"]
    order = ["nothing", *(text[0].partition(":")[0] for text in SINGLES)]
    order += sorted({row["truth"][0]["name"] for row in rows if row["kind"] == "out-of-catalogue"})
    order = [truth for truth in order if truth in table]
    answers = [name for name in order if any(name in counts for counts in table.values())]
    answers += sorted({n for counts in table.values() for n in counts} - set(answers) - set(verdicts))
    answers += [verdict for verdict in verdicts if any(verdict in counts for counts in table.values())]
    values = np.array([[table[truth][name] for name in answers] for truth in order], float)
    shares = values / values.sum(axis=1, keepdims=True)
    figure = Figure(figsize=(12.0, 9.5), layout="constrained", dpi=110)
    ax = figure.subplots()
    ax.imshow(shares, cmap="BuGn", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(values):
        if count:
            ax.text(column, row, f"{count:.0f}", ha="center", va="center", fontsize=10)
    ax.set_xticks(range(len(answers)), answers, rotation=55, ha="right")
    ax.set_yticks(range(len(order)), order)
    ax.set_xlabel("named first, or verdict")
    ax.set_ylabel("injected")
    ax.set_title("recordings by injected effect and answer", loc="left", fontweight="bold")
    ax.spines[:].set_visible(False)
    return figure


def section(rows: list[dict], found: dict, figure: Path | None, folder: Path) -> str:
    """Section of the document."""

    def share(key: str) -> str:
        return f"{found[key]['count']} of {found[key]['of']} ({100 * found[key]['share']:.0f} %)"

    error, closed = found["parameter_error"], found["reducible_gap_closed"]
    weak = found["weak_singles"]
    lines = [
        "| question | of | target | measured |",
        "|---|---|---|---|",
        f"| named first | single effects that are strong; {weak['count']} weak ones are not counted | 90 % | "
        f"{share('singles_named_first')} |",
        f"| … or the other drag, with the right one as indistinguishable | same | – | "
        f"{share('singles_named_or_as_other_drag')} |",
        f"| … named first and no other effect added | same | – | {share('singles_named_alone')} |",
        f"| both named | pairs that are strong | 80 % | {share('pairs_both_named')} |",
        f"| an effect found | recordings without a fault | 5 % at most | {share('false_alarms')} |",
        f"| any verdict but `no_discrepancy` | same | – | {share('empty_with_another_verdict')} |",
        f"| named as an effect of the catalogue | out-of-catalogue effects | 20 % at most | "
        f"{share('out_of_catalogue_named')} |",
        f"| `unknown_effect` | out-of-catalogue effects that are strong | – | {share('out_of_catalogue_unknown')} |",
        f"| no diagnosis (counted as missed) | all recordings | – | {share('not_diagnosed')} |",
        f"| error of the main parameter, median | the {error['count']} strong single effects that were correctly named "
        f"first and have a parameter to compare, of {error['of']} strong ones | 15 % | {100 * error['median']:.0f} % |",
        f"| reducible gap closed on cross-validated blocks, median | the {closed['count']} strong single effects and "
        f"pairs that were correctly named, of {closed['of']} strong ones | 80 % | {100 * closed['median']:.0f} % |",
        f"| time of a diagnosis of 60 s, median and longest, two at a time on two cores | all recordings | 180 s | "
        f"{found['seconds_median']:.0f} s, {found['seconds_most']:.0f} s |",
        "",
    ]
    if "baselines" in found:
        lines += [
            "Position error after 2 s [m], cross-validated; medians over the level recordings with one strong effect:",
            "",
        ]
        lines += ["| method | error | reducible gap closed |", "|---|---|---|"]
        lines += [
            f"| {name} | {entry['error']:.3f} | {100 * entry['closed']:.0f} % |"
            for name, entry in found["baselines"].items()
        ]
        lines.append("")
    if figure is not None:
        lines += [f"![injected effects and answers]({figure.name})", ""]
    lines += [
        "| injected | ground, noise | error over noise floor | verdict | found | closed |",
        "|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: (KINDS.index(row["kind"]), row["case"])):
        if row["kind"] == "empty":
            continue
        truth = ", ".join(
            f"{t['name']} {' '.join(f'{k} {v:g}' for k, v in t['parameters'].items() if v)}" for t in row["truth"]
        )
        found_effects = ", ".join(
            f"{e['name']} {' '.join(f'{k} {v["value"]:.3g}' for k, v in e['parameters'].items())}"
            for e in row["effects"]
        )
        closed = closed_share(row)
        lines.append(
            f"| {truth} | {row['ground']}, {row['noise']} | {gap_over_noise(row):.1f} | `{row['verdict']}` | "
            f"{found_effects or '–'} | {'–' if np.isnan(closed) else f'{100 * closed:.0f} %'} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--folder", type=Path, default=Path("out/hidden"), help="folder for recordings and reports (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=SEED, help="first seed (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="recordings diagnosed in parallel (%(default)s)")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="TEXT", help="only recordings whose name contains one of these"
    )
    parser.add_argument("--again", action="store_true", help="diagnose again even if there is a report")
    parser.add_argument("--baselines", action="store_true", help="compare with other methods (needs pysindy)")
    parser.add_argument("--json", type=Path, help="write rows and scores to this file")
    parser.add_argument(
        "--docs", type=Path, metavar="FILE", help="write the tables into this document, and a PNG next to it"
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    robot = commissioned(options.folder, options.seed)
    cases = [c for c in all_cases(options.seed) if c.kind != "healthy" and any(text in c.name for text in options.only)]
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        running = [pool.submit(run_case, case, options.folder, robot, options) for case in cases]
        with tqdm(total=len(cases), unit="recording") as bar:
            for done in as_completed(running):
                rows.append(done.result())
                bar.update()
    print_rows(rows)
    found = scores(rows)
    print(json.dumps(found, indent=1))
    for truth, answers in sorted(confusion(rows).items()):
        print(f"{truth:24s} " + ", ".join(f"{name} {count}" for name, count in answers.most_common()))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"scores": found, "rows": rows}, indent=1) + "\n")
    if options.docs:
        picture = options.docs.with_name("hidden_effects.png")
        picture.write_bytes(figure_png(confusion_figure(rows)))
        write_between(options.docs, "hidden effects", section(rows, found, picture, options.folder))


if __name__ == "__main__":
    main()
