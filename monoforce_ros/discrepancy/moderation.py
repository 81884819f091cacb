"""Moderation: many variances, each estimated with few degrees of freedom, share what they have in common.

Empirical Bayes (Smyth 2004): the true variances scatter about a common one by a scaled inverse chi-squared
distribution, so that the estimates follow a scaled F distribution. Its location and its degrees of freedom are matched
by the quartiles of all estimates, which a few far larger ones do not move (compare Phipson et al. 2016). Each estimate
is then averaged with the common variance, and gains the prior's degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import f as f_distribution

_FEWEST_DEGREES = 0.5
"""Of the prior, where the equation for them has no smaller solution: variances that differ by more tell nothing of each
other, and the prior then weighs half as much as a single segment."""
_SOURCES = 3
"""The prior rests on the same segments as the variances themselves. It cannot have more degrees of freedom than as many
independent residuals have: three, along, across and heading."""


@dataclass(frozen=True)
class VariancePrior:
    """What variances have in common."""

    variance: float
    degrees: float

    @classmethod
    def of(cls, variances: Sequence[float], degrees: float) -> VariancePrior:
        """The prior of variances that were estimated with ``degrees`` of freedom each.

        Args:
            variances: those that are 0 say nothing and are left out.
            degrees: of freedom of each, positive.
        """
        used = np.array([value for value in variances if value > 0.0])
        if not len(used):
            return cls(0.0, 0.0)
        low, middle, high = np.log(np.quantile(used, (0.25, 0.5, 0.75)))

        def excess(prior: float) -> float:
            """Distance of the quartiles of all estimates beyond that with a prior of so many degrees of freedom."""
            lower, upper = f_distribution.ppf((0.25, 0.75), degrees, prior)
            return float(high - low - np.log(upper / lower))

        most = _SOURCES * degrees
        if excess(most) <= 0.0:
            prior = most
        elif excess(_FEWEST_DEGREES) >= 0.0:
            prior = _FEWEST_DEGREES
        else:
            prior = float(brentq(excess, _FEWEST_DEGREES, most))
        return cls(float(np.exp(middle) / f_distribution.ppf(0.5, degrees, prior)), prior)

    def moderated(self, variance: float | None, degrees: float) -> tuple[float, float]:
        """A variance with its degrees of freedom, averaged with the prior; of an unknown one (None) the prior's."""
        if variance is None:
            return self.variance, self.degrees
        total = self.degrees + degrees
        return (self.degrees * self.variance + degrees * variance) / max(total, 1e-9), total
