"""Time alignment: match measurements by their stamps, and estimate the delay between two signals."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

Delayed = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Delay [s] → the delayed signal at the times of a reference ``[n]``, and the mask ``[n]`` of its known samples."""


def nearest_stamp(stamps: np.ndarray, stamp: int, *, limit: float = np.inf) -> int | None:
    """Index of the measurement nearest in time; None if none lies within the limit.

    Args:
        stamps: times of the measurements, ascending ``[n]`` [ns].
        stamp: query time [ns].
        limit: largest time difference [s].
    """
    if not len(stamps):
        return None
    after = int(np.searchsorted(stamps, stamp))
    around = [index for index in (after - 1, after) if 0 <= index < len(stamps)]
    best = min(around, key=lambda index: abs(int(stamps[index]) - stamp))
    return best if abs(int(stamps[best]) - stamp) <= limit * 1e9 else None


def largest_spread(slop: float, intervals: Iterable[float]) -> float:
    """Largest difference between the stamps of one set of sensor data [s].

    A measurement that is older than the others by more than half the slowest sensor's interval belongs to the previous
    set: cameras that are triggered together must not be combined across triggers.

    Args:
        slop: upper bound set by the user [s].
        intervals: time between consecutive messages of each sensor with a known rate [s].
    """
    slowest = max(intervals, default=np.inf)
    return min(slop, 0.5 * slowest)


@dataclass(frozen=True)
class DelayCorrelation:
    """Correlation of two signals as a function of the delay between them, stored per piece of the recording."""

    lags: np.ndarray
    """Tested delays, equally spaced ``[L]`` [s]."""
    products: np.ndarray
    """Inner products of the two signals ``[pieces, L]``."""
    energies: np.ndarray
    """Inner product of each signal with itself ``[pieces, 2, L]``."""

    @classmethod
    def of(cls, pieces: Iterable[tuple[np.ndarray, Delayed]], lags: np.ndarray, *, fewest: int = 1) -> DelayCorrelation:
        """Correlate pieces of a reference signal with another signal at every delay.

        Args:
            pieces: values of the reference ``[n]`` and the other signal as a function of the delay.
            lags: delays to test, equally spaced [s].
            fewest: smallest number of known samples; a piece is ignored at delays with fewer.
        """
        products, energies = [], []
        for values, delayed in pieces:
            product, energy = np.zeros(len(lags)), np.zeros((2, len(lags)))
            for index, lag in enumerate(lags):
                other, known = delayed(float(lag))
                if known.sum() < fewest:
                    continue
                one, two = values[known], other[known]
                product[index], energy[:, index] = one @ two, (one @ one, two @ two)
            products.append(product)
            energies.append(energy)
        return cls(lags, np.array(products).reshape(-1, len(lags)), np.array(energies).reshape(-1, 2, len(lags)))

    def __len__(self) -> int:
        return len(self.products)

    @property
    def values(self) -> np.ndarray:
        """Correlation at each delay, -1 to 1 ``[L]``; zero without known samples."""
        return _normalised(self.products.sum(axis=0), self.energies.sum(axis=0))

    @property
    def strongest(self) -> int:
        """Index of the delay with the largest absolute correlation."""
        return int(np.argmax(np.abs(self.values)))

    def peak(self, around: int) -> float:
        """Delay of the strongest correlation near an index, refined by a parabola through three values [s]."""
        return self._peak(self.values, around, self._sign(around))

    def peak_without_each(self, around: int) -> np.ndarray:
        """Peak delay with each piece left out in turn, for a jackknife ``[pieces]`` [s]."""
        product, energy = self.products.sum(axis=0), self.energies.sum(axis=0)
        sign = self._sign(around)
        return np.array(
            [
                self._peak(_normalised(product - p, energy - e), around, sign)
                for p, e in zip(self.products, self.energies, strict=True)
            ]
        )

    def _sign(self, around: int) -> float:
        return float(np.sign(self.values[around]))

    def _peak(self, values: np.ndarray, around: int, sign: float) -> float:
        values = sign * values
        low, high = max(1, around - 10), min(len(values) - 1, around + 11)
        top = low + int(np.argmax(values[low:high]))
        if not 0 < top < len(values) - 1:
            return float(self.lags[top])
        left, middle, right = values[top - 1 : top + 2]
        curvature = left - 2 * middle + right
        shift = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
        return float(self.lags[top] + np.clip(shift, -1.0, 1.0) * (self.lags[1] - self.lags[0]))


def _normalised(products: np.ndarray, energies: np.ndarray) -> np.ndarray:
    """Correlation at each delay ``[L]`` from ``products`` ``[L]`` and ``energies`` ``[2, L]``."""
    return products / np.sqrt(np.maximum(energies.prod(axis=0), 1e-12))
