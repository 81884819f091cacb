"""Distribution: where a setting of a world is drawn from, and how a user narrows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np


class Distribution(Protocol):
    """A distribution that uses exactly one random number per draw.

    So a narrowed setting leaves every other draw of its stream as it was.
    """

    def draw(self, random: np.random.Generator) -> float | int | bool | str:
        """A random value."""
        ...

    def narrowed(self, text: str) -> Distribution:
        """The distribution restricted to ``VALUE`` or ``LOW..HIGH``; raises a ``ValueError`` outside its range."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Numbers between two bounds, evenly distributed; equal bounds fix the number."""

    low: float
    high: float

    def __post_init__(self):
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ValueError(f"got {self.low:g}..{self.high:g}, expected ascending finite numbers")

    def draw(self, random: np.random.Generator) -> float:
        """A number."""
        return self.low + (self.high - self.low) * float(random.random())

    def narrowed(self, text: str) -> Uniform:
        """See :class:`Distribution`."""
        return replace(self, **_bounds(text, self.low, self.high))


@dataclass(frozen=True)
class LogUniform(Uniform):
    """Positive numbers whose logarithm is evenly distributed: small values are as frequent as large ones."""

    def __post_init__(self):
        super().__post_init__()
        if not self.low > 0.0:
            raise ValueError(f"got {self.low:g}..{self.high:g}, expected positive numbers")

    def draw(self, random: np.random.Generator) -> float:
        """A number."""
        return self.low * (self.high / self.low) ** float(random.random())


@dataclass(frozen=True)
class Whole:
    """Whole numbers between two bounds, both included."""

    low: int
    high: int

    def __post_init__(self):
        if self.low > self.high:
            raise ValueError(f"got {self.low}..{self.high}, expected ascending whole numbers")

    def draw(self, random: np.random.Generator) -> int:
        """A number."""
        return self.low + int(random.random() * (self.high - self.low + 1))

    def narrowed(self, text: str) -> Whole:
        """See :class:`Distribution`."""
        bounds = _bounds(text, self.low, self.high)
        if any(value != round(value) for value in bounds.values()):
            raise ValueError(f"got {text!r}, expected whole numbers")
        return Whole(int(bounds["low"]), int(bounds["high"]))


@dataclass(frozen=True)
class Chance:
    """True with a probability; 0 and 1 fix it."""

    probability: float

    def __post_init__(self):
        if not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"got {self.probability}, expected a probability")

    def draw(self, random: np.random.Generator) -> bool:
        """Whether it happens."""
        return float(random.random()) < self.probability

    def narrowed(self, text: str) -> Chance:
        """See :class:`Distribution`; ``true``, ``false`` or a probability."""
        words = {"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0}
        if text.lower() in words:
            return Chance(words[text.lower()])
        return Chance(_number(text))


@dataclass(frozen=True)
class Choice:
    """One of several names; equally likely without weights."""

    names: tuple[str, ...]
    weights: tuple[float, ...] = ()

    def __post_init__(self):
        if not self.names or (self.weights and len(self.weights) != len(self.names)):
            raise ValueError(f"got {self.names} with weights {self.weights}, expected one weight for each name")

    def draw(self, random: np.random.Generator) -> str:
        """A name."""
        weights = np.array(self.weights or [1.0] * len(self.names))
        limits = np.cumsum(weights) / weights.sum()
        return self.names[min(int(np.searchsorted(limits, random.random(), side="right")), len(self.names) - 1)]

    def narrowed(self, text: str) -> Choice:
        """See :class:`Distribution`; names separated by commas."""
        chosen = tuple(part.strip() for part in text.split(","))
        unknown = [name for name in chosen if name not in self.names]
        if unknown:
            raise ValueError(f"got {', '.join(unknown)!r}, expected some of {', '.join(self.names)}")
        kept = dict(zip(self.names, self.weights, strict=True)) if self.weights else {}
        return Choice(chosen, tuple(kept[name] for name in chosen) if kept else ())


def _bounds(text: str, low: float, high: float) -> dict[str, float]:
    parts: Sequence[str] = text.split("..")
    if len(parts) > 2:
        raise ValueError(f"got {text!r}, expected VALUE or LOW..HIGH")
    first, last = _number(parts[0]), _number(parts[-1])
    if not low <= first <= last <= high:
        raise ValueError(f"got {text!r}, expected values within {low:g}..{high:g}")
    return {"low": first, "high": last}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"got {text!r}, expected a number") from None
