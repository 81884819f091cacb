"""Commissioning: the nominal model of a robot, fitted to recordings of the healthy robot."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from monoforce_ros.discrepancy.areas import shows_vegetation
from monoforce_ros.discrepancy.attitude import lean_of
from monoforce_ros.discrepancy.command_changes import covered_changes
from monoforce_ros.discrepancy.directions import Directions
from monoforce_ros.discrepancy.estimates import EffectEstimate, beyond_file
from monoforce_ros.discrepancy.evidence import MOTION, Evidence, EvidenceWindows
from monoforce_ros.discrepancy.fit import (
    Fit,
    estimate_effects,
    first_values,
    fit_effects,
    flat,
    jacobian,
    robust,
    robust_weights,
    with_values,
    without,
)
from monoforce_ros.discrepancy.gap import noise_floor, noisy_motions, residual_scale
from monoforce_ros.discrepancy.ground import slopes_of
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels, drives_of
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions, corrected_evidence
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.motion_check import motion_faults
from monoforce_ros.discrepancy.motor_efforts import HealthyEfforts
from monoforce_ros.discrepancy.nominal import SEGMENT, NominalModel
from monoforce_ros.discrepancy.preflight import complaints
from monoforce_ros.discrepancy.residual_model import fit_terms, motion_terms
from monoforce_ros.discrepancy.score_test import variation
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.terrain_evidence import terrain_uncertainty
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import blocks_of
from monoforce_ros.discrepancy.wheels import WheelFinding, best_of, changed_drives, compare_with_wheels
from monoforce_ros.effects import CATALOGUE, identifiable_effects
from monoforce_ros.robots import RobotModel


def _commissioned(over: str) -> Effects:
    return tuple(
        (effect.name, dict(effect.commissioning_start))
        for effect in CATALOGUE.values()
        if effect.commissioning_start and effect.commissioned_over == over
    )


COMMISSIONED = _commissioned("")
"""Effects that every robot needs, with the values at which their fit starts."""
COMMISSIONED_IN_VEGETATION = _commissioned("vegetation")
"""Effects that every robot needs in addition where a recording leads through vegetation."""
_FEW_ITERATIONS = 4
"""Of a fit that begins at that of all effects but one: from there it has not far to go."""


def _often(*, of_base: bool) -> dict[str, Mapping[str, float]]:
    listed = (effect for effect in CATALOGUE.values() if effect.often_commissioned and effect.of_base == of_base)
    return {effect.name: effect.often_commissioned for effect in listed}


_OFTEN_OF_BASE = _often(of_base=True)
"""What many base controllers do, with the values at which a second fit starts."""
_OFTEN_OF_MOTORS = _often(of_base=False)
"""What many motors do, with the values at which a third fit starts."""
_VEGETATION = frozenset(name for name, _ in COMMISSIONED_IN_VEGETATION)
_FEWEST_SEGMENTS = 3
"""As many as parts: of two the variance between segments would have one degree of freedom."""
_PARTS = 3
"""Parts of a single recording that take turns in being predicted by the others."""
_MOST_EFFECTS = 4
"""Effects of the catalogue that commissioning adds to those that every robot needs."""


@dataclass(frozen=True)
class _Prepared:
    """A recording of the healthy robot, cut into windows."""

    data: EvidenceWindows
    predictions: Predictions
    floor: np.ndarray
    """Residuals by noise and map, ``[W, K, C]``."""
    left_out: LeftOut
    """Of the recording."""

    @property
    def blocks(self) -> int:
        """Number of independent blocks."""
        return len(np.unique(blocks_of(self.data.starts)))

    def __getitem__(self, chosen: np.ndarray) -> _Prepared:
        data = replace(self.data, starts=self.data.starts[chosen])
        return _Prepared(data, Predictions(self.predictions.robot, data), self.floor[chosen], self.left_out)


def commission(
    recordings: Sequence[Evidence],
    robot: RobotModel,
    *,
    samples: Sequence[float] = (0.5, 1.0, 1.5, 2.0),
    stride: float = 1.0,
    progress: Callable[[float, str], None] = lambda share, step: None,
) -> tuple[tuple[EffectEstimate, ...], NominalModel]:
    """Fit to recordings of a healthy robot all that it takes to predict them.

    What every robot has is always fitted (:data:`COMMISSIONED`, and :data:`COMMISSIONED_IN_VEGETATION` to recordings
    that lead through it), each value drawn towards neutral by a prior that weighs as much as one block; of the other
    effects those that are significant in more than half of the recordings.
    They are no faults: they become the nominal model, with which later recordings are compared.

    Args:
        recordings: recordings of the healthy robot.
        robot: the model as shipped.
        samples: times in a window at which residuals are computed [s].
        stride: time between windows [s].
        progress: called with the share of the work done and the next step.

    Returns:
        the effects, and what remains: the residual beyond the noise of the poses, and how it varies.

    Raises:
        ValueError: a recording is not sufficient; the message says why.
    """
    # What some recordings lack nothing can be learned of.
    components = min((evidence.components for evidence in recordings), key=len)
    # As later recordings are: what the file says of sensors and clocks is known.
    recordings = [replace(corrected_evidence(evidence, robot), components=components) for evidence in recordings]
    prepared = []
    for number, evidence in enumerate(recordings):
        progress(0.3 * number / len(recordings), "reading the noise")
        prepared.append(_prepare(evidence, robot, np.array(samples), stride))
    overgrown = [shows_vegetation(entry.data) for entry in prepared]
    chosen = (*COMMISSIONED, *COMMISSIONED_IN_VEGETATION) if any(overgrown) else COMMISSIONED
    measured = [compare_with_wheels(evidence.commands, evidence.wheels, robot) for evidence in recordings]
    drives = [wheels for wheels in measured if wheels is not None]
    fits = [_started(entry, chosen, wheels) for entry, wheels in zip(prepared, measured, strict=True)]
    found: list[tuple[str, Mapping[str, float]]] = []
    always = [name for name, _ in chosen]
    for number, (entry, fit) in enumerate(zip(prepared, fits, strict=True)):
        progress(0.3 + 0.4 * number / len(prepared), "searching for further effects")
        found += [(name, values) for name, values in fit.effects if name not in always]
        found += _further(robot, entry, fit.effects, measured[number])
    counted = [name for name, _ in found]
    further = {name: values for name, values in found if counted.count(name) > 0.5 * len(prepared)}
    # From what was found: from the starting values of all, no step may lead down. What only a part of the recordings
    # shows goes, so that all have the same.
    starts = [_with(fit, further, always) for fit in fits]
    fits = [
        fit if _layout(fit.effects) == _layout(start) else _fitted(entry, start)
        for entry, fit, start in zip(prepared, fits, starts, strict=True)
    ]
    # Whose covariance tells the intervals: one that saw everything.
    first = fits[overgrown.index(True)] if any(overgrown) else fits[0]
    merged = replace(first, effects=_merged([fit.effects for fit in fits], overgrown))
    progress(0.75, "held-out residuals")
    residuals = _held_out_residuals(prepared, fits, merged.effects, overgrown)
    progress(0.85, "variation between segments")
    nominal = _nominal(prepared, merged.effects, residuals)
    nominal = replace(
        nominal,
        slope=max(slopes_of(evidence.smoothed).total for evidence in recordings),
        changes=covered_changes([entry.data for entry in prepared]),
        lean=np.mean([lean_of(evidence.smoothed.motion).own for evidence in recordings], axis=0)
        if recordings[0].with_attitude
        else None,
        wheels=_healthy_wheels(recordings, drives, replace(robot, effects=_together(robot, merged.effects))),
        efforts=HealthyEfforts.learned(
            [
                (entry.commands, entry.efforts, part.left_out.stretches)
                for entry, part in zip(recordings, prepared, strict=True)
            ],
            robot,
        ),
    )
    progress(1.0, "done")
    return beyond_file(estimate_effects(merged, {}), robot), nominal


def _prepare(evidence: Evidence, robot: RobotModel, samples: np.ndarray, stride: float) -> _Prepared:
    smoothed = evidence.smoothed
    # What somebody drove with a joystick, or wheels that turned in place, is not how the robot follows its commands.
    left_out = LeftOut.of(evidence, robot)
    starts = left_out.starts(evidence, float(samples[-1]), stride)
    found = motion_faults(smoothed, evidence.commands, evidence.wheels, evidence.efforts) or complaints(
        evidence, starts
    )
    if found:
        raise ValueError("; ".join(found))
    data = evidence.cut(starts, samples)
    floor = np.hypot(
        noise_floor(smoothed.motion, noisy_motions(smoothed), data),
        terrain_uncertainty(robot, data, evidence.split_maps),
    )
    return _Prepared(data, Predictions(robot, data), floor, left_out)


def _fitted(entry: _Prepared, effects: Effects, iterations: int = 12) -> Fit:
    # Blocks are roughly independent, windows within a block are not: the prior weighs as much as one block.
    scale = residual_scale(entry.floor, entry.data, None)
    return fit_effects(entry.predictions, [effects], scale, iterations=iterations, prior=1.0 / entry.blocks)


def _started(entry: _Prepared, chosen: Effects, wheels: WheelFinding | None) -> Fit:
    """The fit of what every robot has, and of what else the drives do where that explains more.

    Ramps of a base look like a long dead time to a fit that begins without them, those of motors like slippery ground,
    and nothing leads away from there. The fit begins also at what the wheels show, with the ramps of many bases, and
    with motors that reach their largest torque, without such ramps and beside them. Wheels alone do not say enough:
    those of weak motors, which hardly turn on the spot, look limited in their yaw rate.
    """
    best = _fitted(entry, chosen)
    for found in (_OFTEN_OF_BASE,) if wheels is None else (dict(wheels.effects), _OFTEN_OF_BASE):
        best = _better(entry, best, _beginning(entry, chosen, found))
    own = {name: values for name, values in best.effects if name not in dict(chosen)}
    motors = {
        name: values for name, values in _OFTEN_OF_MOTORS.items() if CATALOGUE[name].applies_to(entry.predictions.robot)
    }
    for beside in ({}, own) if own else ({},):
        best = _better(entry, best, _beginning(entry, chosen, {**beside, **motors}))
    return best


def _beginning(entry: _Prepared, chosen: Effects, shown: Mapping[str, Mapping[str, float]]) -> Fit | None:
    """The fit that begins with further effects, without those that are not worth their parameters; None without any."""
    if not shown:
        return None
    beginning = tuple((name, {**values, **shown.get(name, {})}) for name, values in chosen)
    others = tuple((name, values) for name, values in shown.items() if name not in dict(chosen))
    fit = _fitted(entry, (*beginning, *others))
    for name, _ in others:
        # Such as a droop of 0 m/s, or a ramp that a lag does as well.
        fit = _better(entry, _fitted(entry, without(fit.effects, name), _FEW_ITERATIONS), fit)
    return fit


def _better(entry: _Prepared, fewer: Fit, more: Fit | None) -> Fit:
    """One of two fits: the second one where its effects beyond those of the first one are worth their parameters."""
    if more is None:
        return fewer
    fitted_more, fitted_fewer = (sum(len(CATALOGUE[name].identified) for name in fit.names) for fit in (more, fewer))
    gain = float(fewer.loss.mean()) - float(more.loss.mean())
    # A parameter is worth a log likelihood of half the logarithm of the number of independent blocks (Schwarz 1978).
    least = 0.5 * (fitted_more - fitted_fewer) * np.log(entry.blocks)
    return more if gain * entry.blocks > least else fewer


def _with(fit: Fit, further: Mapping[str, Mapping[str, float]], always: Collection[str]) -> Effects:
    """What every robot has, and further effects, each with the values of this fit where it has them."""
    own = dict(fit.effects)
    kept = tuple((name, values) for name, values in fit.effects if name in always)
    started = [(name, {k: own.get(name, {}).get(k, value) for k, value in v.items()}) for name, v in further.items()]
    return (*kept, *started)


def _layout(effects: Effects) -> list[tuple[str, tuple[str, ...]]]:
    """Names of effects and of their parameters, in their order."""
    return [(name, tuple(values)) for name, values in effects]


def _merged(fitted: Sequence[Effects], overgrown: Sequence[bool]) -> Effects:
    """Medians of what was fitted to each recording; of an effect of vegetation, to those that lead through it."""
    layouts = [_layout(effects) for effects in fitted]
    assert all(layout == layouts[0] for layout in layouts), layouts
    rows = np.array([flat(effects) for effects in fitted])
    of_vegetation = np.array([name in _VEGETATION for name, values in fitted[0] for _ in values])
    if any(overgrown):
        rows[np.ix_(~np.array(overgrown), of_vegetation)] = np.nan
    return with_values(fitted[0], np.nanmedian(rows, axis=0))


def _together(robot: RobotModel, effects: Effects) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """The effects of a robot's file with those that were fitted."""
    return tuple({**dict(robot.effects), **dict(effects)}.items())


def _healthy_wheels(
    recordings: Sequence[Evidence], drives: Sequence[WheelFinding], robot: RobotModel
) -> HealthyWheels | None:
    """How the drives follow commands, by the wheel speeds of all recordings; None where one does not show it.

    Args:
        recordings: of the healthy robot.
        drives: what the wheels of each recording show.
        robot: with the effects of the commissioned file.
    """
    if len(drives) < len(recordings):
        return None
    models = [finding.model for finding in drives if finding.model is not None]
    tracks = [(evidence.commands, evidence.wheels) for evidence in recordings if evidence.wheels is not None]
    model = models[0] if len(models) == 1 else best_of(models, tracks, robot)
    units = [evidence.wheel_unit for evidence in recordings]
    # Where units differ, each recording says its own.
    unit = units[0] if np.ptp(units) <= 0.1 * max(units) else 1.0
    return None if model is None else replace(model, unit=unit, in_file=drives_of(robot.effects))


def _further(robot: RobotModel, entry: _Prepared, effects: Effects, wheels: WheelFinding | None) -> Effects:
    """The effects that one recording needs in addition; wheels suggest what the drives do, and what they do not."""
    fitted = replace(robot, effects=_together(robot, effects))
    floor = entry.floor
    residuals = np.nan_to_num(Predictions(fitted, entry.data).residuals([()])[0])
    spread = np.quantile(np.abs(residuals), 0.683, axis=0)
    # Scaled by what is left, so that a recording is judged by its own size of errors.
    scale = np.sqrt(residual_scale(floor, entry.data, None) ** 2 + np.maximum(spread**2 - (floor**2).mean(axis=0), 0.0))
    hints, unchanged = ((), ()) if wheels is None else changed_drives(wheels, fitted)
    search = Search(fitted, entry.data, scale, hints=hints, excluded=[*unchanged, *(name for name, _ in effects)])
    best = search.run(_MOST_EFFECTS).best
    return search.refit(best.effects).effects if best.effects else ()


def _held_out_residuals(
    prepared: Sequence[_Prepared], fits: Sequence[Fit], effects: Effects, overgrown: Sequence[bool]
) -> list[np.ndarray]:
    """Residuals ``[W, K, C]`` of each recording, predicted with values that were fitted without it.

    With the values that were fitted to it a recording looks better than the robot's next one will. Of several
    recordings each is predicted by the others; a single one is cut into segments that take turns in being left out.
    """
    if len(prepared) > 1:
        predicted = []
        for number, entry in enumerate(prepared):
            rest = [other for other in range(len(fits)) if other != number]
            others = _merged([fits[other].effects for other in rest], [overgrown[other] for other in rest])
            if overgrown[number] and not any(overgrown[other] for other in rest):
                # Bare ground says nothing of vegetation.
                own = dict(effects)
                others = tuple((name, own[name] if name in _VEGETATION else values) for name, values in others)
            predicted.append(np.nan_to_num(entry.predictions.residuals([others])[0]))
        return predicted
    entry = prepared[0]
    data, starts = entry.data, entry.data.starts
    # Segments in a gap hold no windows.
    held_out = np.unique(_segments(entry), return_inverse=True)[1] % _PARTS
    # A window that reaches into the next segment shares motion with it.
    ends = held_out[np.searchsorted(starts, np.minimum(starts + round(data.horizon * 1e9), starts[-1]))]
    residuals = np.zeros((len(starts), len(data.samples), len(data.components)))
    for part in np.unique(held_out):
        fitted, judged = (held_out != part) & (ends != part), held_out == part
        fit = _fitted(entry[fitted], effects, iterations=6)
        residuals[judged] = entry[judged].predictions.residuals([fit.effects])[0]
    return [np.nan_to_num(residuals)]


def _segments(entry: _Prepared) -> np.ndarray:
    """Number of the segment in which each window starts, ``[W]``."""
    starts = entry.data.starts
    length = max(float(starts[-1] - starts[0]) * 1e-9 + entry.data.horizon, 1.0)
    count = max(_FEWEST_SEGMENTS, round(length / SEGMENT))
    numbers = ((starts - starts[0]) * count) // max(int(starts[-1] - starts[0]), 1)
    return np.minimum(numbers, count - 1).astype(int)


def _nominal(prepared: Sequence[_Prepared], effects: Effects, residuals: Sequence[np.ndarray]) -> NominalModel:
    """What remains of the healthy robot.

    Args:
        prepared: its recordings.
        effects: with the values of the robot file.
        residuals: of each recording, held out, ``[W, K, C]``.
    """
    squares = []
    for entry, residual in zip(prepared, residuals, strict=True):
        # Robust: single windows with a disturbance must not raise the nominal residual.
        spread = np.quantile(np.abs(residual), 0.683, axis=0)
        squares.append(np.maximum(spread**2 - np.mean(entry.floor**2, axis=0), 0.0))
    terms = fit_terms(
        residuals,
        [residual_scale(entry.floor, entry.data, None) for entry in prepared],
        [motion_terms(entry.data) for entry in prepared],
    )
    nominal = NominalModel(np.sqrt(np.mean(squares, axis=0)), terms=terms)
    changes: dict[str, list[float]] = {}
    losses: list[float] = []
    motion_losses: list[float] = []
    segments: list[int] = []
    for entry, residual in zip(prepared, residuals, strict=True):
        scale = residual_scale(entry.floor, entry.data, nominal)
        numbers = _segments(entry)
        scaled = residual / scale
        for kept, of in ((losses, scaled), (motion_losses, scaled[..., : len(MOTION)])):
            kept += [float(robust(of)[numbers == number].mean()) for number in np.unique(numbers)]
        segments.append(len(np.unique(numbers)))
        weights = robust_weights(scaled)
        metric = scale / nominal.scale_in(entry.data)
        # Nothing counts as fitted here: a later recording is tested with the values of the file, too.
        for name, columns in _directions(entry, effects, scale):
            within = variation(scaled, weights, numbers, columns, metric)
            if within is not None:
                changes.setdefault(name, []).append(within)
    return replace(
        nominal,
        variation={name: float(np.sqrt(np.mean(np.square(values)))) for name, values in changes.items()},
        segments=sum(segments),
        # The mean of losses, not of their logarithms: that is what a later drive's mean loss is compared with.
        loss=float(np.mean(losses)),
        motion_loss=float(np.mean(motion_losses)) if nominal.with_attitude else None,
        loss_spread=float(np.std(np.log(losses), ddof=1)),
    )


def _directions(entry: _Prepared, effects: Effects, scale: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Influence of every effect and of every term of a formula."""
    predictions = entry.predictions
    base = predictions.residuals([effects])[0] / scale
    rows = np.nan_to_num(jacobian(predictions, effects, base, scale, 0)).reshape(-1, *base.shape)
    owners = [name for name, values in effects for _ in values]
    for name in dict.fromkeys(owners):
        own = np.array([owner == name for owner in owners])
        yield name, rows[own]
    directions = Directions(predictions, scale, None, Thresholds())
    present = {name for name, _ in effects}
    for effect in identifiable_effects(predictions.robot):
        if effect.name in present:
            continue
        starts = first_values(effect, predictions.robot)
        # The influence of an effect is not linear: the larger variation of two values counts.
        for start in (starts[len(starts) // 2 - 1], starts[len(starts) // 2]):
            direction = directions.influence(effects, start[0])
            yield effect.name, direction.columns
    for direction in directions.of_formula(effects):
        yield direction.name, direction.columns
