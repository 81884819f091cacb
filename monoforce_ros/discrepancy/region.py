"""Region: the part of the ground in which effects act, such as ice or tall grass.

Where a map tells classes of ground apart, these are tried; else circles on the ground. Which of them it is follows from
a scan (Kulldorff 1997): an effect that acts in a region alone pulls at the residuals there and nowhere else. What the
best of all areas gains by chance is known from the same scan with block sums of random sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.discrepancy.areas import Area, circles, ground_classes, reach_of, touching
from monoforce_ros.discrepancy.evidence import EvidenceWindows, Place
from monoforce_ros.discrepancy.fit import fit_effects, robust_weights
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.discrepancy.local_rollout import moves_rigidly
from monoforce_ros.discrepancy.patch import find_patch
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import Trial, blocks_of, paired
from monoforce_ros.effects import CATALOGUE

_TRIED = 3
"""Effects of the catalogue whose region is sought with fitted values: those that pull most in any area. It only saves
time."""
_PROMISING = 0.3
"""Share of the largest pull below which the others of these are not fitted."""


@dataclass(frozen=True)
class Region:
    """A recording that is healthy outside an area and has effects within it."""

    area: Area
    acting: np.ndarray
    """Windows in which the effects act, ``[W]`` bool."""
    losses: np.ndarray
    """Of each window, ``[W]``."""
    place: Place | None
    """The ground on which they act while such a window lasts; None: they act in the whole of it."""
    reach: float
    """Distance of the robot's farthest point from its base [m]."""

    def acting_in(self, data: EvidenceWindows) -> np.ndarray:
        """Windows of any length in which the effects act, ``[W]`` bool."""
        return _acting(self.area, self.place, data, self.reach)

    @property
    def remark(self) -> str:
        """Where, in words."""
        count, number = int(self.acting.sum()), len(self.acting)
        text = (
            f"It acts {self.area.place.words} ({count} of {number} windows), which follows from all of them; these "
            "figures are of the robot there."
        )
        if self.area.visits == 1:
            text += " The robot was there once: the time may be the cause, not the place."
        return text


@dataclass(frozen=True)
class _Pull:
    """What an effect would change in each window, to first order."""

    score: np.ndarray
    """``[W]``: the effect's share of the residuals, weighted."""
    information: np.ndarray
    """``[W]``."""

    @classmethod
    def of(cls, search: Search, change: np.ndarray) -> _Pull:
        """Of a change of the scaled residuals, ``[W, K, C]``."""
        residual, change = search.directions.scaled(search.known), np.nan_to_num(change)
        weights = robust_weights(residual)
        score = -(weights * change * np.nan_to_num(residual)).sum(axis=(1, 2))
        return cls(score, (weights * change**2).sum(axis=(1, 2)))

    def gains(self, masks: np.ndarray) -> np.ndarray:
        """Reduction of the loss by the effect in each area ``[A, W]`` alone, ``[A]``."""
        return (masks @ self.score) ** 2 / np.maximum(masks @ self.information, 1e-12)

    def scan_p(self, masks: np.ndarray, blocks: np.ndarray, draws: int, seed: int) -> float:
        """p-value of the largest difference between an area and the rest, adjusted for all areas ``[A, W]``.

        Differences are divided by their standard errors from the scores of blocks (White 1980), in the recording and in
        draws in which the scores that a common value leaves have random signs by block (wild cluster bootstrap).
        """
        common = self.score.sum() / max(self.information.sum(), 1e-12)
        left = self.score - common * self.information
        member = (blocks[:, None] == np.unique(blocks)).astype(float)
        signs = np.random.default_rng(seed).choice((-1.0, 1.0), (draws, member.shape[1]))
        signs = np.concatenate([np.ones((1, member.shape[1])), signs])
        difference, deviation = 0.0, 0.0
        for sign, part in ((1.0, masks), (-1.0, 1.0 - masks)):
            total = np.maximum(part @ self.information, 1e-12)[:, None]
            sums, shares = (part * left) @ member / total, (part * self.information) @ member / total
            drawn = signs[:, None] * sums
            value = drawn.sum(axis=2)
            difference = difference + sign * value
            deviation = deviation + sign * (drawn - value[..., None] * shares)
        statistic = (np.abs(difference) / np.maximum(np.linalg.norm(deviation, axis=2), 1e-12)).max(axis=1)
        return float((statistic >= statistic[0]).mean())


def find_region(search: Search, trials: Sequence[Trial]) -> Region | None:
    """The part of the ground in which effects act, if that explains a recording better than effects everywhere.

    The effects of ``trials``, and those of the catalogue that pull most in any area, are fitted there. Outside the area
    the residuals without them count, within it those with them; the smallest loss is taken. It must gain beyond chance
    over blocks, and the area differ from the rest by more than the best of all areas does by chance.

    Args:
        search: search on the whole recording.
        trials: effects that were found on it and on parts of it.
    """
    kinds = [areas for areas in (ground_classes(search.data), circles(search.data)) if areas]
    if not kinds:
        return None
    pulls = _pulls(search)
    scanned = [_scanned(search, trials, pulls, areas) for areas in kinds]
    patch = find_patch(search)
    placed = None
    if patch is not None:
        placed = Region(patch.area, patch.area.inside, patch.losses, patch.area.place, reach_of(search.robot))
    found = [region for region in (*scanned, placed) if region is not None]
    if not found:
        return None
    # A class of ground says why an effect acts where it does: a circle must predict better beyond chance.
    first, best = found[0], min(found, key=lambda region: region.losses.mean())
    _, low = paired(first.losses, best.losses, search.data.starts, search.thresholds.comparison_rate)
    return best if low > 0 else first


def _scanned(
    search: Search, trials: Sequence[Trial], pulls: Sequence[tuple[Effects, _Pull]], areas: Sequence[Area]
) -> Region | None:
    """The best region of some areas, if any is better than effects everywhere."""
    masks = np.array([area.inside for area in areas], float)
    starts, before = search.data.starts, search.loss_of(search.known)
    tried = []
    for effects in _candidates(search, trials, pulls, masks):
        chosen, fitted = _located(search, effects, masks)
        region, fitted = _region(search, areas[chosen], effects, fitted, before)
        tried.append((float(region.losses.mean()), region, fitted, effects))
    if not tried:
        return None
    _, region, fitted, effects = min(tried, key=lambda entry: entry[0])
    whole = search.loss_of(search.refit(effects).effects)
    thresholds = search.thresholds
    least = thresholds.smallest_share * max(float(before.mean()), search.healthy_loss)
    gains = [paired(other, region.losses, starts, thresholds.comparison_rate) for other in (whole, before)]
    if any(low <= 0 or gain < least for gain, low in gains):
        return None
    pull = _Pull.of(search, search.directions.scaled(fitted) - search.directions.scaled(search.known))
    p = pull.scan_p(masks, blocks_of(starts), thresholds.draws, search.seed)
    return region if p <= thresholds.effect_rate else None


def _region(
    search: Search, area: Area, effects: Effects, fitted: Effects, before: np.ndarray
) -> tuple[Region, Effects]:
    """The region of an area, and the effects fitted to it.

    Args:
        search: search on the whole recording.
        area: in which they act.
        effects: with initial values.
        fitted: with those that fit windows in the area.
        before: losses of the windows without them, ``[W]``.
    """
    place = area.place if moves_rigidly(search.robot) else None
    reach = reach_of(search.robot)
    acting = _acting(area, place, search.data, reach)
    there = search.predictions.on(place, acting)
    scale = search.scale[acting]
    fit = fit_effects(there, [fitted, effects], scale, iterations=6, free=search.fixed_count(effects))
    losses = before.copy()
    losses[acting] = fit.loss
    return Region(area, acting, losses, place, reach), fit.effects


def _acting(area: Area, place: Place | None, data: EvidenceWindows, reach: float) -> np.ndarray:
    """Windows in which effects on an area act, ``[W]`` bool."""
    return area.place.contains(data) if place is None else touching(place, data, reach)


def _pulls(search: Search) -> list[tuple[Effects, _Pull]]:
    """What every effect that may act on a part of the ground would change at each of its initial values.

    What an effect does is not linear: low friction changes nothing until the tyres slip. Where it acts in a small part
    of a recording, its value for the whole says nothing of it.
    """
    known, nominal = search.known, search.directions.scaled(search.known)
    pulls = []
    for effect in search.screening.possible([name for name, _ in known]):
        if effect.everywhere:
            continue
        starts = [known + start for start in search.screening.starts(effect)]
        scaled = search.predictions.residuals(starts) / search.scale
        pulls += [(start, _Pull.of(search, own - nominal)) for start, own in zip(starts, scaled, strict=True)]
    return pulls


def _candidates(
    search: Search, trials: Sequence[Trial], pulls: Sequence[tuple[Effects, _Pull]], masks: np.ndarray
) -> list[Effects]:
    """The effects of trials, and those that pull most in any area at one of their initial values."""
    best: dict[str, tuple[float, Effects]] = {}
    for effects, pull in pulls:
        gain, name = float(pull.gains(masks).max()), effects[-1][0]
        if name not in best or gain > best[name][0]:
            best[name] = gain, effects
    strongest = sorted(best.values(), key=lambda entry: -entry[0])[:_TRIED]
    fixed = len(search.known)
    listed = [
        trial.effects
        for trial in trials
        if len(trial.effects) > fixed and not any(CATALOGUE[name].everywhere for name in trial.names[fixed:])
    ]
    return [*listed, *(effects for gain, effects in strongest if gain > _PROMISING * strongest[0][0])]


def _located(search: Search, effects: Effects, masks: np.ndarray) -> tuple[int, Effects]:
    """The area in which effects act, and their values there."""
    pull = _Pull.of(search, search.directions.scaled(effects) - search.directions.scaled(search.known))
    chosen, fitted = int(np.argmax(pull.gains(masks))), effects
    before = search.loss_of(search.known)
    for _ in range(2):
        inside = masks[chosen] > 0
        there = Predictions(search.robot, replace(search.data, starts=search.data.starts[inside]))
        fit = fit_effects(
            there, [fitted, effects], search.scale[inside], iterations=6, free=search.fixed_count(effects)
        )
        fitted = fit.effects
        better = int(np.argmax(masks @ (before - search.loss_of(fitted))))
        if better == chosen:
            break
        chosen = better
    return chosen, fitted
