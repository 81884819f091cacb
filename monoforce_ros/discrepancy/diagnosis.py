"""Diagnosis: is anything missing in the model of a robot, what is it, and how much of the gap does it close?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import wilcoxon

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.discrepancy.fit import Fit, first_values, fit_effects, flat, robust, with_values
from monoforce_ros.discrepancy.gap import find_regimes, localise, noise_floor, residual_scale
from monoforce_ros.discrepancy.hypothesis import DriveData, Effects, Predictions, undo_measurement, window_starts
from monoforce_ros.motion import CommandTrack
from monoforce_ros.physics.effects import CATALOGUE
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

VERDICTS = ("effect_found", "no_discrepancy", "unknown_effect", "not_identifiable", "no_improvement")
CANDIDATES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("pose_clock_offset", ("offset",)),
    ("sensor_yaw_offset", ("angle",)),
    ("sensor_lever_arm", ("x", "y")),
    ("command_delay", ("delay",)),
    ("actuator_lag", ("time_constant",)),
    ("actuator_saturation", ("limit",)),
    ("actuator_deadband", ("width",)),
    ("drive_gain", ("gain",)),
    ("drive_asymmetry", ("difference",)),
    ("turning_scrub", ("track_width_factor",)),
    ("friction_scale", ("factor",)),
    ("rolling_resistance", ("coefficient",)),
    ("viscous_drag", ("coefficient",)),
    ("quadratic_drag", ("coefficient",)),
    ("constant_force", ("x", "y")),
    ("gravity_tilt", ("about_y", "about_x")),
    ("payload", ("mass", "x", "y")),
)
"""Effects that are tried, and the parameters that a drive can tell."""
EQUIVALENT: tuple[frozenset[str], ...] = (
    # The motion and the commands of a drive cannot tell which of their clocks is off, or whether the base waits.
    frozenset({"command_delay", "pose_clock_offset", "command_clock_offset"}),
)
"""Effects that a drive without further sensors cannot tell apart."""
SMALLEST_GAIN = 0.05
_FOLDS = 2
_BLOCK = 8.0
"""Length of the blocks that are left out together [s]: longer than a window, so that folds share no motion."""
_ALPHA = 0.01


@dataclass(frozen=True)
class Settings:
    """How a drive is diagnosed."""

    horizon: float = 2.0
    stride: float = 0.5
    samples: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    most_effects: int = 2
    seed: int = 0


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    verdict: str
    effects: tuple[dict, ...]
    """``name``, ``parameters`` {name: {value, low, high, unit}}, ``rivals``."""
    localisation: tuple[dict, ...]
    gap: dict[str, dict]
    """By metric: ``horizon_s``, ``before``, ``after``, ``low``, ``high`` (of the gain), ``unit``."""
    floor: dict[str, dict]
    advice: tuple[str, ...]
    candidates: tuple[dict, ...] = ()
    """Every effect that was tried with its gain on data that its fit did not see."""
    fitted: Effects = ()
    details: dict = field(default_factory=dict)
    """Arrays for pictures."""


def diagnose(
    smoothed: SmoothedMotion,
    commands: CommandTrack,
    robot: RobotModel,
    *,
    terrain: TerrainMap | None = None,
    odometry_from_terrain: np.ndarray | None = None,
    leftover: np.ndarray | None = None,
    settings: Settings = Settings(),
    progress: Callable[[float, str], None] = lambda share, what: None,
) -> Diagnosis:
    """Find which physical effect a robot's model lacks on a drive.

    Args:
        smoothed: measured motion with its noise.
        commands: recorded.
        robot: the nominal model; its file's effects act already.
        terrain: a map, or None for level ground.
        odometry_from_terrain: pose ``[4, 4]`` of the map.
        leftover: what disagreed on the healthy robot, root mean square ``[K, 3]`` at ``settings.samples``.
        settings: of the diagnosis.
        progress: called with the share of the work done and what comes next.
    """
    progress(0.0, "preflight")
    # What the robot's file says of its sensors and clocks is known already.
    motion, commands = undo_measurement(smoothed.motion, commands, robot.effects)
    smoothed = replace(smoothed, motion=motion)
    starts = window_starts(motion, smoothed.stretches, settings.horizon, settings.stride)
    complaint = _preflight(smoothed, commands, starts)
    if complaint:
        return Diagnosis("not_identifiable", (), (), {}, {}, tuple(complaint))
    samples = np.array(settings.samples)
    data = DriveData(motion, commands, starts, settings.horizon, samples, terrain, odometry_from_terrain)
    predictions = Predictions(robot, data)
    progress(0.03, "noise floor")
    floor = noise_floor(smoothed, data, settings.seed)
    scale = residual_scale(floor, leftover)
    before = predictions.residuals([()])[0]
    folds = _folds(starts)
    localisation = localise(before, np.hypot(floor, 0 if leftover is None else leftover), data, find_regimes(data))

    nominal = robust(np.nan_to_num(before / scale, nan=1e3))
    chosen: Effects = ()
    current = nominal
    whole: Fit | None = None
    rounds: list[list[dict]] = []
    rivals: dict[str, list[str]] = {}
    verdict = "no_discrepancy"
    random = np.random.default_rng(settings.seed)
    own = dict(robot.effects)
    for step in range(settings.most_effects):
        tried = []
        # An offset that the file holds was undone above; a second one of its kind would add to it.
        taken = {*dict(chosen), *(name for name in own if CATALOGUE[name].stage == "measurement")}
        candidates = [(name, keys) for name, keys in CANDIDATES if name not in taken]
        for number, (name, keys) in enumerate(candidates):
            share = (step + number / len(candidates)) / settings.most_effects
            progress(0.05 + 0.8 * share, name)
            unseen = np.full(len(starts), np.inf)
            fits = []
            for left in range(_FOLDS):
                seen = folds != left
                first = [chosen + start for start in _starts(name, keys, own)]
                fit = fit_effects(predictions, first, scale, seen, iterations=5)
                fits.append(fit)
                unseen[~seen] = fit.loss[~seen]
            gain, low, chance = _paired(current, unseen, starts, random)
            tried.append({"name": name, "gain": gain, "low": low, "p": chance, "loss": unseen, "fits": fits})
        tried.sort(key=lambda entry: -entry["gain"])
        rounds.append(tried)
        best = tried[0]
        significant = best["p"] < _ALPHA / len(CANDIDATES) and best["low"] > 0
        enough = best["gain"] > SMALLEST_GAIN * current.mean()
        if not significant:
            break
        if not enough:
            verdict = "no_improvement" if not chosen else verdict
            break
        verdict = "effect_found"
        best = _preferred(tried, current, starts, random)
        rivals[best["name"]] = _rivals(best, tried, starts, random)
        merged = max(best["fits"], key=lambda fit: -fit.loss.mean())
        chosen = merged.effects
        whole = fit_effects(predictions, [chosen], scale, np.ones(len(starts), bool), iterations=6)
        chosen, current = whole.effects, best["loss"]
    progress(0.88, "comparing before and after")
    effects: tuple[dict, ...] = ()
    details: dict = {"starts": starts, "before": before, "scale": scale, "floor": floor}
    gap: dict[str, dict] = {}
    if whole is not None:
        effects = tuple(_described(whole, rivals))
        after, gap = _gap(robot, data, predictions, whole, scale, folds, random)
        details["after"] = after
        reached = [row for metric, row in gap.items() if metric.startswith("position") and row["low"] > 0]
        if not reached:
            verdict = "no_improvement"
            effects, chosen = (), ()
    else:
        _, gap = _gap(robot, data, predictions, None, scale, folds, random)
    progress(1.0, "done")
    listed = [
        {"name": entry["name"], "round": number + 1, "gain": float(entry["gain"]), "p": float(entry["p"])}
        for number, tried in enumerate(rounds)
        for entry in tried
    ]
    names = ("along", "across", "heading")
    shown = {
        name: {"horizon_s": float(samples[-1]), "value": float(floor[-1, axis]), "unit": "rad" if axis == 2 else "m"}
        for axis, name in enumerate(names)
    }
    return Diagnosis(
        verdict, effects, tuple(localisation), gap, shown, _advice(verdict, effects), tuple(listed), chosen, details
    )


COMMISSIONED: Effects = (
    ("friction_scale", {"factor": 1.0}),
    ("turning_scrub", {"track_width_factor": 1.05}),
    ("actuator_lag", {"time_constant": 0.03}),
)
"""What every new robot needs, and where its fit starts."""


def commission(
    drives: Sequence[tuple[SmoothedMotion, CommandTrack]],
    robot: RobotModel,
    *,
    settings: Settings = Settings(),
    progress: Callable[[float, str], None] = lambda share, what: None,
) -> tuple[list[dict], np.ndarray]:
    """Fit friction, effective track width and servo response to drives of a healthy robot on level ground.

    Args:
        drives: smoothed motion and commands of each.
        robot: the model as shipped.
        settings: of the windows.
        progress: called with the share of the work done and what comes next.

    Returns:
        the effects as in a report, and what still disagrees, root mean square ``[K, 3]`` at ``settings.samples``
        beyond the noise of the poses.

    Raises:
        ValueError: a drive cannot tell; the message says why.
    """
    samples = np.array(settings.samples)
    fits: list[Fit] = []
    squares = []
    for number, (smoothed, commands) in enumerate(drives):
        progress(number / len(drives), "commissioning")
        starts = window_starts(smoothed.motion, smoothed.stretches, settings.horizon, settings.stride)
        complaint = _preflight(smoothed, commands, starts)
        if complaint:
            raise ValueError("; ".join(complaint))
        data = DriveData(smoothed.motion, commands, starts, settings.horizon, samples)
        predictions = Predictions(robot, data)
        floor = noise_floor(smoothed, data, settings.seed)
        fit = fit_effects(
            predictions, [COMMISSIONED], residual_scale(floor, None), np.ones(len(starts), bool), iterations=12
        )
        fits.append(fit)
        left = np.nan_to_num(predictions.residuals([fit.effects])[0])
        # Robust: a window in which the robot was pushed says nothing of the model.
        spread = np.quantile(np.abs(left), 0.68, axis=0)
        squares.append(np.maximum(spread**2 - floor**2, 0.0))
    values = np.median([flat(fit.effects) for fit in fits], axis=0)
    merged = replace(fits[0], effects=with_values(fits[0].effects, values))
    progress(1.0, "done")
    return _described(merged, {}), np.sqrt(np.mean(squares, axis=0))


def _preflight(smoothed: SmoothedMotion, commands: CommandTrack, starts: np.ndarray) -> list[str]:
    """Why a drive cannot tell anything, each with what would help; empty where it can."""
    complaints = []
    if not len(commands):
        return ["there are no commands: record what the base controller is told"]
    if len(starts) < 12:
        complaints.append(f"{len(starts)} windows without a gap, at least 12 are needed: drive for 30 s or longer")
    speeds = smoothed.motion.linear_velocities[:, 0]
    if np.abs(speeds).max(initial=0.0) < 0.15 and np.abs(commands.twists).max(initial=0.0) < 0.1:
        complaints.append("the robot hardly moves: drive forward at changing speed and turn to both sides for 30 s")
    elif commands.twists[:, 0].std() < 0.03 and commands.twists[:, 1].std() < 0.05:
        complaints.append("the commands hardly change: step the speed, turn to both sides, stop and start again")
    return complaints


def _starts(name: str, keys: Sequence[str], own: dict) -> list[Effects]:
    starts = first_values(name, keys)
    if name in own:
        known = dict(own[name])
        starts = [((name, {**{k: float(v) for k, v in known.items()}, **dict(values)}),) for ((_, values),) in starts]
        starts.append(((name, {k: float(known.get(k, dict(starts[0])[name][k])) for k in dict(starts[0])[name]}),))
    return starts


def _folds(starts: np.ndarray) -> np.ndarray:
    """Which fold each window belongs to: alternating blocks."""
    return ((starts - starts[0]) // round(_BLOCK * 1e9)).astype(int) % _FOLDS


def _blocks(starts: np.ndarray) -> np.ndarray:
    return ((starts - starts[0]) // round(0.5 * _BLOCK * 1e9)).astype(int)


def _paired(
    before: np.ndarray, after: np.ndarray, starts: np.ndarray, random: np.random.Generator
) -> tuple[float, float, float]:
    """Mean gain, its lower bound of 95 %, and the chance of such gains of whole blocks by Wilcoxon's test."""
    blocks = _blocks(starts)
    numbers = np.unique(blocks)
    # A few windows that nothing explains shall not decide.
    difference = np.clip(before - after, -50.0, 50.0)
    sums = np.array([difference[blocks == block].sum() for block in numbers]) / len(starts)
    gain = float(sums.sum())
    picked = random.integers(0, len(sums), (2000, len(sums)))
    resampled = sums[picked].sum(axis=1)
    # By ranks: a few blocks that gain much and others that gain little are a gain in all of them.
    chance = float(wilcoxon(sums, alternative="greater").pvalue) if np.abs(sums).max() > 1e-12 else 1.0
    return gain, float(np.quantile(resampled, 0.05)), chance


def _preferred(tried: list[dict], current: np.ndarray, starts: np.ndarray, random: np.random.Generator) -> dict:
    """The best effect, or one as good that asks for fewer parameters."""
    best = tried[0]
    parameters = {name: len(keys) for name, keys in CANDIDATES}
    for entry in tried[1:6]:
        margin, low, _ = _paired(entry["loss"], best["loss"], starts, random)
        simpler = parameters[entry["name"]] < parameters[best["name"]]
        if simpler and (low <= 0 or margin < 0.02 * current.mean()):
            best = entry
    return best


def _rivals(best: dict, tried: list[dict], starts: np.ndarray, random: np.random.Generator) -> list[str]:
    """Effects that explain the drive about as well."""
    rivals = []
    for entry in tried:
        if entry["name"] == best["name"]:
            continue
        _, low, _ = _paired(entry["loss"], best["loss"], starts, random)
        if low <= 0 or any({entry["name"], best["name"]} <= group for group in EQUIVALENT):
            rivals.append(entry["name"])
    return rivals


def _described(fit: Fit, rivals: dict[str, list[str]]) -> list[dict]:
    deviations = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    result, at = [], 0
    for name, parameters in fit.effects:
        known = {p.name: p for p in CATALOGUE[name].parameters}
        listed = {}
        for key, value in parameters.items():
            half = 1.96 * float(deviations[at])
            listed[key] = {
                "value": float(value),
                "low": float(max(value - half, known[key].low)),
                "high": float(min(value + half, known[key].high)),
                "unit": known[key].unit,
            }
            at += 1
        result.append({"name": name, "parameters": listed, "rivals": rivals.get(name, [])})
    return result


def _gap(
    robot: RobotModel,
    data: DriveData,
    predictions: Predictions,
    fit: Fit | None,
    scale: np.ndarray,
    folds: np.ndarray,
    random: np.random.Generator,
) -> tuple[np.ndarray, dict[str, dict]]:
    """Errors before and after at 1, 2 and 5 s, each window by a fit that did not see it; gains with their intervals."""
    by_fold = []
    if fit is not None:
        by_fold = [
            fit_effects(predictions, [fit.effects], scale, folds != left, iterations=3).effects
            for left in range(_FOLDS)
        ]
    gap: dict[str, dict] = {}
    shown = np.zeros((0,))
    for horizon in (1.0, 2.0, 5.0):
        starts = data.starts[data.starts + round((horizon + 1.3) * 1e9) <= data.motion.stamps[-1]]
        if len(starts) < 8:
            continue
        longer = replace(data, starts=starts, horizon=horizon, samples=np.array([horizon]))
        rolled = Predictions(robot, longer)
        before = rolled.residuals([()])[0][:, 0]
        after = before.copy()
        which = ((starts - data.starts[0]) // round(_BLOCK * 1e9)).astype(int) % _FOLDS
        for left, effects in enumerate(by_fold):
            after[which == left] = rolled.residuals([effects])[0][which == left, 0]
        if horizon == 2.0:
            shown = after
        for metric, unit, errors in (
            ("position", "m", [np.hypot(e[:, 0], e[:, 1]) for e in (before, after)]),
            ("heading", "deg", [np.degrees(np.abs(e[:, 2])) for e in (before, after)]),
        ):
            blocks = _blocks(starts)
            numbers = np.unique(blocks)
            picks = random.integers(0, len(numbers), (1000, len(numbers)))
            differences = [errors[0][blocks == b] - errors[1][blocks == b] for b in numbers]
            means = np.array([[d.sum(), len(d)] for d in differences])
            resampled = means[picks, 0].sum(axis=1) / means[picks, 1].sum(axis=1)
            gap[f"{metric}_{horizon:g}s"] = {
                "horizon_s": horizon,
                "before": float(np.median(errors[0])),
                "after": float(np.median(errors[1])),
                "low": float(np.quantile(resampled, 0.025)),
                "high": float(np.quantile(resampled, 0.975)),
                "unit": unit,
            }
    return shown, gap


def _advice(verdict: str, effects: Sequence[dict]) -> tuple[str, ...]:
    helpful = {
        frozenset({"command_delay", "actuator_lag"}): "steps of the speed from standing",
        frozenset({"drive_gain", "actuator_saturation"}): "slow and fast stretches straight ahead",
        frozenset({"friction_scale", "turning_scrub"}): "turns on the spot and hard starts",
        frozenset({"drive_gain", "pose_clock_offset"}): "stops and starts",
        frozenset({"drive_asymmetry", "constant_force"}): "the same stretch forward and in reverse",
        frozenset({"payload", "turning_scrub"}): "turns on the spot, and driving across a slope",
    }
    told = []
    for effect in effects:
        if any(effect["name"] in group for group in EQUIVALENT) and effect["name"] != "actuator_lag":
            told.append("an IMU's gyro tells whether the poses are late or the base waits: record it")
        for pair, what in helpful.items():
            for rival in effect["rivals"]:
                if {effect["name"], rival} == pair:
                    told.append(f"{what} would tell {effect['name']} from {rival}")
    if verdict == "no_discrepancy":
        told.append("nothing is missing that this drive could show")
    return tuple(dict.fromkeys(told))
