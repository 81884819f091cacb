"""Wheels: how the drives follow commands, by measured wheel speeds and so independent of the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student
from scipy.stats import wilcoxon

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.residual_size import relative_error
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.wheel_blocks import BLOCK, WheelBlocks
from monoforce_ros.effects import CATALOGUE, Fastest, WheelResponse, wheel_effects
from monoforce_ros.robots import RobotModel

_STEP, _FINE_STEP = 0.04, 0.01
"""Of the modelled wheel speeds, in the selection and in the final fit [s]."""
_MOST_BLOCKS = 60
"""Blocks that are used at most: whole ones, spread evenly over the recording."""
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
    unchanged: bool = False
    """Whether these are the effects of commissioning, which predict the wheels still."""
    model: HealthyWheels | None = None
    """The same as what is known of the drives of a healthy robot, if this is one."""

    def summary(self) -> str:
        """One sentence for reports."""
        parts = [_response(name).wording.format(*values.values()) for name, values in self.effects]
        if self.gain != 1.0:
            parts.append(f"at {self.gain:.2f} times their speed")
        text = "the measured wheel speeds follow the commands "
        text += "as when the robot was commissioned, " if self.unchanged else ""
        text += ", ".join(parts or ["without delay or limit"])
        if self.used_blocks < self.all_blocks:
            text += f" ({self.used_blocks} of {self.all_blocks} blocks of {BLOCK:g} s, spread over the recording)"
        return text


def compare_with_wheels(
    commands: CommandTrack,
    wheels: WheelTrack | None,
    robot: RobotModel,
    healthy: HealthyWheels | None = None,
    spread: float = Thresholds().drive_spread,
) -> WheelFinding | None:
    """How measured wheel speeds follow commands; None without wheel speeds, or where they do not follow at all.

    Of a commissioned robot it is asked first whether what was learned of its wheels still predicts them. Otherwise a
    model is selected: the recording is cut into blocks, every other of which is fitted and the others held out, and the
    reverse. A model with more effects is selected if it reduces the held-out error: its gains, one for each block, must
    be positive on average by Wilcoxon's signed-rank test at an error rate of 5 % over all effects that could be added
    (Bonferroni).

    Args:
        commands: of the recording.
        wheels: measured wheel speeds.
        robot: its kinematics make wheel speeds of commands.
        healthy: what commissioning learned of the wheels; None where it is unknown.
        spread: standard deviation of the logarithm of a mean loss between healthy drives.
    """
    if wheels is None or len(wheels) < 100 or not len(commands):
        return None
    found = WheelBlocks.of(commands, wheels, robot, _STEP)
    if found is None or found.fastest.speed < 0.1:
        return None
    chosen = found.spread(_MOST_BLOCKS)
    blocks = found[chosen]
    ratio = blocks.ratio()
    if len(blocks) < 2 or ratio is None:
        return None
    if healthy is not None:
        still = _still_healthy(blocks, ratio, healthy, spread)
        if still is not None:
            return replace(still, used_blocks=len(blocks), all_blocks=len(found))
    selection, ratio, gain = _selected(blocks, ratio, healthy)
    best, blocks = selection.best, selection.blocks
    weak = _weak(best, blocks)
    if weak:
        # Too small to matter: fitted again without them.
        best = selection.scored(tuple(name for name in best.names if name not in weak), best)
    values, half_widths = best.values, np.zeros(0)
    if best.names:
        fine = WheelBlocks.of(commands, wheels, robot, _FINE_STEP)
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
    effects = _named(best.names, values)
    return WheelFinding(
        effects,
        tuple(widths for _, widths in _named(best.names, half_widths)),
        float(np.sqrt(baseline.loss / count)),
        float(np.sqrt(best.loss / count)),
        ratio,
        gain=gain,
        used_blocks=len(blocks),
        all_blocks=len(found),
        ruled_out=tuple(_ruled_out(best.names, values, blocks)),
        model=HealthyWheels.learned(effects, ratio, best.losses, *_sizes(values, best.names, blocks)),
    )


def _still_healthy(blocks: WheelBlocks, measured: float, healthy: HealthyWheels, spread: float) -> WheelFinding | None:
    """The wheels as they were when the robot was commissioned, if that predicts them still.

    It does where its error is within a standard deviation of that on healthy drives, and neither other values, nor
    another ratio of wheels and commands, nor any further effect predict held-out blocks better beyond chance.
    """
    selection = _Selection(replace(blocks, measured=blocks.measured / healthy.ratio))
    blocks, before = selection.blocks, _as_known(healthy, selection.blocks)
    names, values = before.names, before.values
    samples, changes = _sizes(values, names, blocks)
    expected = healthy.expected(samples, changes)
    ratio = before.loss / max(float(expected.sum()), 1e-12)
    error = relative_error(before.losses - ratio * expected, before.loss)
    if np.log(max(ratio, 1e-12)) > np.hypot(spread, error):
        return None
    gain = measured / healthy.ratio
    free = _Selection(replace(blocks, measured=blocks.measured / gain)).scored(names, before)
    others = [replace(free, losses=free.losses * gain**2), selection.scored(names, before)]
    others += [selection.scored(larger, before) for larger in selection.larger(names)]
    if any(_better(before, other, len(others)) for other in others):
        return None
    return WheelFinding(
        healthy.effects,
        tuple(widths for _, widths in _named(names, _half_widths(values, names, blocks) if names else values)),
        float(np.sqrt(selection.scored((), None).loss / samples.sum())),
        float(np.sqrt(before.loss / samples.sum())),
        healthy.ratio,
        ruled_out=tuple(_ruled_out(names, values, blocks, unchanged=True)),
        unchanged=True,
        model=healthy,
    )


def best_of(
    models: Sequence[HealthyWheels], recordings: Sequence[tuple[CommandTrack, WheelTrack]], robot: RobotModel
) -> HealthyWheels | None:
    """That of several models which predicts the wheels of all recordings best, with its error on all; None without any.

    What the wheels of one recording show need not predict another.
    """
    cut = [WheelBlocks.of(commands, wheels, robot, _STEP) for commands, wheels in recordings]
    recorded = [blocks for blocks in cut if blocks is not None]
    judged: list[tuple[float, HealthyWheels]] = []
    for model in models:
        parts = []
        for blocks in recorded:
            used = replace(blocks, measured=blocks.measured / model.ratio)
            known = _as_known(model, used)
            parts.append((known.losses, *_sizes(known.values, known.names, used)))
        losses, samples, changes = (np.concatenate(rows) for rows in zip(*parts, strict=True))
        learned = HealthyWheels.learned(model.effects, model.ratio, losses, samples, changes)
        judged.append((float(losses.sum()), learned))
    return min(judged, key=lambda entry: entry[0])[1] if judged else None


def _as_known(healthy: HealthyWheels, blocks: WheelBlocks) -> _Model:
    """What commissioning learned, judged on blocks of the speeds of the wheels' rims."""
    known = dict(healthy.effects)
    names = _in_order(tuple(known))
    values = np.array([known[name][key] for name in names for key in _keys(name)])
    return _Model(names, values, _block_losses(values, names, blocks, blocks.fastest.speed))


def _sizes(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks) -> tuple[np.ndarray, np.ndarray]:
    """Samples of each block, of both sides, and the sum of squared changes of the commands by effects, ``[n]``."""
    changes = blocks.at_samples(_modelled(values, names, blocks) - blocks.commanded()) * blocks.pairs
    return blocks.pairs.sum(axis=(1, 2)), (changes**2).sum(axis=(1, 2))


def _selected(blocks: WheelBlocks, measured: float, healthy: HealthyWheels | None) -> tuple[_Selection, float, float]:
    """The selection on wheel speeds as speeds of the wheels' rims, with the ratio of the two and the gain.

    The known radius is used if the measured ratio is plausible, so that a drive that is too slow appears as an error,
    unless the wheels follow another ratio better beyond chance: drives that multiply every command have no limit or
    delay that would explain it. Effects that are too similar to a gain are not combined with one.
    """
    radius = blocks.robot.wheel_radius if healthy is None else 1.0 / healthy.ratio
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


def changed_drives(
    wheels: WheelFinding, robot: RobotModel, healthy: HealthyWheels | None = None
) -> tuple[Effects, tuple[str, ...]]:
    """Where the wheels differ from what commissioning learned of them, or else from what the robot's file says.

    Returns:
        the effects whose value differs by more than its confidence interval, with the values of the wheels; and the
        names of those that did not change.
    """
    if wheels.unchanged:
        return (), (*(name for name, _ in wheels.effects), *wheels.ruled_out)
    in_file, shown = dict(robot.effects if healthy is None else healthy.effects), dict(wheels.effects)
    half_widths = {
        name: widths[_response(name).parameter] for name, widths in zip(shown, wheels.half_widths, strict=True)
    }
    largest = max(half_widths.values(), default=0.0)
    changed: list[tuple[str, Mapping[str, float]]] = []
    unchanged = []
    for effect in wheel_effects():
        response = _response(effect.name)
        neutral = _neutral(effect.name)
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

    def __init__(self, blocks: WheelBlocks):
        self.blocks = blocks
        self._fold = np.arange(len(blocks)) % 2
        self._parts = [blocks[self._fold == number] for number in (0, 1)]
        self._known: dict[tuple[str, ...], _Model] = {}
        names = [effect.name for effect in wheel_effects() if effect.applies_to(blocks.robot)]
        self._order = [name for name in names if not _response(name).of_time]
        self._of_time = [name for name in names if _response(name).of_time]

    @cached_property
    def best(self) -> _Model:
        """The smallest model that no larger one improves.

        The best model of each size is found by a floating search (Pudil et al. 1994): one more effect, exchanges, and
        removals that improve the smaller size. One effect may stand in for several: a lag for two ramps.
        """
        found = [self.scored((), None)]
        while len(found) <= _LARGEST_MODEL:
            candidates = [self.scored(names, found[-1]) for names in self.larger(found[-1].names)]
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
        return self._with_time(self._pruned(best))

    def _with_time(self, best: _Model) -> _Model:
        """The model with an effect that grows with time, if that is better than a change at some time."""
        for name in self._of_time:
            further = self.scored(_in_order((*best.names, name)), best)
            if _better(best, further, len(self._order)) and further.loss < self._stepped_loss(best):
                best = further
        return best

    def _stepped_loss(self, model: _Model) -> float:
        """Smallest held-out loss if the wheels follow the model at another ratio from some block on."""
        blocks, top = self.blocks, self.blocks.fastest.speed
        modelled = blocks.at_samples(_modelled(model.values, model.names, blocks)) * blocks.pairs
        products, squares = ((part * modelled).sum(axis=(1, 2)) for part in (blocks.measured * blocks.pairs, modelled))
        losses = []
        for first in range(1, len(blocks)):
            ratio = np.ones(len(blocks))
            for held_out in (0, 1):
                fitted = (np.arange(len(blocks)) >= first) & (self._fold != held_out)
                judged = (np.arange(len(blocks)) >= first) & (self._fold == held_out)
                ratio[judged] = products[fitted].sum() / max(float(squares[fitted].sum()), 1e-12)
            rest = (blocks.measured - ratio[:, None, None] * modelled) * blocks.pairs
            losses.append(float(np.minimum(rest**2, (0.5 * top) ** 2).sum()))
        return min(losses)

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

    def larger(self, names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        """Models with one more effect."""
        for name in self._order:
            excluded = any(other in _response(name).excludes or name in _response(other).excludes for other in names)
            if name not in names and not excluded:
                yield _in_order((*names, name))

    def _exchanged(self, best: _Model) -> _Model:
        """The best model with one effect replaced by another, or ``best``; a first effect may stand in for a later."""
        tried = [best]
        for name in best.names:
            rest = tuple(other for other in best.names if other != name)
            tried += [self.scored(names, best) for names in self.larger(rest) if name not in names]
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


def _weak(model: _Model, blocks: WheelBlocks) -> list[str]:
    """Effects of a model whose values are too small to count."""
    return [
        name
        for name, (value, *_) in _by_effect(model.names, model.values)
        if not _response(name).counts(value, blocks.fastest)
    ]


def _ruled_out(
    names: tuple[str, ...], values: np.ndarray, blocks: WheelBlocks, *, unchanged: bool = False
) -> Iterator[str]:
    """Effects that a model does not hold, and that would count only at values which the wheels contradict.

    That a selection leaves an effect out does not show that it is absent: noise may hide it, or another effect stand in
    for it. Each is therefore fitted beside the others, and its confidence interval looked at. Where the model of
    commissioning still holds, ``unchanged``, an effect is ruled out, too, if its interval would be narrow enough to
    show one that counts: what it holds was so when the robot was healthy.
    """
    for effect in wheel_effects():
        if effect.name in names or not effect.applies_to(blocks.robot):
            continue
        together = _in_order((*names, effect.name))
        known = _Model(names, values, np.zeros(0))
        fitted = _fit(together, blocks, _starts(together, blocks.fastest, known))
        value, *_ = dict(_by_effect(together, fitted))[effect.name]
        half_width, *_ = dict(_by_effect(together, _half_widths(fitted, together, blocks)))[effect.name]
        response, neutral = _response(effect.name), _neutral(effect.name)
        intervals = [(value - half_width, value + half_width)]
        if unchanged and np.isfinite(neutral):
            intervals.append((neutral - half_width, neutral + half_width))
        for ends in intervals:
            if np.isfinite(ends).all() and not any(response.counts(end, blocks.fastest) for end in ends):
                yield effect.name
                break


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


def _named(names: Sequence[str], values: np.ndarray) -> Effects:
    """Values ``[P]`` of the parameters of each effect, by their names."""
    return tuple((name, dict(zip(_keys(name), own, strict=True))) for name, own in _by_effect(names, values))


def _neutral(name: str) -> float:
    """Value without effect of the parameter that says how large an effect is."""
    return next(p.neutral for p in CATALOGUE[name].parameters if p.name == _response(name).parameter)


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


def _modelled(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks) -> np.ndarray:
    """Speeds ``[n, 2, T]`` [m/s] of wheels that follow the commands under effects: those on the twist act first."""
    ordered = sorted(_by_effect(names, values), key=lambda entry: not _response(entry[0]).of_twist)
    signal, sides = blocks.twists, False
    for count, (name, own) in enumerate(ordered):
        response, first = _response(name), tuple(ordered[: count + 1])
        known = blocks.reached.get(first)
        if known is None:
            further = (blocks.step, blocks.times) if response.of_time else (blocks.step,)
            if response.of_twist:
                changed = response.speeds(signal[:, :2], *own, *further)
                known = np.concatenate([changed, signal[:, 2:]], axis=1) if signal.shape[1] > 2 else changed
            else:
                known = response.speeds(signal if sides else blocks.commanded(signal), *own, *further)
            if len(blocks.reached) >= _MOST_REACHED:
                blocks.reached.clear()
            blocks.reached[first] = known
        signal, sides = known, not response.of_twist
    return signal if sides else blocks.commanded(signal)


def _residuals(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks) -> np.ndarray:
    """Measured minus modelled speed ``[n, 2, K]`` [m/s]; zero where there is no sample."""
    return (blocks.measured - blocks.at_samples(_modelled(values, names, blocks))) * blocks.pairs


def _block_losses(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks, top: float) -> np.ndarray:
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


def _fit(names: tuple[str, ...], blocks: WheelBlocks, starts: Sequence[np.ndarray]) -> np.ndarray:
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


def _half_widths(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks) -> np.ndarray:
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
