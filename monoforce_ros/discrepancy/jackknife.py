"""Jackknife: how much estimates differ between searches without parts of a recording.

A fit's interval knows the spread of its blocks, given the effects that were selected. Each search without a part
selects and fits anew, beside whatever else it finds, so that the spread of its values holds the selection as well
(delete-a-group jackknife, Shao and Tu 1995, *The Jackknife and Bootstrap*, section 2.3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import NormalDist

import numpy as np

from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.effects import CATALOGUE, Product


def jackknife_error(values: Sequence[float], parts: int) -> float:
    """Standard error of an estimate by its values without one of several parts each; 0 for fewer than two.

    Args:
        values: without one part each, of those parts without which the estimate exists.
        parts: number of parts into which the recording was cut.
    """
    if len(values) < 2:
        return 0.0
    return math.sqrt((parts - 1) * float(np.var(values)))


def widened(
    estimate: EffectEstimate, found: Sequence[Mapping[str, float]], parts: int, confidence: float = 0.95
) -> EffectEstimate:
    """The estimate with intervals as wide as searches without parts of the recording ask for.

    An interval that is wider already, by the blocks of the whole recording, stays: three to seven searches estimate a
    spread too roughly to make one narrower. One that lies on one side of the neutral value stays there, for whether
    the effect acts at all was tested before; the distance from it is taken as log-normal.

    Args:
        estimate: of the whole recording.
        found: values of the same effect in each search that found it.
        parts: number of searches.
        confidence: of the intervals.
    """
    quantile = NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    effect = CATALOGUE[estimate.name]
    known = {parameter.name: parameter for parameter in effect.parameters}
    usual = {key: estimate.in_file.get(key, parameter.neutral) for key, parameter in known.items()}
    parameters = dict(estimate.parameters)
    for key, value in estimate.parameters.items():
        error = jackknife_error([values[key] for values in found if math.isfinite(values.get(key, math.nan))], parts)
        own = known[key]
        parameters[key] = _at_least(value, quantile * error, usual[key], (own.low, own.high))
    products = dict(estimate.products)
    by_name = {product.name: product for product in effect.products}
    for key, value in estimate.products.items():
        product = by_name[key]
        error = jackknife_error(_product_values(product, found), parts)
        neutral = product.of(*(usual[factor] for factor in product.factors))
        products[key] = _at_least(value, quantile * error, neutral, (-math.inf, math.inf))
    return replace(estimate, parameters=parameters, products=products)


def _product_values(product: Product, found: Sequence[Mapping[str, float]]) -> list[float]:
    one, other = product.factors
    return [product.of(values[one], values[other]) for values in found if one in values and other in values]


def _at_least(
    value: ParameterEstimate, half_width: float, neutral: float, bounds: tuple[float, float]
) -> ParameterEstimate:
    """The interval widened to a half-width, within bounds and on its own side of the neutral value."""
    low, high = value.value - half_width, value.value + half_width
    # A limit has no distance from its absence: its size is its own value.
    origin = neutral if math.isfinite(neutral) else 0.0
    away = value.value - origin
    if away and not value.holds(origin):
        nearest = origin + away * math.exp(-half_width / abs(away))
        low, high = (nearest, high) if away > 0.0 else (low, nearest)
    return replace(value, low=min(value.low, max(low, bounds[0])), high=max(value.high, min(high, bounds[1])))
