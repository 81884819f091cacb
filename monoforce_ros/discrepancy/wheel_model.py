"""Wheel model: effects of the drives with their values, and the wheel speeds that they make of commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.discrepancy.wheel_blocks import WheelBlocks
from monoforce_ros.effects import CATALOGUE, Fastest, WheelResponse, wheel_effects


@dataclass(frozen=True)
class WheelModel:
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


def response_of(name: str) -> WheelResponse:
    """What an effect does to wheel speeds."""
    response = CATALOGUE[name].wheel_response
    assert response is not None, name
    return response


def keys_of(name: str) -> tuple[str, ...]:
    """Parameters of an effect that a fit changes, the one that says how large it is first."""
    response = response_of(name)
    return (response.parameter, *response.further)


def neutral_of(name: str) -> float:
    """Value without effect of the parameter that says how large an effect is."""
    return next(p.neutral for p in CATALOGUE[name].parameters if p.name == response_of(name).parameter)


def in_order(names: Sequence[str]) -> tuple[str, ...]:
    """Names of effects in the order in which they act on a command."""
    return tuple(effect.name for effect in wheel_effects() if effect.name in names)


def by_effect(names: Sequence[str], values: np.ndarray) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Values ``[P]`` of the parameters of each effect."""
    for name, columns in _columns(names):
        yield name, tuple(float(value) for value in values[columns])


def named(names: Sequence[str], values: np.ndarray) -> Effects:
    """Values ``[P]`` of the parameters of each effect, by their names."""
    return tuple((name, dict(zip(keys_of(name), own, strict=True))) for name, own in by_effect(names, values))


def bounds_of(names: Sequence[str], fastest: Fastest) -> np.ndarray:
    """Bounds of a fit ``[P, 2]``: values that the catalogue allows, for they become initial values of other fits."""
    bounds = []
    for name in names:
        response, known = response_of(name), {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
        main = known[response.parameter]
        low, high = (float(np.clip(end, main.low, main.high)) for end in response.bounds(fastest))
        bounds.append((low, max(high, low + 1e-3)))
        bounds += [(known[key].low, known[key].high) for key in response.further]
    return np.array(bounds).reshape(-1, 2)


def modelled(
    names: Sequence[str], values: np.ndarray, blocks: WheelBlocks, changes: np.ndarray | None = None
) -> np.ndarray:
    """Speeds ``[1, n, 2, T]`` [m/s] of wheels that follow the commands under effects: those on the twist act first.

    Args:
        names: effects.
        values: of their parameters, ``[P]``, or ``[n, P]`` where those of the blocks differ.
        blocks: the commands.
        changes: of the values, ``[P]`` or ``[n, P]``. With these the result is ``[1 + P, n, 2, T]``: first without
            any, then with each of the parameters changed alone. One call of an effect serves all of them.
    """
    own = np.broadcast_to(values, (len(blocks), np.shape(values)[-1]))
    ordered = sorted(_columns(names), key=lambda entry: not response_of(entry[0]).of_twist)
    signal, sides, computed = blocks.twists[None], False, [0]
    for name, columns in ordered:
        response = response_of(name)
        if not response.of_twist and not sides:
            signal, sides = blocks.commanded(signal), True
        parameters = range(columns.start, columns.stop)
        rows = np.repeat(own[None, :, columns], len(signal), axis=0)
        if changes is not None:
            changed = np.repeat(own[None, :, columns], len(parameters), axis=0)
            for number, parameter in enumerate(parameters):
                changed[number, :, number] += changes[..., parameter]
            rows = np.concatenate([rows, changed])
            signal = np.concatenate([signal, np.repeat(signal[:1], len(parameters), axis=0)])
            computed += [1 + parameter for parameter in parameters]
        further = (blocks.step, blocks.times) if response.of_time else (blocks.step,)
        signal = response.speeds(signal, *np.moveaxis(rows, -1, 0)[..., None, None], *further)
    signal = signal if sides else blocks.commanded(signal)
    return signal[np.argsort(computed)]


def residuals(
    names: Sequence[str], values: np.ndarray, blocks: WheelBlocks, changes: np.ndarray | None = None
) -> np.ndarray:
    """Measured minus modelled speed ``[1 or 1 + P, n, 2, K]`` [m/s], see :func:`modelled`; zero without sample."""
    return (blocks.measured - blocks.at_samples(modelled(names, values, blocks, changes))) * blocks.pairs


def block_losses(names: Sequence[str], values: np.ndarray, blocks: WheelBlocks, top: float) -> np.ndarray:
    """Sum of squared errors of each block ``[n]``, each clipped so that a few outliers do not decide."""
    return np.minimum(residuals(names, values, blocks)[0] ** 2, (0.5 * top) ** 2).sum(axis=(1, 2))


def _columns(names: Sequence[str]) -> list[tuple[str, slice]]:
    """Effects, and where their values are among those of all."""
    at, found = 0, []
    for name in names:
        count = len(keys_of(name))
        found.append((name, slice(at, at + count)))
        at += count
    return found
