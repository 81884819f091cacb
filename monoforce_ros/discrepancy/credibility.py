"""Credibility: whether a fitted value is a measurement, or only the place where a fit stopped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.effects import CATALOGUE, Effect, Parameter, Product

RESOLUTION = 0.03
"""Distance from a bound, in typical sizes of the parameter, below which a value lies at it.

Fits differentiate with steps of this size (``fit.py``): they cannot tell nearer values apart.
"""


def complaint(estimate: EffectEstimate) -> str:
    """Why an estimate is no finding, in one sentence; empty where it may be one.

    Two kinds are refused. A value at a bound of its parameter says where the search stopped, not what the robot does,
    unless a robot can have it, as one whose drive is dead.
    An effect all of whose intervals hold the neutral value may as well be absent. Parameters that act only together
    with another one (the place of a payload, without its mass) do not count: those that do are the main parameter, the
    others of its unit, and the effect's products.

    Args:
        estimate: values and intervals, and the values of the same effect in the robot's file, which take the place of
            the neutral ones.

    Raises:
        ValueError: the effect or a parameter is not in the catalogue.
    """
    effect = CATALOGUE.get(estimate.name)
    if effect is None:
        raise ValueError(f"got the effect {estimate.name!r}, expected one of the catalogue: {', '.join(CATALOGUE)}")
    known = {parameter.name: parameter for parameter in effect.parameters}
    known |= {key: replace(known[key], neutral=value) for key, value in estimate.in_file.items() if key in known}
    unknown = sorted(set(estimate.parameters) - set(known))
    if unknown or not estimate.parameters:
        raise ValueError(f"{estimate.name}: got the parameters {sorted(estimate.parameters)}, expected {sorted(known)}")
    for key, value in estimate.parameters.items():
        if not math.isfinite(value.value) or math.isnan(value.low) or math.isnan(value.high):
            return f"{estimate.name}: {key} is not a number"
        bound = _reached_bound(value, known[key])
        if bound is not None:
            return (
                f"{estimate.name}: {key} {value.value:.3g} {value.unit} lies at the bound {bound:.3g} of its range, "
                "where the search stopped; it is no measurement"
            )
    acting = _acting(estimate, effect)
    products = [product for product in effect.products if product.name in estimate.products]
    held = [_holds_neutral(estimate.parameters[key], known[key]) for key in acting]
    held += [estimate.products[product.name].holds(_neutral_product(product, known)) for product in products]
    if all(held):
        key = acting[0]
        value, neutral = estimate.parameters[key], known[key].neutral
        without = "no limit" if math.isinf(neutral) else f"{neutral:g} {value.unit}"
        return (
            f"{estimate.name}: the 95 % interval of {key}, {value.low:.3g} to {value.high:.3g} {value.unit}, holds "
            f"{without}, {'as the robot file says' if key in estimate.in_file else 'at which the effect does nothing'}"
        )
    return ""


def _acting(estimate: EffectEstimate, effect: Effect) -> list[str]:
    """Parameters that change the motion by themselves, the main one first."""
    main = next((key for key in effect.identified if key in estimate.parameters), None)
    if main is None:
        return list(estimate.parameters)
    unit = estimate.parameters[main].unit
    return [main, *(key for key, value in estimate.parameters.items() if key != main and value.unit == unit)]


def _reached_bound(value: ParameterEstimate, known: Parameter) -> float | None:
    """The bound of its range that a value reaches, or None. A bound that is the neutral value bounds nothing."""
    if known.attainable:
        return None
    for bound in (known.low, known.high):
        if bound != known.neutral and abs(value.value - bound) <= RESOLUTION * known.scale:
            return bound
    return None


def _holds_neutral(value: ParameterEstimate, known: Parameter) -> bool:
    # Intervals are cut at the bounds of the range, so an infinite neutral value lies in one that reaches the bound.
    return value.holds(min(max(known.neutral, known.low), known.high))


def _neutral_product(product: Product, known: Mapping[str, Parameter]) -> float:
    one, other = product.factors
    return product.of(known[one].neutral, known[other].neutral)
