"""Left out: the values of a fit without each part of its recording.

Fitting anew without each of many parts costs as many fits. A part moves the values little, so that one Gauss-Newton
step from the fit to the whole recording suffices (the infinitesimal jackknife with the exact curvature of what remains;
Rad and Maleki 2020, "approximate leave-one-out"). The step undoes the pull of the part that is left out, not the whole
remaining gradient: where a fit ended before its minimum, or at a bound, that one does not vanish, and would carry all
parts the same way far beyond where the fit is linear. What a part alone shows cannot be known without it: a weak prior
then draws the values to where they would be without the effect.
"""

from __future__ import annotations

import numpy as np

from monoforce_ros.discrepancy.fit import Fit, flat, robust_weights, with_values
from monoforce_ros.discrepancy.hypothesis import Effects

_PRIOR = 0.01
"""Weight of the prior, as a share of what the whole recording says: without it a step has no bound where the part that
is left out is all there is."""


def values_without_parts(
    fit: Fit, parts: np.ndarray, ends: np.ndarray, count: int, unchanged: np.ndarray, typical: np.ndarray
) -> tuple[Effects, ...]:
    """Effects with the values that a fit has without each part.

    Args:
        fit: to the whole recording.
        parts: number of the part in which each window starts, ``[W]``.
        ends: number of the part in which it ends, ``[W]``: a window that reaches into a part shares its motion.
        count: number of parts; those without windows keep the values of the fit.
        unchanged: values of all parameters without the effects, ``[P]``, not finite where there is none.
        typical: distance of each from that, ``[P]``.
    """
    if fit.derivatives is None or fit.residual is None:
        return (fit.effects,) * count
    fixed = len(flat(fit.effects)) - len(fit.derivatives)
    typical, values = typical[fixed:], flat(fit.effects)
    away = np.nan_to_num((values - unchanged)[fixed:] / typical, nan=0.0, posinf=0.0, neginf=0.0)
    residual = np.nan_to_num(fit.residual)
    weights = robust_weights(residual)
    curvature = np.einsum("pwkc,wkc,qwkc->wpq", fit.derivatives, weights, fit.derivatives)
    gradient = np.einsum("pwkc,wkc->wp", fit.derivatives, weights * residual)
    whole = np.diag(np.diag(curvature.sum(axis=0)))
    whole += 1e-6 * np.trace(whole) * np.eye(len(whole)) + 1e-9 * np.eye(len(whole))
    found = []
    for part in range(count):
        kept = (parts != part) & (ends != part)
        if kept.all():
            found.append(fit.effects)
            continue
        step = np.linalg.solve(
            curvature[kept].sum(axis=0) + _PRIOR * whole, _PRIOR * whole @ away - gradient[~kept].sum(axis=0)
        )
        moved = values.copy()
        moved[fixed:] -= typical * step
        found.append(with_values(fit.effects, moved))
    return tuple(found)
