"""Page of a diagnosis: one screen that says what is wrong, how sure and what to do, and the evidence below it."""

from __future__ import annotations

import html
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from monoforce_ros.discrepancy.comparison import ABOVE_NOISE, GapRow
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.figures import (
    candidates_figure,
    gap_figure,
    map_figure,
    paths_figure,
    regime_figure,
    timeline_figure,
)
from monoforce_ros.discrepancy.headline import Headline, Tone, credible_effects, headline
from monoforce_ros.discrepancy.kinematic_baseline import StepComparison
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.discrepancy.wording import finding
from monoforce_ros.reporting import card, definition_list, figure_png, page, picture, table

_CROSS_VALIDATED = (
    "Each window is predicted with values fitted to other blocks of the recording, which is too short to be searched "
    "again without each part of it. Two things are not held out: values measured by the gyro or the wheel speeds come "
    "from the whole recording, and the effects were selected on these same blocks. The improvement is therefore "
    "somewhat optimistic; check it on another recording (--held-out)."
)
_REPEATED = (
    "Each window is predicted with what a search that never saw its part of the recording found there: sensors were "
    "compared, effects selected and values fitted without it."
)
_WITH_PART = "Where or when they act alone was chosen on the whole recording."
_COLOURS = {Tone.GOOD: "#0b6e4f", Tone.PARTLY: "#b3540e", Tone.UNKNOWN: "#a11d33"}
_STYLE = """<style>
.facts { display: flex; flex-wrap: wrap; gap: 4px 26px; color: #51606e; margin: 2px 0 14px; }
.facts b { color: #1c2733; font-weight: 600; }
.result { border-left: 8px solid var(--tone); }
.result h2 { font-size: 23px; margin: 0 0 4px; color: var(--tone); }
.result p.left { font-size: 17px; margin: 0 0 12px; }
.columns { display: grid; grid-auto-flow: column; grid-auto-columns: minmax(0, 1fr); gap: 8px 28px; }
.columns h3 { font-size: 13px; text-transform: uppercase; letter-spacing: .06em; color: #6b7a88; margin: 6px 0 4px; }
.columns ul { margin: 0; padding-left: 18px; } .columns li { margin-bottom: 5px; }
.columns ul.found { font-size: 16px; } .columns li.doubt { color: #b3540e; }
@media (max-width: 760px) { .columns { grid-auto-flow: row; } }
</style>"""
_INPUTS = {
    "data": "fingerprint of the data",
    "recording_s": "length of the recording [s]",
    "driven_m": "distance driven [m]",
    "terrain": "--terrain",
    "duration_s": "time that the diagnosis took [s]",
}
"""What entries of ``report.json`` are called on the page."""
_MOST_LISTED = 6
"""Entries of each list on the first screen; the others are below it."""


def diagnosis_page(
    diagnosis: Diagnosis,
    inputs: Mapping[str, object],
    robot_file: Path | None,
    complaints: Sequence[str] = (),
    written: Collection[str] | None = None,
) -> str:
    """The whole page as HTML.

    Args:
        diagnosis: the result.
        inputs: bag, robot and settings, by name; ``bag``, ``robot``, ``recording_s`` and ``ground`` go to the top.
        robot_file: the written robot file.
        complaints: reasons for doubt that are not part of the diagnosis.
        written: names of the effects in the robot file; by default all.
    """
    top = headline(diagnosis, complaints)
    names = [effect.name for effect in diagnosis.effects]
    in_file = [name for name in names if written is None or name in written]
    parts = [_STYLE, _facts(inputs), _result(top, robot_file, in_file, [name for name in names if name not in in_file])]
    if diagnosis.remarks and diagnosis.verdict != Verdict.NOT_IDENTIFIABLE:
        reasons = f"<ul>{_list_items(diagnosis.remarks)}</ul>"
        parts.append(card(reasons, heading=f"Why the verdict is {diagnosis.verdict}"))
    details = diagnosis.details
    if diagnosis.effects:
        parts.append(_effects_cards(diagnosis))
    if diagnosis.gap:
        parts.append(_gap_card(diagnosis))
    if diagnosis.held_out:
        parts.append(_held_out_card(diagnosis))
    if diagnosis.steps is not None:
        parts.append(_steps_card(diagnosis.steps))
    if details is not None and details.paths:
        parts.append(
            card(
                _image(paths_figure(details.paths), "predicted and measured paths from above"),
                heading="Predicted and measured paths",
                caption="Five seconds each, seen from above, the start heading to the right; from the largest error "
                "down to the median.",
            )
        )
    if diagnosis.localisation or diagnosis.regimes:
        items = _list_items(
            f"{entry.text} (RMS {_size(entry.rms, entry.unit)}, mean {_size(entry.bias, entry.unit, '+')})"
            for entry in diagnosis.localisation[:5]
        )
        figure = _image(regime_figure(diagnosis.regimes), "error by motion regime") if diagnosis.regimes else ""
        parts.append(card(f"<ol>{items}</ol>{figure}", heading="Where the error is largest"))
    if details is not None and details.compared:
        parts.append(card(_image(map_figure(details), "errors on the map"), heading="On the map"))
        parts.append(card(_image(timeline_figure(details), "errors over time"), heading="Over time"))
    if diagnosis.candidates:
        parts.append(card(_image(candidates_figure(diagnosis), "gain of each effect"), heading="Effects tested"))
    entries = {_INPUTS.get(key, key): value for key, value in inputs.items() if key != "ground_unknown"}
    if robot_file is not None:
        added = "the added effects" if len(in_file) == len(names) else " and ".join(in_file)
        entries[f"robot file with {added}"] = robot_file
    parts.append(card(definition_list(entries), heading="Inputs"))
    robot = Path(str(inputs.get("robot", ""))).stem
    return page("Diagnosis", "".join(parts), heading=f"Diagnosis of {robot}" if robot else "Diagnosis")


def _size(value: float, unit: str, sign: str = "") -> str:
    """A number with its unit; angles in degrees, as everywhere on the page."""
    if unit.startswith("rad"):
        value, unit = math.degrees(value), unit.replace("rad", "°", 1)
    return f"{value:{sign}.2g}{'' if unit.startswith('°') else ' '}{unit}"


def _facts(inputs: Mapping[str, object]) -> str:
    """Bag, robot, duration and ground in one line."""
    facts = [(name, str(inputs[name])) for name in ("bag", "robot") if name in inputs]
    if isinstance(inputs.get("recording_s"), int | float):
        driven = f", {inputs['driven_m']} m driven" if "driven_m" in inputs else ""
        facts.append(("recording", f"{inputs['recording_s']} s{driven}"))
    if "ground" in inputs:
        facts.append(("ground", str(inputs["ground"])))
    return f"<div class='facts'>{''.join(f'<span>{k} <b>{html.escape(v)}</b></span>' for k, v in facts)}</div>"


def _result(top: Headline, robot_file: Path | None, in_file: Sequence[str], left_out: Sequence[str]) -> str:
    """What is wrong, how sure, and what to do.

    Args:
        top: the result.
        robot_file: the written robot file.
        in_file, left_out: names of the effects that this file has, and of the others.
    """
    actions = list(top.actions)
    if robot_file is not None and left_out:
        # Errors before and after are those with all effects: they say nothing of this file alone.
        lacks = f"{' and '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} not in it"
        actions.insert(
            0, f"to predict with {' and '.join(in_file)}, give {robot_file.name} of this folder as the robot; {lacks}"
        )
    elif robot_file is not None and top.helps:
        actions.insert(0, f"to predict with these effects, give {robot_file.name} of this folder as the robot")
    elif robot_file is not None:
        actions.insert(0, f"keep your robot file: {robot_file.name} of this folder does not predict better")
    wrong = _list_items(top.findings[:_MOST_LISTED] or ("nothing",))
    sure = _list_items(top.doubts[:_MOST_LISTED], "doubt") + _list_items(top.confidence[:_MOST_LISTED])
    left = f"<p class='left'>{html.escape(top.unexplained)}</p>" if top.unexplained else ""
    columns = "".join(
        f"<div><h3>{heading}</h3><ul class='{kind}'>{items}</ul></div>"
        for heading, kind, items in (
            ("What differs from the robot file" if top.of_file else "What is wrong", "found", wrong),
            ("How sure", "sure", sure),
            ("What to do", "actions", _list_items(actions[:_MOST_LISTED])),
        )
        if items
    )
    rest = [text for texts in (top.findings, top.doubts, top.confidence, actions) for text in texts[_MOST_LISTED:]]
    below = card(f"<ul>{_list_items(rest)}</ul>", heading="Also") if rest else ""
    return (
        f"<section class='card result' style='--tone:{_COLOURS[top.tone]}'><h2>{html.escape(top.sentence)}</h2>{left}"
        f"<div class='columns'>{columns}</div></section>{below}"
    )


def _effects_cards(diagnosis: Diagnosis) -> str:
    """Effects with their values; those that may not be called found apart from the others."""
    credible, _ = credible_effects(diagnosis)
    refused = [effect for effect in diagnosis.effects if effect not in credible]
    unknown = diagnosis.verdict == Verdict.UNKNOWN_EFFECT
    title = "Best formula for the error" if unknown else "Effects missing in the model"
    cards = []
    if credible:
        cards.append(card(_effects_table(credible), heading=title))
    if refused:
        listed = _list_items(complaint(effect) for effect in refused)
        cards.append(card(f"<ul>{listed}</ul>{_effects_table(refused)}", heading="Fitted, but not established"))
    return "".join(cards)


def _effects_table(effects: Sequence[EffectEstimate]) -> str:
    rows = []
    for effect in effects:
        for number, (key, parameter) in enumerate(effect.shown.items()):
            name = f"<b>{effect.name}</b><br><small>{html.escape(finding(effect))}</small>" if number == 0 else ""
            others = html.escape(", ".join(effect.indistinguishable)) or "–"
            rows.append(
                f"<tr><td style='white-space:normal'>{name}</td><td>{key}</td>"
                f"<td><b>{parameter.value:.3g}</b>{'' if parameter.unit == '-' else ' ' + parameter.unit}</td>"
                f"<td>{parameter.low:.3g} to {parameter.high:.3g}</td>"
                f"<td style='white-space:normal'>{others if number == 0 else ''}</td></tr>"
            )
    return table(("effect", "parameter", "value", "95 % confidence interval", "indistinguishable from"), rows)


def _gap_card(diagnosis: Diagnosis) -> str:
    rows = []
    for metric, row in diagnosis.gap.items():
        # Of an error that is hardly more than noise no share means anything.
        closed = "–"
        if row.closed is not None and row.before > ABOVE_NOISE * row.noise:
            closed = f"{100 * row.closed:.0f} %"
        rows.append(
            f"<tr><td>{_metric(metric, row)}</td><td>{row.noise:.2g} {row.unit}</td>"
            f"<td>{row.before:.3g} {row.unit}</td>{_after_cells(row)}<td>{closed}</td></tr>"
        )
    note = f"{_held_out_note(diagnosis)} " if diagnosis.fitted else ""
    head = ("median error", "noise floor", "before", "after", "mean gain, 95 % interval", "reducible gap closed")
    return card(
        _image(gap_figure(diagnosis), "errors before and after") + table(head, rows),
        heading="Prediction error",
        caption=f"{note}The reducible gap is the error above the noise floor.",
    )


def _held_out_note(diagnosis: Diagnosis) -> str:
    """What the errors with the added effects never saw."""
    note = _REPEATED if diagnosis.repeated else _CROSS_VALIDATED
    return f"{note} {_WITH_PART}" if diagnosis.part else note


def _after_cells(row: GapRow) -> str:
    if row.after is None:
        return "<td>–</td><td>–</td>"
    return f"<td><b>{row.after:.3g} {row.unit}</b></td><td>{row.gain_low:.2g} to {row.gain_high:.2g}</td>"


def _metric(metric: str, row: GapRow) -> str:
    if not row.horizon:
        return "yaw rate against the gyro"
    return f"{metric.split('_')[0]} after {row.horizon:g} s"


def _held_out_card(diagnosis: Diagnosis) -> str:
    rows = [
        f"<tr><td>{html.escape(name) if number == 0 else ''}</td><td>{_metric(metric, row)}</td>"
        f"<td>{row.before:.3g} {row.unit}</td>{_after_cells(row)}</tr>"
        for name, metrics in diagnosis.held_out.items()
        for number, (metric, row) in enumerate(metrics.items())
    ]
    return card(
        table(("recording", "median error", "before", "after", "mean gain, 95 % interval"), rows),
        heading="On held-out recordings",
        caption="Nothing was fitted to or selected on these recordings.",
    )


def _steps_card(steps: StepComparison) -> str:
    """Errors after steps of the command, by method."""
    methods = [
        ("commands followed at once", steps.ideal),
        ("nominal model", steps.before),
        ("kinematic fit: gains, dead time, lag, limits", steps.kinematic),
        ("with the added effects", steps.after),
    ]
    best = min(error for _, error in methods if error is not None)
    methods.append(("measured wheel speeds and yaw rates, no prediction", steps.reckoned))
    rows = [
        f"<tr><td>{name}</td><td{' class=best' if error == best else ''}>{error:.3g} m</td></tr>"
        for name, error in methods
        if error is not None
    ]
    return card(
        table(("method", "median position error"), rows),
        heading="Two seconds after a step of the command",
        caption=f"The measure of the literature, on {steps.windows} windows that begin with a step; all methods know "
        f"the measured speed at the start. {_HELD_OUT[steps.selected_apart]}{_beside_kinematic(steps)}"
        f"{_limit_of_the_poses(steps)}",
    )


_HELD_OUT = {
    False: "Kinematic fit and effects are fitted to every other block of 8 s, and tested on the others.",
    True: "Kinematic fit and effects are tested on parts of the recording without which they were fitted, and without "
    "which the effects were selected, too.",
}


def _beside_kinematic(steps: StepComparison) -> str:
    """How sure the difference to the kinematic fit is."""
    if steps.ahead is None:
        return ""
    low, high = steps.ahead
    if low <= 0.0 <= high:
        return f" Effects and kinematic fit differ by no more than chance ({low:+.2f} to {high:+.2f} m)."
    ahead = "smaller" if low > 0.0 else "larger"
    near, far = sorted((abs(low), abs(high)))
    return f" The errors with effects are {ahead} than those of the kinematic fit, by {near:.2f} to {far:.2f} m (95 %)."


def _limit_of_the_poses(steps: StepComparison) -> str:
    """What measured wheel speeds and yaw rates leave, which is the poses' own error or slip."""
    if steps.reckoned is None:
        return ""
    return (
        " What measured wheel speeds and yaw rates leave is slip and errors of the poses: hardly a prediction from "
        "commands can be expected to leave less."
    )


def _list_items(texts: Iterable[str], kind: str = "") -> str:
    attribute = f" class='{kind}'" if kind else ""
    return "".join(f"<li{attribute}>{html.escape(_sentence(text))}</li>" for text in texts)


def _sentence(text: str) -> str:
    """A text with a capital letter first, unless it begins with the name of an effect."""
    name = text.split(" ", 1)[0]
    return text if "_" in name else text[:1].upper() + text[1:]


def _image(figure: Figure, alt: str) -> str:
    return picture(figure_png(figure), alt=alt)
