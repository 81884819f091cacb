"""Diagnosis: is anything missing in the model of a robot, what is it, and how much of the gap does it close?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from monoforce_ros.discrepancy.clocks import GyroFinding, compare_with_gyro
from monoforce_ros.discrepancy.commissioning import COMMISSIONED
from monoforce_ros.discrepancy.comparison import compare, gap_table, measured_paths, regime_table
from monoforce_ros.discrepancy.fit import described
from monoforce_ros.discrepancy.gap import find_regimes, localise, map_floor, noise_floor, noisy_motions, residual_scale
from monoforce_ros.discrepancy.hypothesis import Effects, Evidence, corrected_evidence, subsampled, window_starts
from monoforce_ros.discrepancy.learned import LEARNED, formula
from monoforce_ros.discrepancy.preflight import advice, complaints
from monoforce_ros.discrepancy.selection import BLOCK, HEALTHY_LOSS, SMALLEST_GAIN, Outcome, Search, Trial, paired
from monoforce_ros.discrepancy.wheels import WheelFinding, compare_with_wheels
from monoforce_ros.effects import CATALOGUE, FEATURE_SIZES, FEATURES
from monoforce_ros.robots import RobotModel

VERDICTS = ("effect_found", "no_discrepancy", "unknown_effect", "not_identifiable", "no_improvement")
SMALLEST_SHARE = 0.6
"""Of what is to explain: effects that explain less are not what is missing."""
LARGEST_DRIFT = 0.12
"""Of what is to explain: parameters that would have to change by more over the drive are not those of one effect."""
_CLEARLY = 3.0 * HEALTHY_LOSS
_WELL = 2.0 * HEALTHY_LOSS
"""Loss from which on something is missing, whether it can be named or not."""


@dataclass(frozen=True)
class Settings:
    """How a drive is diagnosed."""

    horizon: float = 2.0
    stride: float = 1.0
    samples: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    most_effects: int = 4
    most_windows: int = 120
    """Of a longer drive as many are looked at, spread over all of it."""
    seed: int = 0


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    verdict: str
    effects: tuple[dict, ...]
    """``name``, ``parameters`` {name: {value, low, high, unit}}, ``rivals``; of an ``unknown_effect`` the formula."""
    localisation: tuple[dict, ...]
    gap: dict[str, dict]
    """By metric: ``horizon_s``, ``before``, ``after``, ``low``, ``high`` (of the gain), ``unit``, ``noise``, and
    ``closed``, the share of what is above the noise."""
    floor: dict[str, dict]
    advice: tuple[str, ...]
    candidates: tuple[dict, ...] = ()
    """Every effect that was tried with its gain on data that its fit did not see."""
    regimes: tuple[dict, ...] = ()
    """Errors at 2 s by regime, before and after."""
    held_out: dict[str, dict] = field(default_factory=dict)
    """Tables as ``gap`` of further drives, by name."""
    fitted: Effects = ()
    remarks: tuple[str, ...] = ()
    """Why the verdict is what it is."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Losses by which the verdict was reached."""
    details: dict = field(default_factory=dict)
    """Arrays for pictures."""


def diagnose(
    drive: Evidence,
    robot: RobotModel,
    *,
    nominal_residual: np.ndarray | None = None,
    settings: Settings = Settings(),
    progress: Callable[[float, str], None] = lambda share, what: None,
) -> Diagnosis:
    """Find which physical effect a robot's model lacks on a drive.

    Args:
        drive: motion, commands and ground.
        robot: the nominal model; its file's effects act already.
        nominal_residual: what disagreed on the healthy robot, root mean square ``[K, 3]`` at ``settings.samples``.
        settings: of the diagnosis.
        progress: called with the share of the work done and what comes next.
    """
    progress(0.0, "preflight")
    # What the robot's file says of its sensors and clocks is known already.
    drive = corrected_evidence(drive, robot.effects)
    smoothed = drive.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, settings.horizon, settings.stride)
    starts = subsampled(starts, BLOCK, settings.most_windows)
    found = complaints(smoothed, drive.commands, starts)
    if found:
        return Diagnosis("not_identifiable", (), (), {}, {}, tuple(found))
    samples = np.array(settings.samples)
    data = drive.cut(starts, samples)
    progress(0.02, "noise floor")
    noisy = noisy_motions(smoothed, settings.seed)
    floor = np.hypot(noise_floor(smoothed.motion, noisy, data), map_floor(robot, data, drive.halves))
    scale = residual_scale(floor, nominal_residual)
    gyro = compare_with_gyro(smoothed, drive.turning)
    own = dict(robot.effects)
    known: Effects = ()
    if gyro is not None and gyro.poses_late and "pose_clock_offset" not in own:
        known = (("pose_clock_offset", {"offset": gyro.offset}),)
    wheels = None
    if not any(CATALOGUE[name].stage == "command" and name not in dict(COMMISSIONED) for name in own):
        # Of a file that knows how its drives answer already, only what the poses show beyond it is sought.
        wheels = compare_with_wheels(drive.commands, drive.wheels, robot)
    if wheels is not None:
        known += wheels.effects
    search = Search(
        robot,
        data,
        scale,
        known=known,
        # With a gyro beside them the poses' clock is known, late or not.
        excluded=() if gyro is None else ("pose_clock_offset",),
        progress=_Steps(progress, 0.05, 0.85),
    )
    if gyro is not None and known and known[0][0] == "pose_clock_offset" and wheels is not None:
        # The gyro says about how late the poses are; with the drives' own delay known, the motion says it finer.
        offsets = gyro.offset + gyro.offset_half * np.linspace(-1.5, 1.5, 13)
        tried = [(("pose_clock_offset", {"offset": float(offset)}), *known[1:]) for offset in offsets]
        search.known = min(tried, key=lambda effects: float(search.loss_of(effects).mean()))
    before = search.predictions.residuals([()])[0]
    outcome = search.run(settings.most_effects)
    verdict, shown, remarks, numbers = _verdict(search, outcome)
    progress(0.88, "comparing before and after")
    # What is written into a file is fitted to the whole drive, and judged by fits that saw a part of it.
    effects: tuple[dict, ...] = ()
    fitted: Effects = ()
    parts = None
    if shown is not None:
        whole = search.refit(shown.effects)
        fitted, parts = whole.effects, shown.parts
        listed = [_measured(entry, gyro, wheels) for entry in described(whole, outcome.rivals)]
        # What matters most is named first, whatever was found first.
        effects = tuple(listed[i] for i in search.ranked(whole))
    compared = compare(robot, data, smoothed, parts, noisy)
    gap = gap_table(compared, settings.seed)
    reached = [row for metric, row in gap.items() if row["low"] > 0 and metric.endswith(("_1s", "_2s"))]
    if verdict == "effect_found" and not reached:
        verdict, remarks = "no_improvement", (*remarks, "held-out windows do not gain by it beyond chance")
        effects, fitted, parts = (), (), None
    if gyro is not None and gyro.biased and "gyro_bias" not in own and verdict in ("no_discrepancy", "effect_found"):
        effects, gap = (*effects, _bias_entry(gyro)), {**gap, "yaw_rate_gyro": _bias_gap(gyro)}
        remarks = (*remarks, "the gyro turns while the poses do not")
        verdict = "effect_found"
    if wheels is not None and drive.wheels is not None:
        remarks = (*remarks, wheels.told())
    two = next((c for c in compared if c.horizon == settings.horizon), None)
    allowed = np.hypot(floor, 0 if nominal_residual is None else nominal_residual)
    details = {
        "data": data,
        "starts": starts,
        "before": before,
        "scale": scale,
        "floor": floor,
        "compared": compared,
        "paths": measured_paths(robot, data, parts),
    }
    progress(1.0, "done")
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        localisation=tuple(localise(before, allowed, data, find_regimes(data))),
        gap=gap,
        floor={
            name: {
                "horizon_s": float(samples[-1]),
                "value": float(floor[-1, axis]),
                "unit": "rad" if axis == 2 else "m",
            }
            for axis, name in enumerate(("along", "across", "heading"))
        },
        advice=advice(verdict, effects),
        candidates=outcome.tried,
        regimes=tuple(regime_table(two)) if two is not None else (),
        fitted=fitted,
        remarks=tuple(remarks),
        numbers=numbers,
        details=details,
    )


def _measured(entry: dict, gyro: GyroFinding | None, wheels: WheelFinding | None) -> dict:
    """The entry of a report, with the interval of the gyro or of the wheels where these measured it."""
    if gyro is not None and entry["name"] == "pose_clock_offset":
        half = gyro.offset_half
    elif wheels is not None and entry["name"] in dict(wheels.effects):
        half = dict(zip(dict(wheels.effects), wheels.halves, strict=True))[entry["name"]]
    else:
        return entry
    parameters = {
        key: {**value, "low": value["value"] - half, "high": value["value"] + half}
        for key, value in entry["parameters"].items()
    }
    return {"name": entry["name"], "parameters": parameters, "rivals": []}


def _bias_entry(gyro: GyroFinding) -> dict:
    half = gyro.bias_half
    value = {"value": gyro.bias, "low": gyro.bias - half, "high": gyro.bias + half, "unit": "rad/s"}
    return {"name": "gyro_bias", "parameters": {"bias": value}, "rivals": []}


def _bias_gap(gyro: GyroFinding) -> dict:
    """What the gyro's yaw rate differs by from the poses', as a row of the gap."""
    before, after = gyro.spread, gyro.spread_without
    gain = abs(gyro.bias)
    return {
        "horizon_s": 0.0, "before": before, "after": after, "low": gain - gyro.bias_half, "high": gain + gyro.bias_half,
        "unit": "rad/s", "noise": after,
    }  # fmt: skip


def _verdict(search: Search, outcome: Outcome) -> tuple[str, Trial | None, tuple[str, ...], dict[str, float]]:
    """The verdict, what is to be shown of it, why, and the numbers by which it was reached."""
    nominal, best = outcome.nominal, outcome.best
    if search.known and best.names == tuple(name for name, _ in search.known):
        # What the gyro measured is a fact; it explains what it can.
        remarks = ("the gyro and the wheels' own speeds show it, whatever the ground does",)
        share = (nominal.loss - best.loss) / max(nominal.loss - HEALTHY_LOSS, 1e-6)
        if nominal.loss > best.loss and (best.loss < _CLEARLY or share > SMALLEST_SHARE):
            numbers = {"loss_before": nominal.loss, "loss_after": best.loss, "share_explained": share}
            return "effect_found", best, remarks, numbers
    excess = nominal.loss - HEALTHY_LOSS
    numbers = {"loss_before": nominal.loss, "loss_after": best.loss, "loss_of_a_healthy_robot": HEALTHY_LOSS}
    if not best.effects and nominal.loss < _CLEARLY:
        return "no_discrepancy", None, ("the disagreement is no larger than noise and a healthy robot's",), numbers
    share = (nominal.loss - best.loss) / max(excess, 1e-6)
    remarks = (f"{100 * min(share, 1.0):.0f} % of the disagreement is explained by {' and '.join(best.names)}",)
    if best.effects:
        numbers["share_explained"] = share
        if best.loss < 1.2 * HEALTHY_LOSS:
            return "effect_found", best, remarks, numbers
    formula_trial = search.learn()
    numbers["loss_by_formula"] = formula_trial.loss
    if not best.effects:
        gain, low, _ = paired(nominal.held_out_loss, formula_trial.held_out_loss, search.data.starts)
        if low > 0 and gain > SMALLEST_GAIN * nominal.loss:
            return *_unknown(formula_trial, nominal, "no effect explains it"), numbers
        if nominal.loss < 1.7 * _CLEARLY:
            return "no_improvement", None, ("no effect predicts held-out data better",), numbers
        return *_unknown(formula_trial, nominal, "it is far larger than noise, and no effect explains it"), numbers
    why = ""
    # A formula has more freedom than an effect with a name: what fits well keeps its name although one fits better.
    better, low, _ = paired(best.held_out_loss, formula_trial.held_out_loss, search.data.starts)
    if low > 0 and better > 0.1 * excess and best.loss > _WELL and not _same(best, formula_trial, nominal):
        why = f"a formula predicts held-out data better than {' and '.join(best.names)}"
    elif best.loss > _CLEARLY:
        drift, thirds = search.drifting(best)
        numbers["share_by_drift"] = drift / excess
        # A formula that repeats the effect with one value for all of the drive tells against a change of it.
        if drift > (2.0 if _same(best, formula_trial, nominal) else 1.0) * LARGEST_DRIFT * excess:
            why = f"{_changing(thirds, len(search.known))} over the drive, as no single value can"
        elif share < SMALLEST_SHARE and not search.known and not _same(best, formula_trial, nominal):
            # What the gyro and the wheels show is so, however much else there is.
            why = f"no more than {100 * share:.0f} % of it is explained by {' and '.join(best.names)}"
    if why:
        # What the gyro and the wheels measured is known, whatever else is not.
        measured = best if search.known and best.effects[: len(search.known)] == search.known else None
        return *_unknown(formula_trial, nominal, why, measured), numbers
    return "effect_found", best, remarks, numbers


def _same(best: Trial, formula_trial: Trial, nominal: Trial) -> bool:
    """Whether a formula is an effect of the catalogue and some small rest.

    Its largest term is then the force by which that effect acts, and the effect explains most of what it does.
    """
    terms = dict(formula_trial.effects).get(LEARNED)
    if not terms:
        return False
    feature_sizes = dict(zip(FEATURES, FEATURE_SIZES, strict=True))
    largest = max(terms, key=lambda key: abs(terms[key]) * feature_sizes[key.split(":")[1]])
    if not any(largest in CATALOGUE[name].formula_terms for name in best.names):
        return False
    return nominal.loss - best.loss > SMALLEST_SHARE * (nominal.loss - formula_trial.loss)


def _unknown(
    trial: Trial, nominal: Trial, why: str, measured: Trial | None = None
) -> tuple[str, Trial | None, tuple[str, ...]]:
    """The verdict, with the formula, or else with what other sensors measured."""
    share = 1 - trial.loss / nominal.loss
    if share < SMALLEST_GAIN or (measured is not None and trial.loss > measured.loss):
        return "unknown_effect", measured, (why, "no formula of the motion explains it either")
    told = f"the formula {formula(dict(trial.effects)[LEARNED])} explains {100 * share:.0f} % [N, N m]"
    return "unknown_effect", trial, (why, told)


def _changing(thirds: list[Effects], known: int) -> str:
    name, first = thirds[0][known]
    key = next(iter(first))
    values = [dict(effects)[name][key] for effects in thirds]
    return f"{name} would have to change ({key}: {', '.join(f'{value:.3g}' for value in values)})"


class _Steps:
    """Progress of a search whose length is not known: each step takes a part of what is left."""

    def __init__(self, progress: Callable[[float, str], None], start: float, stop: float):
        self._progress, self._at, self._stop = progress, start, stop

    def __call__(self, what: str) -> None:
        self._at += 0.016 * (self._stop - self._at)
        self._progress(self._at, what)
