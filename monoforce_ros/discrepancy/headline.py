"""Headline: what a diagnosis means, how sure it is and what to do, in a few sentences; what stays unexplained first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from monoforce_ros.discrepancy.comparison import ABOVE_NOISE, JUDGED, GapRow
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.learned import LEARNED
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.discrepancy.wording import cause, eased, finding, remedy

_NEVER = "the robot's file was never commissioned: this may be how the healthy robot is (diagnose --commission)"
_COMMISSION = "commission the robot while it is healthy: later reports then say what changed"
MOST = 0.5
"""Share of an error above which most of it is explained: by the meaning of "most"."""


class Tone(StrEnum):
    """How far a result can be acted on."""

    GOOD = "good"
    """The recording is explained."""
    PARTLY = "partly"
    """Something is known, and something is left or in doubt."""
    UNKNOWN = "unknown"
    """Nothing is known."""


@dataclass(frozen=True)
class Explained:
    """Errors after 2 s without and with the added effects, on data to which nothing was fitted."""

    metric: str
    """``position`` or ``heading``."""
    row: GapRow
    recording: str
    """Name of the held-out recording; empty for the held-out blocks of the diagnosed one."""
    healthy: float = 0.0
    """Median error of the healthy robot, if it is known."""

    @property
    def share(self) -> float:
        """Explained share of the error above the noise floor, at most 1; negative where the error grew."""
        assert self.row.after is not None
        reducible = self.row.before - self.row.noise
        return float(min((self.row.before - self.row.after) / reducible, 1.0)) if reducible > 0 else 0.0

    @property
    def counts(self) -> bool:
        """Whether there was an error to explain: above the noise, and larger than the healthy robot's."""
        return self.row.before > max(ABOVE_NOISE * self.row.noise, self.healthy)

    @property
    def grew(self) -> bool:
        """Whether the error is larger with the effects: its median, or beyond chance where it is mostly noise."""
        assert self.row.after is not None
        certain = self.row.gain_high is not None and self.row.gain_high < 0
        return self.row.after > self.row.before and (self.counts or (certain and self.row.after > self.healthy))


@dataclass(frozen=True)
class Headline:
    """The first screen of a report."""

    tone: Tone
    sentence: str
    unexplained: str
    """What is left of the error; empty where nothing was added."""
    findings: tuple[str, ...]
    """What is wrong, the most important first."""
    doubts: tuple[str, ...]
    """Why the findings may be wrong, or cannot be trusted."""
    confidence: tuple[str, ...]
    """How sure the findings are."""
    actions: tuple[str, ...]
    of_file: bool = False
    """Whether the findings are differences from a file that nobody commissioned, so that they need be no faults."""
    helps: bool = False
    """Whether the added effects improve predictions: no error after 2 s grew, and one at least shrank."""


def credible_effects(diagnosis: Diagnosis) -> tuple[tuple[EffectEstimate, ...], tuple[str, ...]]:
    """The effects that may be called found, and why the others may not."""
    judged = [(effect, complaint(effect)) for effect in diagnosis.effects]
    return tuple(e for e, why in judged if not why), tuple(why for _, why in judged if why)


def explained(diagnosis: Diagnosis) -> tuple[Explained, ...]:
    """Position and heading errors after 2 s, on held-out recordings, or else on held-out blocks of this one.

    Recordings shorter than the windows of 2 s have those at the longest shorter time.
    """
    shown = {recording: table for recording, table in (diagnosis.held_out or {}).items() if table}
    tables: Mapping[str, Mapping[str, GapRow]] = shown or {"": diagnosis.gap}
    found = []
    for recording, table in tables.items():
        for metric in ("position", "heading"):
            rows = [
                row
                for name, row in table.items()
                if name.startswith(f"{metric}_") and 0 < row.horizon <= JUDGED and row.after is not None
            ]
            if rows:
                row = max(rows, key=lambda row: row.horizon)
                # What is known of the healthy robot is its error at the end of a window.
                healthy = diagnosis.healthy.get(metric, 0.0) if row.horizon == JUDGED else 0.0
                found.append(Explained(metric, row, recording, healthy))
    return tuple(found)


def headline(diagnosis: Diagnosis, complaints: Sequence[str] = ()) -> Headline:
    """The first screen of a diagnosis.

    Args:
        diagnosis: the result.
        complaints: further reasons for doubt, such as ground that no map shows.
    """
    if diagnosis.verdict == Verdict.NOT_IDENTIFIABLE:
        return Headline(
            Tone.UNKNOWN, "This recording cannot be diagnosed.", "", tuple(diagnosis.advice), tuple(complaints),
            tuple(diagnosis.remarks), ("record again as said here, then run diagnose on the new recording",),
        )  # fmt: skip
    unknown = () if diagnosis.commissioned else (_NEVER,)
    if diagnosis.verdict == Verdict.NO_DISCREPANCY:
        return _without_discrepancy(diagnosis, complaints, unknown)
    effects, refused = credible_effects(diagnosis)
    doubts = [*unknown, *complaints, *refused]
    named = [effect for effect in effects if effect.name != LEARNED]
    rows = explained(diagnosis)
    # Where nothing was added to the motion, what was found is a sensor's own measurement.
    by_sensors = diagnosis.verdict == Verdict.EFFECT_FOUND and bool(named) and not diagnosis.fitted
    complete = by_sensors and not diagnosis.motion_unexplained
    left = _left(rows) or ("" if complete else "Unexplained: all of the error.")
    left += _of_localisation(diagnosis)
    confidence = [*_sizes(diagnosis), *_intervals(effects)]
    for effect in named:
        if effect.indistinguishable:
            others = " or ".join(cause(other) for other in effect.indistinguishable)
            doubts.append(f"{cause(effect.name)} could as well be {others}: this recording cannot tell them apart")
    unstable = [effect for effect in named if effect.found_again and 2 * effect.found_again[0] < effect.found_again[1]]
    doubts += [
        f"{_class_of(effect)}: drive longer to be sure"
        if effect.named_otherwise
        else f"{cause(effect.name)} shows in a part of the recording only: drive longer to be sure"
        for effect in unstable
    ]
    counted = [row for row in rows if row.counts]
    grew = [row for row in rows if row.grew]
    # A recording from before the fault says nothing of what explains it.
    elsewhere = bool(rows) and not counted and all(row.recording for row in rows)
    remedies = [
        f"{cause(effect.name)}: less than in the robot's file; if nothing was repaired, commission the robot again"
        if eased(effect)
        else remedy(effect.name)
        for effect in effects
    ]
    remedies += [
        f"if it is {cause(other)} instead: {remedy(other)}"
        for effect in named
        for other in (*effect.indistinguishable, *effect.named_otherwise)
    ]
    if complaints:
        # What was found under a doubt about the recording or the ground may be nothing but its cause.
        remedies = ["remove the cause of the doubt first, then run diagnose again"]
    elif grew and elsewhere:
        question = (
            "if the held-out recordings were driven with the same fault, do not use what was found; else hold out "
        )
        remedies = [f"{question}some that were", *remedies]
    elif grew:
        remedies = ["do not use what was found yet: drive longer, with more kinds of motion, and run diagnose again"]
    actions = [*remedies, *diagnosis.advice]
    if not diagnosis.commissioned:
        actions.append(_COMMISSION)
    doubts += [_growth(row) for row in grew]
    enough = bool(counted) and all(row.share >= MOST for row in counted)
    findings = tuple(
        f"{_class_of(effect)}. By all of it: {finding(effect)}" if effect.named_otherwise else finding(effect)
        for effect in effects
    )
    parts = _of_parts(diagnosis) if diagnosis.verdict == Verdict.UNKNOWN_EFFECT and not named else ()
    findings += parts
    if not named:
        # Without a name for it, where the error shows is what is known.
        findings += tuple(
            f"The {entry.axis} shows most in this regime: {entry.regime} ({100 * entry.share_of_error:.0f} % of it)."
            for entry in diagnosis.localisation[:2]
        )
    if diagnosis.part:
        findings += (diagnosis.part,)
    findings += diagnosis.observed
    helps = bool(effects) and not grew and not refused and any(row.share > 0 for row in rows)

    def result(tone: Tone, sentence: str) -> Headline:
        return Headline(
            tone, sentence, left, findings, tuple(doubts), tuple(confidence), tuple(dict.fromkeys(actions)),
            of_file=not diagnosis.commissioned, helps=helps,
        )  # fmt: skip

    if diagnosis.verdict == Verdict.UNKNOWN_EFFECT:
        sentence = "Something is wrong that no known effect explains."
        if diagnosis.not_found_again:
            sentence = "Something is wrong; what explains it hangs on a part of the recording, and is not named."
        elif parts:
            sentence = "Something is wrong; what is known explains a part of it, and not enough to be the cause alone."
        if named:
            sentence = "Something is wrong that no known effect explains, besides what was found."
        return result(Tone.UNKNOWN, sentence)
    if diagnosis.verdict == Verdict.NO_IMPROVEMENT or not effects:
        sentence = "The robot does not move as predicted, and the cause is not established."
        return result(Tone.UNKNOWN, sentence)
    if by_sensors:
        sentence = "A sensor shows what is wrong; nothing had to be added to how the robot moves."
        if not complete:
            sentence = "A sensor shows a fault; besides, the robot does not move as predicted."
        sure = complete and not refused and not complaints and not unknown
        return result(Tone.GOOD if sure else Tone.PARTLY, sentence)
    if enough and not grew and not refused and not complaints and not unstable:
        if unknown:
            differ = (
                "one difference from its file explains" if len(effects) == 1 else "differences from its file explain"
            )
            return result(Tone.PARTLY, f"The robot was never commissioned: {differ} the error.")
        sentence = "The cause was found." if len(effects) == 1 else f"{len(effects)} causes were found."
        if any(effect.indistinguishable for effect in named):
            sentence = "The error is explained, by causes of which this recording cannot tell some apart."
        return result(Tone.GOOD, sentence)
    if elsewhere:
        sentence = "A cause was found, but the held-out recordings show no error that it could explain."
    elif grew and not any(row.share >= MOST for row in counted):
        sentence = "The error is not explained: with what was found, predictions get worse."
    elif not enough:
        sentence = "Most of the error is not explained; a part of the cause was found."
    elif grew:
        sentence = f"A cause was found, but with it the {grew[0].metric} error grows."
    elif any(effect.named_otherwise for effect in unstable):
        sentence = "The error is explained, but the name of its cause changes with the part of the recording."
    else:
        sentence = "A cause was found, with doubts."
    return result(Tone.PARTLY, sentence)


def _of_parts(diagnosis: Diagnosis) -> tuple[str, ...]:
    """What known effects explain of an unknown one, and how much of it; empty where that is not most of it."""
    parts = [part for part in diagnosis.known_parts if part.name != LEARNED and not complaint(part)]
    share = None if diagnosis.losses is None else diagnosis.losses.share_explained
    if not parts or share is None or share < MOST:
        return ()
    found = " ".join(finding(part) for part in parts)
    if diagnosis.not_found_again:
        return (f"On the whole recording it looks like this, which searches without a part of it do not find: {found}",)
    size = f"{100 * share:.0f} % of the loss"
    if diagnosis.commissioned:
        size += " in excess of a healthy robot's"
    return (f"A part of the error ({size}) looks like this: {found}",)


def _class_of(effect: EffectEstimate) -> str:
    """One class of an effect and what other parts of the recording name in its place."""
    *names, last = (cause(name) for name in (effect.name, *effect.named_otherwise))
    return f"The name changes with the part of the recording: {', '.join(names)} or {last}"


def _without_discrepancy(diagnosis: Diagnosis, complaints: Sequence[str], unknown: Sequence[str]) -> Headline:
    """The first screen where nothing is missing in the model; ``unknown`` says that the healthy robot is."""
    observed, tone = diagnosis.observed, Tone.PARTLY
    if observed and not complaints:
        sentence = "The robot moves as its model predicts, but something else is not as usual."
    elif complaints:
        # A model that misses the healthy robot by much cannot say that nothing is wrong.
        sentence = "No change was found, with doubts: the errors are as large as the healthy robot's."
        if unknown:
            sentence = "No difference from the robot's file was found, with doubts."
    elif unknown:
        sentence = "The robot was never commissioned: no difference from its file was found."
    else:
        sentence, tone = "Nothing is wrong: the robot moves as its model predicts.", Tone.GOOD
    actions = (*diagnosis.advice, *((_COMMISSION,) if unknown else ()))
    return Headline(
        tone, sentence, "", observed, (*unknown, *complaints), _sizes(diagnosis), actions, of_file=bool(unknown)
    )


def _left(rows: Sequence[Explained]) -> str:
    """What stays unexplained, in one sentence."""
    texts = []
    for row in rows:
        where = f" on {row.recording}" if row.recording else ""
        if not row.counts and row.row.before > ABOVE_NOISE * row.row.noise:
            texts.append(f"the {row.metric} error{where} was no larger than the healthy robot's before")
        elif not row.counts:
            texts.append(f"the {row.metric} error{where} was hardly above the noise before")
        elif row.grew:
            texts.append(f"all of the {row.metric} error{where}, which grew")
        else:
            texts.append(f"{100 * (1 - max(row.share, 0.0)):.0f} % of the {row.metric} error{where}")
    return f"Unexplained after {rows[0].row.horizon:g} s: {'; '.join(texts)}." if texts else ""


def _of_localisation(diagnosis: Diagnosis) -> str:
    """What the localisation itself errs by, in one sentence; empty where nothing shows it."""
    if diagnosis.localisation_error is None or diagnosis.noise_floor is None:
        return ""
    return (
        f" Poses and gyro turn {diagnosis.localisation_error:.2g}° apart within {diagnosis.noise_floor.horizon:g} s: "
        "by so much the localisation itself errs, whatever the model."
    )


def _growth(row: Explained) -> str:
    where = f" on {row.recording}" if row.recording else ""
    assert row.row.after is not None
    before, after = _apart(row.row.before, row.row.after)
    return (
        f"the {row.metric} error{where} grows with these effects, from {before} to {after} {row.row.unit} after "
        f"{row.row.horizon:g} s"
    )


def _apart(before: float, after: float) -> tuple[str, str]:
    """Two numbers, with as many digits as it takes to see that they differ, at least two and at most four."""
    texts = ("", "")
    for digits in (2, 3, 4):
        texts = (f"{before:.{digits}g}", f"{after:.{digits}g}")
        if texts[0] != texts[1]:
            break
    return texts


def _sizes(diagnosis: Diagnosis) -> tuple[str, ...]:
    """The size of the errors, before and after, in plain numbers."""
    parts = "held-out parts of this recording" if diagnosis.repeated else "blocks of this recording left out of the fit"
    texts = []
    for row in explained(diagnosis):
        where = f"held-out recording {row.recording}" if row.recording else parts
        unit = "°" if row.row.unit == "deg" else f" {row.row.unit}"
        assert row.row.after is not None
        before, after = _apart(row.row.before, row.row.after)
        texts.append(
            f"{row.metric} error after {row.row.horizon:g} s: {before} → {after}{unit} "
            f"(median, {where}; noise {row.row.noise:.2g}{unit})"
        )
    if texts:
        return tuple(texts)
    for metric in ("position", "heading"):
        rows = [
            entry for name, entry in diagnosis.gap.items() if name.startswith(metric) and 0 < entry.horizon <= JUDGED
        ]
        if rows:
            last = max(rows, key=lambda entry: entry.horizon)
            unit = "°" if last.unit == "deg" else f" {last.unit}"
            size, noise = f"{last.before:.2g}{unit}", f"{last.noise:.2g}{unit}"
            texts.append(f"{metric} error after {last.horizon:g} s: {size} (median; noise {noise})")
    return tuple(texts)


def _intervals(effects: Sequence[EffectEstimate]) -> list[str]:
    """The 95 % intervals of each effect's values."""
    texts = []
    for effect in effects:
        if effect.name == LEARNED:
            continue
        listed = []
        for key, value in effect.shown.items():
            unit = "" if value.unit == "-" else f" {value.unit}"
            listed.append(f"{key.replace('_', ' ')} {value.low:.3g} to {value.high:.3g}{unit}")
        texts.append(f"{cause(effect.name)}: {', '.join(listed)} with 95 % confidence")
        if effect.found_again is not None:
            times, of = effect.found_again
            texts[-1] += f"; found again in {times} of {of} searches, each without another part of the recording"
    return texts
