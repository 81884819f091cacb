"""Natural cubic smoothing splines at many curvature weights: the factors that do not depend on the weight are kept."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded


class NaturalSplines:
    """Natural cubic smoothing splines through values at the same times (Reinsch 1967).

    Of all curves ``g`` such a spline has the smallest ``Σ (y - g)² + λ ∫ g''²``, like SciPy's
    ``make_smoothing_spline``, which assembles its matrices in Python for every weight λ. Here a weight costs one banded
    system for the second derivatives ``γ`` at the inner times: ``(R + λ QᵀQ) γ = Qᵀy``, ``g = y - λ Q γ``.

    Args:
        times: increasing, at least four, ``[n]`` [s].
    """

    def __init__(self, times: np.ndarray):
        self._times, self._steps = times, np.diff(times)
        before, after = 1.0 / self._steps[:-1], 1.0 / self._steps[1:]
        self._columns = np.stack([before, -before - after, after])
        """Of Q: its entries in the rows before, at and after each inner time, ``[3, n - 2]``."""
        low, middle, high = self._columns
        self._stiffness = np.zeros((3, len(low)))
        self._stiffness[2] = low**2 + middle**2 + high**2
        self._stiffness[1, 1:] = middle[:-1] * low[1:] + high[:-1] * middle[1:]
        self._stiffness[0, 2:] = high[:-2] * low[2:]
        self._mass = np.zeros_like(self._stiffness)
        self._mass[2] = (self._steps[:-1] + self._steps[1:]) / 3.0
        self._mass[1, 1:] = self._steps[1:-1] / 6.0

    def fitted(self, values: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
        """Values and second derivatives of the spline at the times, ``[n]`` each."""
        low, middle, high = self._columns
        bent = low * values[:-2] + middle * values[1:-1] + high * values[2:]
        inner = solveh_banded(self._mass + weight * self._stiffness, bent, check_finite=False)
        curvatures = np.r_[0.0, inner, 0.0]
        moved = np.zeros_like(values)
        moved[:-2] += low * inner
        moved[1:-1] += middle * inner
        moved[2:] += high * inner
        return values - weight * moved, curvatures

    def between(self, values: np.ndarray, weight: float, at: np.ndarray) -> np.ndarray:
        """The spline at other times within the range, ``[m]``."""
        curve, curvatures = self.fitted(values, weight)
        left = np.clip(np.searchsorted(self._times, at, side="right") - 1, 0, len(self._steps) - 1)
        step = self._steps[left]
        share = (at - self._times[left]) / step
        rest = 1.0 - share
        cubic = (rest**3 - rest) * curvatures[left] + (share**3 - share) * curvatures[left + 1]
        return rest * curve[left] + share * curve[left + 1] + step**2 / 6.0 * cubic
