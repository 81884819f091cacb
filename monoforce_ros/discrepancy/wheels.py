"""Wheels: how the drives follow commands, by measured wheel speeds and so independent of the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import wilcoxon

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.residual_size import relative_error
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.wheel_blocks import BLOCK, WheelBlocks
from monoforce_ros.discrepancy.wheel_fit import fit, half_widths, starts
from monoforce_ros.discrepancy.wheel_model import (
    WheelModel,
    block_losses,
    by_effect,
    in_order,
    keys_of,
    modelled,
    named,
    neutral_of,
    response_of,
)
from monoforce_ros.discrepancy.wheel_units import PLAUSIBLE
from monoforce_ros.effects import only_effect, wheel_effects
from monoforce_ros.robots import RobotModel

_STEP, _FINE_STEP = 0.04, 0.01
"""Of the modelled wheel speeds, in the selection and in the final fit [s]."""
_MOST_BLOCKS = 60
"""Blocks that are used at most: whole ones, spread evenly over the recording. It only saves time: of four
minutes of driving a test by ranks needs no more."""
_FEWEST_SAMPLES = 100
"""Of the wheels: ten blocks with as few samples as count, or two with 50 or more."""
_SLOWEST = 0.1
"""Fastest commanded speed of the wheels below which nothing is said of the drives [m/s]: twice that at which wheels may
creep."""
_FOLLOWED = 0.5
"""Share of the wheels' variance that commands must explain: most of it."""
_ALPHA = 0.05
"""Probability that a step of the selection adds an effect that the wheels do not show, over all candidates."""
_LARGEST_MODEL = 5
"""Largest number of effects in a wheel model: dead time, three limits of the twist and a lag."""
_MOST_EXCHANGES = 3
"""Of a model that are fitted in full."""
_GAIN = only_effect(lambda effect: effect.like_ratio)
"""Stands for a fitted ratio among what effects exclude."""
_SAME_RATIO = 0.02
"""Relative difference of the measured speed ratio from the known radius' within which they are one: a worn tyre's."""
_FURTHER = 0.01
"""Share of the error that a further effect must remove for the search to go on: it only saves time, for what is added
is decided by the test."""


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
        parts = [response_of(name).wording.format(*values.values()) for name, values in self.effects]
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
    if wheels is None or len(wheels) < _FEWEST_SAMPLES or not len(commands):
        return None
    found = WheelBlocks.of(commands, wheels, robot, _STEP)
    if found is None or found.fastest.speed < _SLOWEST:
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
    values, widths_95 = best.values, np.zeros(0)
    if best.names:
        fine = WheelBlocks.of(commands, wheels, robot, _FINE_STEP)
        assert fine is not None
        fine = replace(fine, measured=fine.measured / ratio)[chosen]
        values = fit(best.names, fine, [best.values])[0]
        widths_95 = half_widths(best.names, values, fine)
    baseline = selection.scored((), None)
    count = float(blocks.known.sum()) * 2
    spreads = [float(np.var(part[blocks.pairs])) for part in (blocks.measured, blocks.at_samples(blocks.commanded()))]
    if best.loss / count > (1.0 - _FOLLOWED) * min(spreads):
        # The wheels do not follow the commands.
        return None
    effects = named(best.names, values)
    return WheelFinding(
        effects,
        tuple(widths for _, widths in named(best.names, widths_95)),
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
        tuple(widths for _, widths in named(names, half_widths(names, values, blocks))),
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


def _as_known(healthy: HealthyWheels, blocks: WheelBlocks) -> WheelModel:
    """What commissioning learned, judged on blocks of the speeds of the wheels' rims."""
    known = dict(healthy.effects)
    names = in_order(tuple(known))
    values = np.array([known[name][key] for name in names for key in keys_of(name)])
    return WheelModel(names, values, block_losses(names, values, blocks, blocks.fastest.speed))


def _sizes(values: np.ndarray, names: tuple[str, ...], blocks: WheelBlocks) -> tuple[np.ndarray, np.ndarray]:
    """Samples of each block, of both sides, and the sum of squared changes of the commands by effects, ``[n]``."""
    changes = blocks.at_samples(modelled(names, values, blocks)[0] - blocks.commanded()) * blocks.pairs
    return blocks.pairs.sum(axis=(1, 2)), (changes**2).sum(axis=(1, 2))


def _selected(blocks: WheelBlocks, measured: float, healthy: HealthyWheels | None) -> tuple[_Selection, float, float]:
    """The selection on wheel speeds as speeds of the wheels' rims, with the ratio of the two and the gain.

    The known radius is used if the measured ratio is plausible, so that a drive that is too slow appears as an error,
    unless the wheels follow another ratio better beyond chance: drives that multiply every command have no limit or
    delay that would explain it. Effects that are too similar to a gain are not combined with one.
    """
    radius = blocks.robot.wheel_radius if healthy is None else 1.0 / healthy.ratio
    free = _Selection(replace(blocks, measured=blocks.measured / measured))
    if radius is None or not PLAUSIBLE[0] < measured * radius < PLAUSIBLE[1]:
        return free, measured, 1.0
    known, gain = _Selection(replace(blocks, measured=blocks.measured * radius)), measured * radius
    if abs(gain - 1.0) > _SAME_RATIO:
        other = free.best
        alike = any(_GAIN in response_of(name).excludes for name in other.names)
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
    uncertain = {
        name: widths[response_of(name).parameter] for name, widths in zip(shown, wheels.half_widths, strict=True)
    }
    largest = max(uncertain.values(), default=0.0)
    changed: list[tuple[str, Mapping[str, float]]] = []
    unchanged = []
    for effect in wheel_effects():
        response = response_of(effect.name)
        neutral = neutral_of(effect.name)
        expected = float(in_file.get(effect.name, {}).get(response.parameter, neutral))
        value = float(shown[effect.name][response.parameter]) if effect.name in shown else neutral
        # Of an effect that the wheels do not show the half-width is unknown: the largest one stands for it.
        half_width = uncertain.get(effect.name, largest)
        if effect.name not in shown and expected == neutral and effect.name not in wheels.ruled_out:
            # The wheels neither show it nor rule it out.
            continue
        if value == expected or abs(value - expected) <= half_width:
            unchanged.append(effect.name)
        elif np.isfinite(value):
            changed.append((effect.name, dict(shown.get(effect.name, {response.parameter: value}))))
    return tuple(changed), tuple(unchanged)


class _Selection:
    """Selection of the effects that measured wheel speeds show."""

    def __init__(self, blocks: WheelBlocks):
        self.blocks = blocks
        self._fold = np.arange(len(blocks)) % 2
        self._known: dict[tuple[str, ...], WheelModel] = {}
        names = [effect.name for effect in wheel_effects() if effect.applies_to(blocks.robot)]
        self._order = [name for name in names if not response_of(name).of_time]
        self._of_time = [name for name in names if response_of(name).of_time]

    @cached_property
    def best(self) -> WheelModel:
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

    def _with_time(self, best: WheelModel) -> WheelModel:
        """The model with an effect that grows with time, if that is better than a change at some time."""
        for name in self._of_time:
            further = self.scored(in_order((*best.names, name)), best)
            if _better(best, further, len(self._order)) and further.loss < self._stepped_loss(best):
                best = further
        return best

    def _stepped_loss(self, model: WheelModel) -> float:
        """Smallest held-out loss if the wheels follow the model at another ratio from some block on."""
        blocks, top = self.blocks, self.blocks.fastest.speed
        predicted = blocks.at_samples(modelled(model.names, model.values, blocks)[0]) * blocks.pairs
        measured = blocks.measured * blocks.pairs
        products, squares = ((part * predicted).sum(axis=(1, 2)) for part in (measured, predicted))
        losses = []
        for first in range(1, len(blocks)):
            ratio = np.ones(len(blocks))
            for held_out in (0, 1):
                fitted = (np.arange(len(blocks)) >= first) & (self._fold != held_out)
                judged = (np.arange(len(blocks)) >= first) & (self._fold == held_out)
                ratio[judged] = products[fitted].sum() / max(float(squares[fitted].sum()), 1e-12)
            rest = (blocks.measured - ratio[:, None, None] * predicted) * blocks.pairs
            losses.append(float(np.minimum(rest**2, (0.5 * top) ** 2).sum()))
        return min(losses)

    def scored(self, names: tuple[str, ...], start: WheelModel | None) -> WheelModel:
        """A model fitted to each fold and judged on the other, from the values of a similar one."""
        if names not in self._known:
            self._known[names] = self._fitted(names, start)
        return self._known[names]

    def _fitted(self, names: tuple[str, ...], start: WheelModel | None, *, rough: bool = False) -> WheelModel:
        top = self.blocks.fastest
        values = fit(names, self.blocks, starts(names, top, start), self._fold, rough=rough)
        losses = block_losses(names, values[1 - self._fold], self.blocks, top.speed)
        return WheelModel(names, values.mean(axis=0), losses)

    def larger(self, names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        """Models with one more effect."""
        for name in self._order:
            own = response_of(name).excludes
            excluded = any(other in own or name in response_of(other).excludes for other in names)
            if name not in names and not excluded:
                yield in_order((*names, name))

    def _exchanged(self, best: WheelModel) -> WheelModel:
        """The best model with one effect replaced by another, or ``best``; a first effect may stand in for a later."""
        others = set()
        for name in best.names:
            rest = tuple(other for other in best.names if other != name)
            others |= {names for names in self.larger(rest) if name not in names}
        known = [self._known[names] for names in sorted(others) if names in self._known]
        # Most stand in badly, as a few steps of a fit show.
        rough = [self._fitted(names, best, rough=True) for names in sorted(others) if names not in self._known]
        rough.sort(key=lambda model: model.loss)
        tried = [best, *known, *(self.scored(model.names, best) for model in rough[:_MOST_EXCHANGES])]
        return min(tried, key=lambda model: model.loss)

    def _smaller(self, model: WheelModel) -> list[WheelModel]:
        return [self.scored(tuple(other for other in model.names if other != name), model) for name in model.names]

    def _pruned(self, best: WheelModel) -> WheelModel:
        """The model without effects that do not improve it."""
        for fewer in sorted(self._smaller(best), key=lambda model: model.loss):
            if not _better(fewer, best, 1):
                return self._pruned(fewer)
        return best


def _better(smaller: WheelModel, larger: WheelModel, candidates: int) -> bool:
    """Whether the larger model's held-out error is smaller beyond chance, given how many models it is the best of."""
    gains = smaller.losses - larger.losses
    if larger.loss >= smaller.loss or not gains.any():
        return False
    # By ranks: blocks without a step of the commands show little of either sign, and count little.
    return bool(wilcoxon(gains, alternative="greater").pvalue * candidates < _ALPHA)


def _weak(model: WheelModel, blocks: WheelBlocks) -> list[str]:
    """Effects of a model whose values are too small to count."""
    return [
        name
        for name, (value, *_) in by_effect(model.names, model.values)
        if not response_of(name).counts(value, blocks.fastest)
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
        together = in_order((*names, effect.name))
        known = WheelModel(names, values, np.zeros(0))
        fitted = fit(together, blocks, starts(together, blocks.fastest, known))[0]
        value, *_ = dict(by_effect(together, fitted))[effect.name]
        half_width, *_ = dict(by_effect(together, half_widths(together, fitted, blocks)))[effect.name]
        response, neutral = response_of(effect.name), neutral_of(effect.name)
        intervals = [(value - half_width, value + half_width)]
        if unchanged and np.isfinite(neutral):
            intervals.append((neutral - half_width, neutral + half_width))
        for ends in intervals:
            if np.isfinite(ends).all() and not any(response.counts(end, blocks.fastest) for end in ends):
                yield effect.name
                break
