"""Wheels: how the drives follow commands, by measured wheel speeds and so independent of the ground."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.effects import CATALOGUE, WheelResponse, wheel_effects
from monoforce_ros.robots import RobotModel

_Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Commanded speeds with history ``[2, T]`` [m/s], measured speeds ``[2, n]``, and their indices in T ``[n]``."""
_STEP = 0.02
_HISTORY = 2.0
_LONGEST_GAP = 1.0
_BLOCK = 6.0
_MOST = 1500
"""Samples of each side that are used at most."""
_BETTER = 0.08
"""Share of the squared error on held-out blocks that a model with one more effect must remove."""
_LARGEST_MODEL = 3
"""Largest number of effects in a wheel model."""


@dataclass(frozen=True)
class WheelFinding:
    """How the drives follow commands."""

    effects: Effects
    """One parameter each, in the order in which they act on a command; empty where the wheels follow the commands."""
    half_widths: tuple[float, ...]
    """Half-width of each parameter's 95 % confidence interval."""
    error_before: float
    """RMS of measured minus commanded wheel speed [m/s], at the best constant ratio of the two."""
    error_after: float
    ratio: float
    """Measured speed [rad/s] over commanded [m/s]: one over the wheel's radius."""

    def summary(self) -> str:
        """One sentence for reports."""
        parts = [_response(name).wording.format(next(iter(values.values()))) for name, values in self.effects]
        return "the measured wheel speeds follow the commands " + ", ".join(parts or ["without delay or limit"])


def compare_with_wheels(commands: CommandTrack, wheels: WheelTrack | None, robot: RobotModel) -> WheelFinding | None:
    """How measured wheel speeds follow commands; None without wheel speeds, or where they do not follow at all.

    Dead time, dead band, saturation and lag are fitted to both sides in every sensible combination on every other block
    of the recording; of the combinations that predict the held-out blocks well the smallest is selected.
    """
    if wheels is None or len(wheels) < 100 or not len(commands):
        return None
    pieces = _pieces(commands, wheels, robot)
    if not pieces:
        return None
    top = float(
        np.quantile(np.concatenate([np.abs(commanded[:, index]).max(axis=1) for commanded, _, index in pieces]), 0.995)
    )
    if top < 0.1:
        return None
    ratio = _ratio(pieces, top)
    if ratio is not None and robot.wheel_radius is not None and 0.4 < ratio * robot.wheel_radius < 2.5:
        # Use the known radius if the ratio is plausible, so that a drive that is too slow appears as an error.
        ratio = 1.0 / robot.wheel_radius
    if len(pieces) < 2 or ratio is None:
        return None
    pieces = [(commanded, speeds / ratio, index) for commanded, speeds, index in pieces]
    block = np.arange(len(pieces)) % 2
    scores: dict[tuple[str, ...], tuple[float, np.ndarray, np.ndarray]] = {}
    for names in _models():
        loss, fits = 0.0, []
        for held_out in (0, 1):
            fitted = [piece for piece, number in zip(pieces, block, strict=True) if number != held_out]
            judged = [piece for piece, number in zip(pieces, block, strict=True) if number == held_out]
            fit = _fit(names, fitted, top)
            fits.append(fit)
            loss += float(np.minimum(_residuals(fit, names, judged) ** 2, (0.5 * top) ** 2).sum())
        scores[names] = (loss, np.mean(fits, axis=0), np.abs(fits[0] - fits[1]))
    baseline_loss = scores[()][0]
    best: tuple[str, ...] = ()
    for size in range(1, _LARGEST_MODEL + 1):
        found = min((names for names in scores if len(names) == size), key=lambda names: scores[names][0], default=None)
        if found is not None and scores[found][0] < (1.0 - _BETTER) * scores[best][0]:
            best = found
    effects, half_widths = [], []
    for name, value, spread in zip(best, *scores[best][1:], strict=True):
        response = _response(name)
        if response.counts(float(value), top):
            effects.append((name, {response.parameter: float(value)}))
            # The difference of both folds is √2 times the error of each.
            half_widths.append(float(max(1.4 * spread, 0.02 * value)))
    count = sum(len(index) for _, _, index in pieces) * 2
    spreads = [
        float(np.var(np.concatenate([values.ravel() for values in side])))
        for side in ([speeds for _, speeds, _ in pieces], [commanded[:, index] for commanded, _, index in pieces])
    ]
    if scores[best][0] / count > 0.5 * min(spreads):
        # The wheels do not follow the commands.
        return None
    return WheelFinding(
        tuple(effects),
        tuple(half_widths),
        float(np.sqrt(baseline_loss / count)),
        float(np.sqrt(scores[best][0] / count)),
        ratio,
    )


def _ratio(pieces: list[_Piece], top: float) -> float | None:
    """Measured [rad/s] over commanded speed [m/s] where a command of medium size was constant for a while."""
    settled = round(1.5 / _STEP)
    ratios = []
    for commanded, speeds, index in pieces:
        for side in range(2):
            for place, measured in zip(index, speeds[side], strict=True):
                recent = commanded[side, max(0, place - settled) : place + 1]
                if np.ptp(recent) < 0.02 * top and 0.1 * top < abs(recent[-1]) < 0.6 * top:
                    ratios.append(measured / recent[-1])
    if len(ratios) < 20:
        commanded = np.concatenate([commanded[:, index].ravel() for commanded, _, index in pieces])
        measured = np.concatenate([speeds.ravel() for _, speeds, _ in pieces])
        ratio = float(commanded @ measured) / max(float(commanded @ commanded), 1e-9)
    else:
        ratio = float(np.median(ratios))
    return ratio if ratio > 0.1 else None


def _pieces(commands: CommandTrack, wheels: WheelTrack, robot: RobotModel) -> list[_Piece]:
    """The recording in blocks of about ``_BLOCK``, each with the commands before it."""
    every = max(1, -(-len(wheels) // _MOST))
    stamps, speeds = wheels.stamps[::every], wheels.speeds[::every]
    half = 0.5 * float((robot.drive_offsets.max() - robot.drive_offsets.min()).abs())
    breaks = np.flatnonzero(np.diff(stamps) > _LONGEST_GAP * 1e9) + 1
    pieces = []
    for run in np.split(np.arange(len(stamps)), breaks):
        if len(run) < 10:
            continue
        length = (stamps[run[-1]] - stamps[run[0]]) * 1e-9
        for part in np.array_split(run, max(1, round(length / _BLOCK))):
            if len(part) < 10:
                continue
            first = int(stamps[part[0]]) - round(_HISTORY * 1e9)
            count = round((int(stamps[part[-1]]) - first) * 1e-9 / _STEP) + 1
            twists = commands.sample(first + np.rint(np.arange(count) * _STEP * 1e9).astype(np.int64))
            commanded = np.stack([twists[:, 0] - half * twists[:, 1], twists[:, 0] + half * twists[:, 1]])
            index = np.rint((stamps[part] - first) * 1e-9 / _STEP).astype(int)
            pieces.append((commanded, speeds[part].T, index))
    return pieces


def _response(name: str) -> WheelResponse:
    response = CATALOGUE[name].wheel_response
    assert response is not None, name
    return response


def _models() -> list[tuple[str, ...]]:
    """Sets of effects that wheel speeds reveal, each in the order in which they act on a command."""
    names = [effect.name for effect in wheel_effects()]
    return [
        chosen
        for size in range(_LARGEST_MODEL + 1)
        for chosen in itertools.combinations(names, size)
        if not any(other in _response(name).excludes for name in chosen for other in chosen)
    ]


def _model(values: np.ndarray, names: tuple[str, ...], commanded: np.ndarray) -> np.ndarray:
    """Speeds ``[2, T]`` of the wheels that follow commanded ones under effects."""
    for name, value in zip(names, values, strict=True):
        commanded = _response(name).speeds(commanded, float(value), _STEP)
    return commanded


def _residuals(values: np.ndarray, names: tuple[str, ...], pieces: list[_Piece]) -> np.ndarray:
    """Measured minus modelled speed of all samples of both sides [m/s]."""
    return np.concatenate(
        [(speeds - _model(values, names, commanded)[:, index]).ravel() for commanded, speeds, index in pieces]
    )


def _fit(names: tuple[str, ...], pieces: list[_Piece], top: float) -> np.ndarray:
    """Parameters by robust least squares from a few starts."""
    if not names:
        return np.zeros(0)
    starts = {name: _response(name).starts(top) for name in names}
    bounds = np.array([_response(name).bounds(top) for name in names])
    best, cost = np.zeros(len(names)), np.inf
    for number in range(max(len(starts[name]) for name in names)):
        start = [starts[name][number % len(starts[name])] for name in names]
        fit = least_squares(
            _residuals, start, args=(names, pieces), loss="soft_l1", f_scale=0.05 * top, diff_step=1e-2, max_nfev=20,
            bounds=(bounds[:, 0], bounds[:, 1]),
        )  # fmt: skip
        if fit.cost < cost:
            best, cost = fit.x, fit.cost
    return best
