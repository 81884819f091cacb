"""Fit: parameters of effects, fitted to a recording by robust least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_distribution

from monoforce_ros.core import huber
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.evidence import MOTION, EvidenceWindows
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.discrepancy.score_test import block_numbers, motion_count
from monoforce_ros.effects import CATALOGUE, Effect, Parameter
from monoforce_ros.robots import RobotModel

OUTLIER = 3.0
"""Scaled residuals beyond this are weighted linearly instead of quadratically."""
_DAMPINGS = (1e-3, 1e-1, 3.0)
"""Shares of the diagonal of the normal equations (Marquardt 1963): hardly any, and more where that step fails. They
change how many steps a fit takes, not where it ends."""
_FARTHEST = 0.5
"""Longest step of a parameter in units of its typical size, where longer ones fail: a limit that hardly acts has hardly
a derivative, and an enormous step."""
_NOT_FINITE = 1e3
"""Scaled residual assumed for a prediction that is not finite."""
_BLOCK = 4.0
"""Length of blocks that are assumed to be independent [s]."""


@dataclass(frozen=True)
class Fit:
    """Fitted effects, their loss and their covariance."""

    effects: Effects
    loss: np.ndarray
    """Robust loss of each window, ``[W]``."""
    covariance: np.ndarray
    """Of the parameters in their order, ``[P, P]``."""
    derivatives: np.ndarray | None = None
    """Of the scaled residuals by each parameter that was fitted, in units of its typical size, ``[P, W, K, 3]``."""
    blocks: int = 0
    """Number of blocks from whose scores the covariance follows."""
    residual: np.ndarray | None = None
    """Scaled residuals with the fitted values, ``[W, K, 3]``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(name for name, _ in self.effects)


def robust(scaled: np.ndarray) -> np.ndarray:
    """Huber loss of scaled residuals ``[..., W, K, C]``, averaged over each window, ``[..., W]``.

    It is a mean over the components of the motion. Roll, pitch, height and their rates add to it, so that they do not
    dilute what the motion shows. A prediction that is not finite gets a large residual.
    """
    losses = np.minimum(huber(np.nan_to_num(scaled, nan=_NOT_FINITE), OUTLIER), 1e6)
    return losses.mean(axis=-2).sum(axis=-1) / len(MOTION)


def robust_weights(scaled: np.ndarray) -> np.ndarray:
    """Weights by which least squares have the derivative of the Huber loss of scaled residuals."""
    return np.minimum(1.0, OUTLIER / np.maximum(np.abs(np.nan_to_num(scaled)), 1e-9))


def flat(effects: Effects) -> np.ndarray:
    """Values of all parameters as one vector ``[P]``."""
    return np.array([float(value) for _, parameters in effects for value in parameters.values()])


def _parameters(effects: Effects) -> list[Parameter]:
    """The catalogue's parameters of the values in :func:`flat`."""
    known = {name: {parameter.name: parameter for parameter in CATALOGUE[name].parameters} for name, _ in effects}
    return [known[name][key] for name, values in effects for key in values]


def with_values(effects: Effects, values: np.ndarray) -> Effects:
    """The same effects with other values, kept within their bounds."""
    listed = _parameters(effects)
    bounded = iter(np.clip(values, [p.low for p in listed], [p.high for p in listed]).tolist())
    return tuple((name, {key: next(bounded) for key in parameters}) for name, parameters in effects)


def neutral_values(effects: Effects) -> np.ndarray:
    """Neutral values of the effects, ``[P]``."""
    return np.array([parameter.neutral for parameter in _parameters(effects)])


def scales(effects: Effects, robot: RobotModel) -> np.ndarray:
    """Typical distance of each parameter from its neutral value on a robot, ``[P]``."""
    return np.array([parameter.typical(robot) for parameter in _parameters(effects)])


def without(effects: Effects, name: str) -> Effects:
    """The effects except the one named."""
    return tuple(entry for entry in effects if entry[0] != name)


def fit_effects(
    predictions: Predictions,
    starts: Sequence[Effects],
    scale: np.ndarray,
    *,
    iterations: int = 8,
    free: int = 0,
    prior: float = 0.0,
) -> Fit:
    """Robust Levenberg-Marquardt from the best of several starts.

    Args:
        predictions: predictions for the recording's windows.
        starts: the same effects with different initial values.
        scale: expected size of a residual, ``[K, 3]``.
        iterations: largest number.
        free: index of the first effect that is fitted; earlier ones keep their values.
        prior: weight, relative to the mean loss, of half the squared distance of each parameter from neutral in units
            of its typical distance; parameters that the recording hardly constrains then stay near neutral.
    """
    neutral = neutral_values(starts[0])

    def distance(effects: Effects) -> np.ndarray:
        # Limits are infinite where they do nothing: no value of theirs is nearer to that than another.
        away = (flat(effects) - neutral) / scales(effects, predictions.robot)
        return np.where(np.isfinite(away), away, 0.0)

    def total(hypotheses: Sequence[Effects], scaled: np.ndarray) -> np.ndarray:
        away = np.array([distance(effects) for effects in hypotheses])
        return robust(scaled).mean(axis=1) + 0.5 * prior * (away**2).sum(axis=1)

    tried = predictions.residuals(list(starts)) / scale
    losses = total(starts, tried)
    best = int(np.argmin(losses))
    current, residual, loss = starts[best], tried[best], float(losses[best])
    fixed = sum(len(parameters) for _, parameters in current[:free])
    typical, values = scales(current, predictions.robot), flat(current)
    rows = None
    for _ in range(iterations if fixed < len(values) else 0):
        rows = jacobian(predictions, current, residual, scale, fixed)
        used = np.nan_to_num(residual).ravel()
        weight = robust_weights(used)
        gradient = rows @ (weight * used)
        curvature = (rows * weight) @ rows.T
        if prior:
            # The loss is a mean over residuals, the sums here are not.
            count = motion_count(residual)
            gradient = gradient + prior * count * distance(current)[fixed:]
            curvature = curvature + prior * count * np.diag(np.isfinite(neutral[fixed:]).astype(float))
        diagonal = np.diag(np.diag(curvature) + 1e-6 * np.trace(curvature) + 1e-9)
        # Along a bound: a step that leads beyond it leaves the other parameters where they do not fit.
        kept = _kept(current, values, gradient, fixed)
        candidates = []
        for damping, farthest in (*((d, np.inf) for d in _DAMPINGS), *((d, _FARTHEST) for d in _DAMPINGS[:2])):
            step, moved = np.zeros(len(values)), np.zeros(len(gradient))
            moved[kept] = np.linalg.solve((curvature + damping * diagonal)[np.ix_(kept, kept)], gradient[kept])
            step[fixed:] = typical[fixed:] * np.clip(moved, -farthest, farthest)
            candidates.append(with_values(current, values - step))
        # Most steps need no damping: the others are rolled out only where that one fails.
        improved = False
        for part in (candidates[:1], candidates[1:]):
            tried = predictions.residuals(part) / scale
            losses = total(part, tried)
            best = int(np.argmin(losses))
            improved = losses[best] < loss * (1.0 - 1e-3)
            if improved:
                current, residual, loss = part[best], tried[best], float(losses[best])
                break
        if not improved:
            break
        values = flat(current)
    covariance = np.zeros((len(values), len(values)))
    if rows is not None and rows.any():
        covariance[fixed:, fixed:] = _covariance(rows, residual, typical[fixed:], predictions.data)
    derivatives = None if rows is None else rows.reshape(-1, *residual.shape)
    return Fit(
        current,
        robust(residual),
        covariance,
        derivatives,
        len(np.unique(block_numbers(predictions.data.starts, _BLOCK))),
        residual,
    )


def _kept(current: Effects, values: np.ndarray, gradient: np.ndarray, fixed: int) -> np.ndarray:
    """Parameters that a step may change: none that is at its bound and would leave it, ``[P]`` bool."""
    listed = _parameters(current)[fixed:]
    at_low, at_high = values[fixed:] <= [p.low for p in listed], values[fixed:] >= [p.high for p in listed]
    return ~(at_low & (gradient > 0) | at_high & (gradient < 0))


def jacobian(
    predictions: Predictions, current: Effects, residual: np.ndarray, scale: np.ndarray, fixed: int
) -> np.ndarray:
    """Derivatives of the scaled residuals by each parameter in units of its typical size, ``[P, W K 3]``.

    Args:
        predictions: predictions for the recording's windows.
        current: effects at whose values the derivatives are taken.
        residual: their scaled residuals, ``[W, K, 3]``.
        scale: expected size of a residual, ``[K, 3]`` or ``[W, K, 3]``.
        fixed: number of leading parameters that are left out.
    """
    values, typical = flat(current), scales(current, predictions.robot)
    steps = np.maximum(3e-2 * typical, [parameter.resolution for parameter in _parameters(current)])
    units = np.eye(len(values))
    # Step away from bounds, and from neutral values beyond which an effect is undefined.
    shifted_effects, actual = [], []
    for i in range(fixed, len(values)):
        stepped = with_values(current, values + steps * units[i])
        change = flat(stepped)[i] - values[i]
        if abs(change) < 0.5 * steps[i]:
            stepped = with_values(current, values - steps * units[i])
            change = flat(stepped)[i] - values[i]
        shifted_effects.append(stepped)
        actual.append(change if change else np.inf)
    shifted = predictions.residuals(shifted_effects) / scale
    factors = (typical[fixed:] / np.array(actual))[:, None, None, None]
    return np.nan_to_num((shifted - residual) * factors).reshape(len(shifted_effects), -1)


def _covariance(jacobian: np.ndarray, residual: np.ndarray, typical: np.ndarray, data: EvidenceWindows) -> np.ndarray:
    """Covariance of the parameters from the scores of each block of the recording (sandwich estimate, White 1980).

    Blocks are roughly independent, windows within a block are not: they share motion and the model's other errors. The
    spread of the per-block scores therefore measures the uncertainty even where the model is wrong in other ways.
    """
    used = np.nan_to_num(residual)
    weight = robust_weights(used)
    count = len(used)
    rows = jacobian.reshape(len(jacobian), count, -1)
    scores = np.einsum("pwk,wk->wp", rows, (weight * used).reshape(count, -1))
    blocks = block_numbers(data.starts, _BLOCK)
    block_scores = np.array([scores[blocks == block].sum(axis=0) for block in np.unique(blocks)])
    information = np.einsum("pwk,qwk->pq", rows * weight.reshape(1, count, -1), rows)
    inverse = np.linalg.pinv(information + 1e-9 * np.eye(len(information)) * np.trace(information))
    small_sample = len(block_scores) / max(1, len(block_scores) - len(typical))
    return small_sample * inverse @ (block_scores.T @ block_scores) @ inverse * np.outer(typical, typical)


def first_values(effect: Effect, robot: RobotModel) -> list[Effects]:
    """Starts over the range where an effect is typically found on a robot, its neutral value excepted."""
    return [((effect.name, values),) for values in effect.first_values(robot)]


def estimate_effects(
    fit: Fit,
    indistinguishable: Mapping[str, Sequence[str]],
    *,
    healthy_covariance: np.ndarray | None = None,
    segments: int = 0,
    formula_variances: np.ndarray | None = None,
    confidence: float = 0.95,
) -> tuple[EffectEstimate, ...]:
    """Fitted effects with confidence intervals.

    Args:
        fit: its covariance gives the intervals.
        indistinguishable: for each effect, others that explain the recording about as well.
        healthy_covariance: of the parameters on the healthy robot, ``[P, P]``: the model's own error, which no residual
            of this recording shows.
        segments: number of healthy segments from which they were estimated.
        formula_variances: variance of each parameter because no formula of an effect is exact, ``[P]``.
        confidence: of the intervals.
    """
    values = flat(fit.effects)
    healthy_part = np.zeros_like(fit.covariance) if healthy_covariance is None else healthy_covariance
    formula_part = np.zeros(len(values)) if formula_variances is None else formula_variances
    share = 0.5 + 0.5 * confidence

    def half_width(gradient: np.ndarray, formula: float) -> float:
        """Of what depends on the parameters, to first order."""
        sampling = max(float(gradient @ fit.covariance @ gradient), 0.0)
        healthy = max(float(gradient @ healthy_part @ gradient), 0.0)
        total = sampling + healthy + formula
        # Welch and Satterthwaite: degrees of freedom of a sum of estimated variances.
        parts = sampling**2 / max(fit.blocks - len(values), 1) + healthy**2 / max(segments, 1)
        degrees = total**2 / parts if parts > 0 else np.inf
        return float(student_distribution.ppf(share, max(degrees, 1.0)) * np.sqrt(total))

    units = np.eye(len(values))
    estimates, at = [], 0
    for name, parameters in fit.effects:
        known = {p.name: p for p in CATALOGUE[name].parameters}
        place = {key: at + number for number, key in enumerate(parameters)}
        at += len(parameters)
        listed = {}
        for key, value in parameters.items():
            half = half_width(units[place[key]], float(formula_part[place[key]]))
            listed[key] = ParameterEstimate(
                value=float(value),
                low=float(max(value - half, known[key].low)),
                high=float(min(value + half, known[key].high)),
                unit=known[key].unit,
            )
        products = {}
        for product in CATALOGUE[name].products:
            if not set(product.factors) <= set(place):
                continue
            one, other = (place[key] for key in product.factors)
            by_one, by_other = product.slopes(float(values[one]), float(values[other]))
            # The formula's error is a share of the effect, whose size is that of the first factor.
            half = half_width(by_one * units[one] + by_other * units[other], float(formula_part[one] * by_one**2))
            value = product.of(float(values[one]), float(values[other]))
            products[product.name] = ParameterEstimate(value, value - half, value + half, product.unit)
        others = tuple(indistinguishable.get(name, ()))
        estimates.append(EffectEstimate(name, listed, others, products))
    return tuple(estimates)
