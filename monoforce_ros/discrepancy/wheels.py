"""Wheels: how the drives follow commands, by measured wheel speeds and so independent of the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.optimize import least_squares
from scipy.stats import t as student
from scipy.stats import wilcoxon

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.wheel_motion import side_speeds, undriven_stretches
from monoforce_ros.effects import CATALOGUE, Fastest, WheelResponse, wheel_effects
from monoforce_ros.robots import RobotModel

_STEP, _FINE_STEP = 0.04, 0.01
"""Of the modelled wheel speeds, in the selection and in the final fit [s]."""
_HISTORY = 4.0
"""Length of the commands before a block [s]: twice the longest dead time of the catalogue, for slow integral parts."""
_LONGEST_GAP = 1.0
_BLOCK = 4.0
"""Length of the blocks that are fitted or held out together [s]: longer than drives respond to a step."""
_MOST_BLOCKS = 60
"""Blocks that are used at most: whole ones, spread evenly over the recording."""
_MOST_SAMPLES = 80
"""Samples of a block that are used at most: about 13 Hz, which shows a time constant of 0.08 s."""
_FEWEST_SAMPLES = 10
_ALPHA = 0.05
"""Probability that a step of the selection adds an effect that the wheels do not show, over all candidates."""
_MOST_REACHED = 24
"""Signals that are kept of a fit [-]: a base point and what each value of the largest model changes."""
_LARGEST_MODEL = 5
"""Largest number of effects in a wheel model: dead time, three limits of the twist and a lag."""
_EVALUATIONS = 8
"""Of a fit: it starts from the values of a similar model."""
_GAIN = "drive_gain"
"""Stands for a fitted ratio among what effects exclude."""
_SAME_RATIO = 0.02
"""Relative difference of the measured speed ratio from the known radius' within which they are one: a worn tyre's."""
_FURTHER = 0.01
"""Share of the error that a further effect must remove for the search to go on."""


@dataclass(frozen=True)
class WheelFinding:
    """How the drives follow commands."""

    effects: Effects
    """In the order in which they act on a command; empty where the wheels follow the commands. The first parameter of
    each is the one that says how large it is."""
    half_widths: tuple[Mapping[str, float], ...]
    """Half-widths of the 95 % confidence intervals of each effect's parameters."""
    error_before: float
    """RMS of measured minus commanded wheel speed [m/s], at the best constant ratio of the two."""
    error_after: float
    ratio: float
    """Measured speed [rad/s] over commanded [m/s]: one over the wheel's radius."""
    used_blocks: int = 0
    """Blocks of the recording that were used."""
    all_blocks: int = 0
    """Blocks of the recording in which the robot was driven by commands."""
    gain: float = 1.0
    """Speed of the wheels' rims over the commanded one, where that is not 1: the drives multiply every command, or the
    wheels have another radius than the robot's file says."""
    ruled_out: tuple[str, ...] = ()
    """Further effects whose confidence interval holds no value that would count."""

    def summary(self) -> str:
        """One sentence for reports."""
        parts = [_response(name).wording.format(*values.values()) for name, values in self.effects]
        if self.gain != 1.0:
            parts.append(f"at {self.gain:.2f} times their speed")
        text = "the measured wheel speeds follow the commands " + ", ".join(parts or ["without delay or limit"])
        if self.used_blocks < self.all_blocks:
            text += f" ({self.used_blocks} of {self.all_blocks} blocks of {_BLOCK:g} s, spread over the recording)"
        return text


def compare_with_wheels(commands: CommandTrack, wheels: WheelTrack | None, robot: RobotModel) -> WheelFinding | None:
    """How measured wheel speeds follow commands; None without wheel speeds, or where they do not follow at all.

    The recording is cut into blocks, every other of which is fitted and the others held out, and the reverse. A model
    with more effects is selected if it reduces the held-out error: its gains, one for each block, must be positive on
    average by Wilcoxon's signed-rank test at an error rate of 5 % over all effects that could be added (Bonferroni).
    """
    if wheels is None or len(wheels) < 100 or not len(commands):
        return None
    found = _Blocks.of(commands, wheels, robot, _STEP)
    if found is None or found.fastest.speed < 0.1:
        return None
    chosen = found.spread(_MOST_BLOCKS)
    blocks = found[chosen]
    ratio = blocks.ratio()
    if len(blocks) < 2 or ratio is None:
        return None
    selection, ratio, gain = _selected(blocks, ratio)
    best, blocks = selection.best, selection.blocks
    weak = _weak(best, blocks)
    if weak:
        # Too small to matter: fitted again without them.
        best = selection.scored(tuple(name for name in best.names if name not in weak), best)
    values, half_widths = best.values, np.zeros(0)
    if best.names:
        fine = _Blocks.of(commands, wheels, robot, _FINE_STEP)
        assert fine is not None
        fine = replace(fine, measured=fine.measured / ratio)[chosen]
        values = _fit(best.names, fine, [best.values])
        half_widths = _half_widths(values, best.names, fine)
    baseline = selection.scored((), None)
    count = float(blocks.known.sum()) * 2
    spreads = [float(np.var(part[blocks.pairs])) for part in (blocks.measured, blocks.at_samples(blocks.commanded()))]
    if best.loss / count > 0.5 * min(spreads):
        # The wheels do not follow the commands.
        return None
    return WheelFinding(
        tuple((name, dict(zip(_keys(name), own, strict=True))) for name, own in _by_effect(best.names, values)),
        tuple(dict(zip(_keys(name), own, strict=True)) for name, own in _by_effect(best.names, half_widths)),
        float(np.sqrt(baseline.loss / count)),
        float(np.sqrt(best.loss / count)),
        ratio,
        gain=gain,
        used_blocks=len(blocks),
        all_blocks=len(found),
        ruled_out=tuple(_ruled_out(best.names, values, blocks)),
    )


def _selected(blocks: _Blocks, measured: float) -> tuple[_Selection, float, float]:
    """The selection on wheel speeds as speeds of the wheels' rims, with the ratio of the two and the gain.

    The known radius is used if the measured ratio is plausible, so that a drive that is too slow appears as an error,
    unless the wheels follow another ratio better beyond chance: drives that multiply every command have no limit or
    delay that would explain it. Effects that are too similar to a gain are not combined with one.
    """
    radius = blocks.robot.wheel_radius
    free = _Selection(replace(blocks, measured=blocks.measured / measured))
    if radius is None or not 0.4 < measured * radius < 2.5:
        return free, measured, 1.0
    known, gain = _Selection(replace(blocks, measured=blocks.measured * radius)), measured * radius
    if abs(gain - 1.0) > _SAME_RATIO:
        other = free.best
        alike = any(_GAIN in _response(name).excludes for name in other.names)
        if not alike and _better(known.best, replace(other, losses=other.losses * gain**2), 1):
            return free, measured, gain
    return known, 1.0 / radius, 1.0


def changed_drives(wheels: WheelFinding, robot: RobotModel) -> tuple[Effects, tuple[str, ...]]:
    """Where the wheels differ from what the robot's file says of its drives.

    Returns:
        the effects whose value differs from the file's by more than its confidence interval, with the values of the
        wheels; and the names of those that did not change.
    """
    in_file, shown = dict(robot.effects), dict(wheels.effects)
    half_widths = {
        name: widths[_response(name).parameter] for name, widths in zip(shown, wheels.half_widths, strict=True)
    }
    largest = max(half_widths.values(), default=0.0)
    changed: list[tuple[str, Mapping[str, float]]] = []
    unchanged = []
    for effect in wheel_effects():
        response = _response(effect.name)
        neutral = next(p.neutral for p in effect.parameters if p.name == response.parameter)
        expected = float(in_file.get(effect.name, {}).get(response.parameter, neutral))
        value = float(shown[effect.name][response.parameter]) if effect.name in shown else neutral
        # Of an effect that the wheels do not show the half-width is unknown: the largest one stands for it.
        half_width = half_widths.get(effect.name, largest)
        if effect.name not in shown and expected == neutral and effect.name not in wheels.ruled_out:
            # The wheels neither show it nor rule it out.
            continue
        if value == expected or abs(value - expected) <= half_width:
            unchanged.append(effect.name)
        elif np.isfinite(value):
            changed.append((effect.name, dict(shown.get(effect.name, {response.parameter: value}))))
    return tuple(changed), tuple(unchanged)


@dataclass(frozen=True)
class _Blocks:
    """Commands and measured wheel speeds in blocks of one length."""

    twists: np.ndarray
    """Commanded forward speed [m/s], yaw rate [rad/s] and, of a robot that crabs, lateral speed [m/s], with those
    before the block, ``[n, 2, T]`` or ``[n, 3, T]``."""
    measured: np.ndarray
    """Measured speed of the left and right wheels, ``[n, 2, K]`` [rad/s], or [m/s] after division by the ratio."""
    place: np.ndarray
    """Time of each sample since the first command, in steps, ``[n, K]``."""
    known: np.ndarray
    """Samples that exist, ``[n, K]`` bool; others fill the array."""
    step: float
    """Time between commands [s]."""
    robot: RobotModel
    """Its kinematics make wheel speeds of twists."""
    reached: dict[tuple[tuple[str, tuple[float, ...]], ...], np.ndarray] = field(default_factory=dict, init=False)
    """What the commands become under the first effects of a model, by these and their values: a fit that changes one
    value computes the effects before it once."""

    @classmethod
    def of(cls, commands: CommandTrack, wheels: WheelTrack, robot: RobotModel, step: float) -> _Blocks | None:
        """All blocks of about ``_BLOCK`` in which the robot is driven by commands, at time steps of ``step`` [s]."""
        stamps = wheels.stamps
        undriven = undriven_stretches(commands, wheels, None, robot)
        breaks = np.flatnonzero(np.diff(stamps) > _LONGEST_GAP * 1e9) + 1
        length = round((_HISTORY + _BLOCK) / step) + 1
        twists, measured, place, known = [], [], [], []
        for run in np.split(np.arange(len(stamps)), breaks):
            number = (stamps[run] - stamps[run[0]]) // round(_BLOCK * 1e9)
            for part in np.split(run, np.flatnonzero(np.diff(number)) + 1):
                if len(part) < _FEWEST_SAMPLES or stamps[part[-1]] - stamps[part[0]] < 0.5 * _BLOCK * 1e9:
                    continue
                part = part[:: -(-len(part) // _MOST_SAMPLES)]
                first, last = int(stamps[part[0]]) - round(_HISTORY * 1e9), int(stamps[part[-1]])
                if ((undriven[:, 0] < last) & (undriven[:, 1] > first)).any():
                    continue
                grid = first + np.rint(np.arange(length) * step * 1e9).astype(np.int64)
                fill = (0, _MOST_SAMPLES - len(part))
                twists.append(commands.sample(grid).T)
                measured.append(np.pad(wheels.speeds[part].T, ((0, 0), fill)))
                place.append(np.pad((stamps[part] - first) * 1e-9 / step, fill))
                known.append(np.arange(_MOST_SAMPLES) < len(part))
        if not twists:
            return None
        bounds = np.array([[robot.maximum_speed], [robot.maximum_yaw_rate], [robot.maximum_lateral_speed]])
        bounds = bounds[: twists[0].shape[0]]
        limited = np.clip(np.array(twists), -bounds, bounds)
        return cls(limited, np.array(measured), np.array(place), np.array(known), step, robot)

    def __len__(self) -> int:
        return len(self.twists)

    def __getitem__(self, chosen: np.ndarray) -> _Blocks:
        parts = {name: getattr(self, name)[chosen] for name in ("twists", "measured", "place", "known")}
        return replace(self, **parts)

    def spread(self, most: int) -> np.ndarray:
        """Indices of at most ``most`` blocks, evenly spread over the recording; those without any motion go first."""
        if len(self) <= most:
            return np.arange(len(self))
        moving = np.flatnonzero((np.abs(self.commanded()).max(axis=(1, 2)) > 0) | (self.measured != 0).any(axis=(1, 2)))
        return moving[np.unique(np.linspace(0, len(moving) - 1, min(most, len(moving))).round().astype(int))]

    @property
    def fastest(self) -> Fastest:
        """Fastest commands: 99.5 % quantiles."""
        speeds = np.abs(self.commanded()).max(axis=1)
        return Fastest(float(np.quantile(speeds, 0.995)), float(np.quantile(np.abs(self.twists[:, 1]), 0.995)))

    @property
    def pairs(self) -> np.ndarray:
        """Mask of the known samples of both sides, ``[n, 2, K]``."""
        return np.broadcast_to(self.known[:, None], self.measured.shape)

    def commanded(self, twists: np.ndarray | None = None) -> np.ndarray:
        """Wheel speeds ``[n, 2, T]`` [m/s] of commanded or given twists."""
        given = self.twists if twists is None else twists
        return np.moveaxis(side_speeds(self.robot, np.moveaxis(given, 1, -1)), -1, 1)

    def at_samples(self, speeds: np.ndarray) -> np.ndarray:
        """Speeds ``[n, 2, T]`` at the samples, ``[n, 2, K]``."""
        index = np.minimum(self.place.astype(int), speeds.shape[2] - 2)[:, None]
        before, after = (np.take_along_axis(speeds, index + shift, axis=2) for shift in (0, 1))
        return before + (self.place[:, None] - index) * (after - before)

    def ratio(self) -> float | None:
        """Measured [rad/s] over commanded speed [m/s] where a command of medium size was constant for a while."""
        commanded, top = self.commanded(), self.fastest.speed
        # From 1.5 s before a sample until it.
        settled = round(1.5 / self.step)
        shift = {"size": settled + 1, "origin": settled // 2, "axis": 2}
        extent = self.at_samples(maximum_filter1d(commanded, **shift) - minimum_filter1d(commanded, **shift))
        recent = self.at_samples(commanded)
        steady = self.pairs & (extent < 0.02 * top) & (np.abs(recent) > 0.1 * top) & (np.abs(recent) < 0.6 * top)
        sides = [self.measured[:, side][steady[:, side]] / recent[:, side][steady[:, side]] for side in range(2)]
        if min(map(len, sides)) < 10:
            measured, recent = self.measured[self.pairs], recent[self.pairs]
            ratio = float(recent @ measured) / max(float(recent @ recent), 1e-9)
        else:
            # A dead side says nothing about the wheel's radius.
            left, right = (float(np.median(side)) for side in sides)
            ratio = 0.5 * (left + right) if min(left, right) > 0.5 * max(left, right) else max(left, right)
        return ratio if ratio > 0.1 else None


@dataclass(frozen=True)
class _Model:
    """Effects of the drives, fitted and judged on held-out blocks."""

    names: tuple[str, ...]
    values: np.ndarray
    """Of all parameters, mean over the folds, ``[P]``."""
    losses: np.ndarray
    """Sum of squared errors of each block with the values fitted without its fold, ``[n]`` [m²/s²]."""

    @property
    def loss(self) -> float:
        """Sum over the blocks."""
        return float(self.losses.sum())


class _Selection:
    """Selection of the effects that measured wheel speeds show."""

    def __init__(self, blocks: _Blocks):
        self.blocks = blocks
        self._fold = np.arange(len(blocks)) % 2
        self._parts = [blocks[self._fold == number] for number in (0, 1)]
        self._known: dict[tuple[str, ...], _Model] = {}
        self._order = [effect.name for effect in wheel_effects() if effect.applies_to(blocks.robot)]

    @cached_property
    def best(self) -> _Model:
        """The smallest model that no larger one improves.

        The best model of each size is found by a floating search (Pudil et al. 1994): one more effect, exchanges, and
        removals that improve the smaller size. One effect may stand in for several: a lag for two ramps.
        """
        found = [self.scored((), None)]
        while len(found) <= _LARGEST_MODEL:
            candidates = [self.scored(names, found[-1]) for names in self._larger(found[-1].names)]
            if not candidates:
                break
            further = self._exchanged(min(candidates, key=lambda model: model.loss))
            if further.loss > (1.0 - _FURTHER) * found[-1].loss:
                break
            found.append(further)
            for size in range(len(found) - 1, 1, -1):
                found[size - 1] = min([found[size - 1], *self._smaller(found[size])], key=lambda model: model.loss)
        best = found[0]
        for model in found[1:]:
            if _better(best, model, len(self._order) - len(best.names)):
                best = model
        return self._pruned(best)

    def scored(self, names: tuple[str, ...], start: _Model | None) -> _Model:
        """A model fitted to each fold and judged on the other, from the values of a similar one."""
        if names not in self._known:
            losses, values = np.zeros(len(self.blocks)), []
            starts = _starts(names, self.blocks.fastest, start)
            for held_out in (0, 1):
                fit = _fit(names, self._parts[1 - held_out], starts)
                values.append(fit)
                judged = _block_losses(fit, names, self._parts[held_out], self.blocks.fastest.speed)
                losses[self._fold == held_out] = judged
            self._known[names] = _Model(names, np.mean(values, axis=0), losses)
        return self._known[names]

    def _larger(self, names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        for name in self._order:
            excluded = any(other in _response(name).excludes or name in _response(other).excludes for other in names)
            if name not in names and not excluded:
                yield _in_order((*names, name))

    def _exchanged(self, best: _Model) -> _Model:
        """The best model with one effect replaced by another, or ``best``; a first effect may stand in for a later."""
        tried = [best]
        for name in best.names:
            rest = tuple(other for other in best.names if other != name)
            tried += [self.scored(names, best) for names in self._larger(rest) if name not in names]
        return min(tried, key=lambda model: model.loss)

    def _smaller(self, model: _Model) -> list[_Model]:
        return [self.scored(tuple(other for other in model.names if other != name), model) for name in model.names]

    def _pruned(self, best: _Model) -> _Model:
        """The model without effects that do not improve it."""
        for fewer in sorted(self._smaller(best), key=lambda model: model.loss):
            if not _better(fewer, best, 1):
                return self._pruned(fewer)
        return best


def _better(smaller: _Model, larger: _Model, candidates: int) -> bool:
    """Whether the larger model's held-out error is smaller beyond chance, given how many models it is the best of."""
    gains = smaller.losses - larger.losses
    if larger.loss >= smaller.loss or not gains.any():
        return False
    # By ranks: blocks without a step of the commands show little of either sign, and count little.
    return bool(wilcoxon(gains, alternative="greater").pvalue * candidates < _ALPHA)


def _weak(model: _Model, blocks: _Blocks) -> list[str]:
    """Effects of a model whose values are too small to count."""
    return [
        name
        for name, (value, *_) in _by_effect(model.names, model.values)
        if not _response(name).counts(value, blocks.fastest)
    ]


def _ruled_out(names: tuple[str, ...], values: np.ndarray, blocks: _Blocks) -> Iterator[str]:
    """Effects that a model does not hold, and that would count only at values which the wheels contradict.

    That a selection leaves an effect out does not show that it is absent: noise may hide it, or another effect stand in
    for it. Each is therefore fitted beside the others, and its confidence interval looked at.
    """
    for effect in wheel_effects():
        if effect.name in names or not effect.applies_to(blocks.robot):
            continue
        together = _in_order((*names, effect.name))
        known = _Model(names, values, np.zeros(0))
        fitted = _fit(together, blocks, _starts(together, blocks.fastest, known))
        value, *_ = dict(_by_effect(together, fitted))[effect.name]
        half_width, *_ = dict(_by_effect(together, _half_widths(fitted, together, blocks)))[effect.name]
        ends = (value - half_width, value + half_width)
        if np.isfinite(ends).all() and not any(_response(effect.name).counts(end, blocks.fastest) for end in ends):
            yield effect.name


def _keys(name: str) -> tuple[str, ...]:
    """Parameters of an effect that a fit changes, the one that says how large it is first."""
    response = _response(name)
    return (response.parameter, *response.further)


def _by_effect(names: Sequence[str], values: np.ndarray) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Values ``[P]`` of the parameters of each effect."""
    at = 0
    for name in names:
        count = len(_keys(name))
        yield name, tuple(float(value) for value in values[at : at + count])
        at += count


def _bounds(names: Sequence[str], fastest: Fastest) -> np.ndarray:
    """Bounds of a fit ``[P, 2]``: values that the catalogue allows, for they become initial values of other fits."""
    bounds = []
    for name in names:
        response, known = _response(name), {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
        main = known[response.parameter]
        low, high = (float(np.clip(end, main.low, main.high)) for end in response.bounds(fastest))
        bounds.append((low, max(high, low + 1e-3)))
        bounds += [(known[key].low, known[key].high) for key in response.further]
    return np.array(bounds).reshape(-1, 2)


def _in_order(names: Sequence[str]) -> tuple[str, ...]:
    """Names of effects in the order in which they act on a command."""
    return tuple(effect.name for effect in wheel_effects() if effect.name in names)


def _response(name: str) -> WheelResponse:
    response = CATALOGUE[name].wheel_response
    assert response is not None, name
    return response


def _modelled(values: np.ndarray, names: tuple[str, ...], blocks: _Blocks) -> np.ndarray:
    """Speeds ``[n, 2, T]`` [m/s] of wheels that follow the commands under effects: those on the twist act first."""
    ordered = sorted(_by_effect(names, values), key=lambda entry: not _response(entry[0]).of_twist)
    signal, sides = blocks.twists, False
    for count, (name, own) in enumerate(ordered):
        response, first = _response(name), tuple(ordered[: count + 1])
        known = blocks.reached.get(first)
        if known is None:
            if response.of_twist:
                changed = response.speeds(signal[:, :2], *own, blocks.step)
                known = np.concatenate([changed, signal[:, 2:]], axis=1) if signal.shape[1] > 2 else changed
            else:
                known = response.speeds(signal if sides else blocks.commanded(signal), *own, blocks.step)
            if len(blocks.reached) >= _MOST_REACHED:
                blocks.reached.clear()
            blocks.reached[first] = known
        signal, sides = known, not response.of_twist
    return signal if sides else blocks.commanded(signal)


def _residuals(values: np.ndarray, names: tuple[str, ...], blocks: _Blocks) -> np.ndarray:
    """Measured minus modelled speed ``[n, 2, K]`` [m/s]; zero where there is no sample."""
    return (blocks.measured - blocks.at_samples(_modelled(values, names, blocks))) * blocks.pairs


def _block_losses(values: np.ndarray, names: tuple[str, ...], blocks: _Blocks, top: float) -> np.ndarray:
    """Sum of squared errors of each block ``[n]``, each clipped so that a few outliers do not decide."""
    return np.minimum(_residuals(values, names, blocks) ** 2, (0.5 * top) ** 2).sum(axis=(1, 2))


def _starts(names: tuple[str, ...], fastest: Fastest, similar: _Model | None) -> list[np.ndarray]:
    """Initial values: those of a similar model, with each initial value of what it does not hold."""
    known = {} if similar is None else dict(_by_effect(similar.names, similar.values))
    listed = []
    for name in names:
        neutral = {parameter.name: parameter.neutral for parameter in CATALOGUE[name].parameters}
        further = tuple(float(neutral[key]) for key in _response(name).further)
        listed.append([known[name]] if name in known else [(v, *further) for v in _response(name).starts(fastest)])
    count = max(map(len, listed), default=0)
    return [np.concatenate([values[i % len(values)] for values in listed]) for i in range(count)]


def _fit(names: tuple[str, ...], blocks: _Blocks, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Parameters by robust least squares from the best of a few starts."""
    if not names:
        return np.zeros(0)
    fastest = blocks.fastest
    bounds = _bounds(names, fastest)
    inside = [np.clip(start, bounds[:, 0] + 1e-6, bounds[:, 1] - 1e-6) for start in starts]
    start = min(inside, key=lambda values: _block_losses(values, names, blocks, fastest.speed).sum())
    return least_squares(
        lambda values: _residuals(values, names, blocks).ravel(), start, loss="soft_l1", f_scale=0.05 * fastest.speed,
        diff_step=1e-2, max_nfev=_EVALUATIONS, bounds=(bounds[:, 0], bounds[:, 1]), x_scale=np.ptp(bounds, axis=1),
    ).x  # fmt: skip


def _half_widths(values: np.ndarray, names: tuple[str, ...], blocks: _Blocks) -> np.ndarray:
    """Half-widths of 95 % intervals from the scores of each block (sandwich estimate, White 1980), ``[P]``."""
    base, bounds = _residuals(values, names, blocks), _bounds(names, blocks.fastest)
    derivatives = []
    for i, value in enumerate(values):
        step = max(0.01 * abs(value), 1e-3)
        # A dead time of less than none is not defined.
        ends = np.clip((value - step, value + step), *bounds[i])
        shifted = [_residuals(values + (end - value) * np.eye(len(values))[i], names, blocks) for end in ends]
        derivatives.append((shifted[1] - shifted[0]) / (ends[1] - ends[0]))
    jacobian = np.array(derivatives)
    top = blocks.fastest.speed
    weight = 1.0 / np.sqrt(1.0 + (base / (0.05 * top)) ** 2)
    scores = np.einsum("pnsk,nsk->np", jacobian, weight * base)
    information = np.einsum("pnsk,nsk,qnsk->pq", jacobian, weight, jacobian)
    inverse = np.linalg.pinv(information)
    freedom = max(1, len(blocks) - len(values))
    covariance = len(blocks) / freedom * inverse @ (scores.T @ scores) @ inverse
    return student.ppf(0.975, freedom) * np.sqrt(np.maximum(np.diag(covariance), 0.0))
