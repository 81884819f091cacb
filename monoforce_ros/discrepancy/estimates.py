"""Estimates: effects that a recording identifies, each parameter with its confidence interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class ParameterEstimate:
    """The value of one parameter and its 95 % confidence interval."""

    value: float
    low: float
    high: float
    unit: str

    def holds(self, value: float) -> bool:
        """Whether the interval contains a value."""
        return self.low <= value <= self.high

    def with_half_width(self, half_width: float) -> ParameterEstimate:
        """The same value with a symmetric interval."""
        return replace(self, low=self.value - half_width, high=self.value + half_width)

    def shifted(self, amount: float) -> ParameterEstimate:
        """Value and interval, all of them larger by an amount."""
        return replace(self, value=self.value + amount, low=self.low + amount, high=self.high + amount)


@dataclass(frozen=True)
class EffectEstimate:
    """An effect that was identified."""

    name: str
    parameters: Mapping[str, ParameterEstimate]
    indistinguishable: tuple[str, ...] = ()
    """Other effects that explain the recording about as well in its place."""
    products: Mapping[str, ParameterEstimate] = field(default_factory=dict)
    """Products and sums of two of its parameters, see :class:`~monoforce_ros.effects.effect.Product`."""
    found_again: tuple[int, int] | None = None
    """In how many of how many repetitions, each without another part of the recording, it or one of these others is
    found; None for a recording too short for that, and for a formula."""

    named_otherwise: tuple[str, ...] = ()
    """Other effects that repetitions name in its place, where fewer than half of them find it: together with it they
    are one class, whose name changes with the part of the recording."""

    in_file: Mapping[str, float] = field(default_factory=dict)
    """Values of the same effect in the robot's file, which take the place of the neutral ones."""

    @property
    def shown(self) -> Mapping[str, ParameterEstimate]:
        """What people are shown: parameters, then products."""
        return {**self.parameters, **self.products}


def beyond_file(estimates: Sequence[EffectEstimate], robot: RobotModel) -> tuple[EffectEstimate, ...]:
    """Estimates beside what the robot's file says of the same effects.

    Recordings are corrected for the file's sensor and clock errors before a search: what it finds adds to them. Values
    of other effects replace the file's.
    """
    own, result = dict(robot.effects), []
    for estimate in estimates:
        in_file = {key: float(value) for key, value in own.get(estimate.name, {}).items()}
        if in_file and CATALOGUE[estimate.name].stage == "measurement":
            shifted = {key: value.shifted(in_file.get(key, 0.0)) for key, value in estimate.parameters.items()}
            estimate = replace(estimate, parameters=shifted)
        result.append(replace(estimate, in_file=in_file))
    return tuple(result)


def effect_sizes(name: str, values: Mapping[str, float], without: np.ndarray) -> np.ndarray:
    """Size of an effect in the unit of each of its parameters, ``[P]``.

    It is the distance of all parameters of that unit from their values without the effect. A limit has no distance from
    its absence: its size is its own value.
    """
    units = {parameter.name: parameter.unit for parameter in CATALOGUE[name].parameters}
    unit = np.array([units[key] for key in values])
    found = np.array(list(values.values()), float)
    away = np.where(np.isfinite(without), found - without, found)
    return np.array([np.linalg.norm(away[unit == same]) for same in unit])
