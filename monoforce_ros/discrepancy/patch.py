"""Patch: a circle of ground with another friction or softness, placed by the paths of single wheels.

Windows of two seconds mostly cross the edge of a patch of ice of a few metres, and there one wheel slips before the
other. Such windows are predicted on a map with the patch, and its place, size and value are those with the smallest
loss: the loss falls steeply where every wheel meets the patch when it did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, differential_evolution, minimize
from scipy.stats import qmc

from monoforce_ros.discrepancy.areas import Area, Circle, paths_of, reach_of, swept, touched
from monoforce_ros.discrepancy.fit import fit_effects, robust
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.local_rollout import moves_rigidly
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import paired
from monoforce_ros.effects import CATALOGUE

_LARGEST = 8
"""Windows with the largest losses: the first guesses touch the path of one of them."""
_WINDOWS = (16, 24)
"""Windows with the largest losses, and of the others, spread over the recording, by which circles are compared: all of
a longer drive would say no more of the place, and cost more."""
_DRAWS, _POPULATION = 1024, 40
"""Circles that are drawn, and those of them with which the search begins."""
_TOUCHED = 0.8
"""Share of the excess loss in the windows that a first guess should touch: elsewhere a patch explains nothing."""
_RADII = (1.0, 5.0)
"""Radii of the first guesses, in lengths of the robot's reach."""
_GENERATIONS, _LAST = 10, 50
"""Generations, and predictions with which the best of the last one is improved. In three draws for a drive of the
project's own over ice this is found each time; from the best of as many guesses a simplex finds it in one of three."""
_HOPEFUL_AFTER, _HOPEFUL = 3, 0.25
"""Generations after which a search ends that has explained less than this share of what an explanation must explain;
it only saves time."""
_STEPS = np.array([0.15, 0.15, 0.08, 0.15])
"""Of the last simplex, in x and y [m], and in the logarithms of radius and value."""
_MARGIN = 0.3
"""By which the search may leave the range of the first guesses, in these units."""


@dataclass(frozen=True)
class Patch:
    """A circle in which a property of the ground differs, and how well that predicts a recording."""

    area: Area
    """With the windows in which any wheel touches it."""
    effects: Effects
    losses: np.ndarray
    """Of each window, ``[W]``."""


def find_patch(search: Search) -> Patch | None:
    """The patch of ground that explains a recording, if the robot came to it at least twice.

    It must explain as large a share of the loss in excess of a healthy robot's as any explanation, and gain beyond
    chance over blocks. The loss has many minima: it is searched by differential evolution (Storn and Price 1997) and at
    the end by the simplex of Nelder and Mead (1965).

    Args:
        search: search on the whole recording.
    """
    names = [effect.name for effect in search.screening.possible([name for name, _ in search.known])]
    names = [name for name in names if CATALOGUE[name].of_ground]
    fit = _Fit(search)
    least = search.thresholds.explained_share * (float(fit.before.mean()) - search.healthy_loss)
    if not names or least <= 0 or not moves_rigidly(search.robot):
        return None
    tried = [found for name in names if (found := fit.best(name, least)) is not None]
    if not tried:
        return None
    _, name, point = min(tried, key=lambda entry: entry[0])
    patch = fit.patch(name, point)
    gain, low = paired(fit.before, patch.losses, search.data.starts, search.thresholds.comparison_rate)
    return patch if patch.area.visits > 1 and low > 0 and gain >= least else None


class _Fit:
    """Fits patches to the windows of a search. A point is x, y [m] and the logarithms of radius and value."""

    def __init__(self, search: Search):
        self.search, self.before = search, search.loss_of(search.known)
        self._reach = reach_of(search.robot)
        self._swept = swept(search.data, self._reach)
        self._weights = _weights(self.before)

    def guesses(self, name: str) -> np.ndarray:
        """Points on the paths with the largest losses that touch most of what is unexplained, ``[N, 4]``."""
        data, healthy, effect = self.search.data, self.search.healthy_loss, CATALOGUE[name]
        places = paths_of(data)[np.argsort(-self.before)[:_LARGEST], :, :2].reshape(-1, 2)
        excess = np.maximum(self.before - healthy, 0.0)
        values = [value for ((_, start),) in self.search.screening.starts(effect) for value in start.values()]
        low, high = np.log([min(values), max(values)])
        draws = qmc.Sobol(5, seed=self.search.seed).random(_DRAWS)
        radii = self._reach * _RADII[0] * (_RADII[1] / _RADII[0]) ** draws[:, 1]
        angles = 2.0 * np.pi * draws[:, 3]
        away = (radii * np.sqrt(draws[:, 2]))[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        centres = places[(draws[:, 0] * len(places)).astype(int)] + away
        points = np.column_stack([centres, np.log(radii), low + draws[:, 4] * (high - low)])
        covered = [excess[self._touched(_unpacked(name, point)[0])].sum() for point in points]
        most = np.argsort(-np.minimum(covered, _TOUCHED * excess.sum()), kind="stable")
        return points[most[:_POPULATION]]

    def best(self, name: str, least: float) -> tuple[float, str, np.ndarray] | None:
        """The smallest loss with an effect, its name, and where; None where it is hopeless.

        Args:
            name: of the effect.
            least: gain of the loss that is needed.
        """
        guesses, hoped = self.guesses(name), float(self.before.mean()) - _HOPEFUL * least
        generations = 0

        def hopeless(intermediate_result: OptimizeResult) -> bool:
            nonlocal generations
            generations += 1
            return generations >= _HOPEFUL_AFTER and intermediate_result.fun > hoped

        found = differential_evolution(
            lambda point: self.loss(name, point),
            list(zip(guesses.min(axis=0) - _MARGIN, guesses.max(axis=0) + _MARGIN, strict=True)),
            init=guesses,
            maxiter=_GENERATIONS,
            mutation=(0.4, 0.9),
            recombination=0.8,
            tol=0.0,
            polish=False,
            callback=hopeless,
            rng=self.search.seed,
        )
        if found.fun > hoped:
            return None
        last = minimize(
            lambda point: self.loss(name, point),
            found.x,
            method="Nelder-Mead",
            options={"initial_simplex": np.vstack([found.x, found.x + np.diag(_STEPS)]), "maxfev": _LAST},
        )
        return float(last.fun), name, last.x

    def _touched(self, circle: Circle) -> np.ndarray:
        """Windows in which any wheel touches a circle, ``[W]`` bool."""
        return touched(circle, self._swept, self.search.data)

    def loss(self, name: str, point: np.ndarray) -> float:
        """Mean loss with a patch, from some of the windows."""
        circle, effects = _unpacked(name, point)
        chosen = self._touched(circle) & (self._weights > 0)
        losses = self.before.copy()
        if chosen.any():
            there = self.search.predictions.on(circle, chosen)
            scaled = there.residuals([(*self.search.known, *effects)])[0]
            losses[chosen] = robust(scaled / self.search.scale[chosen])
        return float((self._weights * losses).mean())

    def patch(self, name: str, point: np.ndarray) -> Patch:
        """The patch at a point, its value fitted once more."""
        circle, effects = _unpacked(name, point)
        inside = self._touched(circle)
        start, losses = (*self.search.known, *effects), self.before.copy()
        there = self.search.predictions.on(circle, inside)
        fit = fit_effects(there, [start], self.search.scale[inside], free=len(self.search.known))
        losses[inside] = fit.loss
        return Patch(Area(inside, circle), fit.effects, losses)


def _weights(losses: np.ndarray) -> np.ndarray:
    """Weights ``[W]`` of windows by which a mean over a few of them stands for the mean over all; 0 for the others."""
    largest, others = np.split(np.argsort(-losses), [_WINDOWS[0]])
    picked = np.sort(others)[
        np.unique(np.linspace(0, max(len(others) - 1, 0), _WINDOWS[1]).round().astype(int))[: len(others)]
    ]
    weights = np.zeros(len(losses))
    weights[largest] = 1.0
    weights[picked] = len(others) / max(len(picked), 1)
    return weights


def _unpacked(name: str, point: np.ndarray) -> tuple[Circle, Effects]:
    x, y, radius, value = float(point[0]), float(point[1]), float(np.exp(point[2])), float(np.exp(point[3]))
    parameter = next(p for p in CATALOGUE[name].parameters if p.name == CATALOGUE[name].identified[0])
    return Circle(x, y, radius), ((name, {parameter.name: float(np.clip(value, parameter.low, parameter.high))}),)
