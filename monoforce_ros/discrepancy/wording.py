"""Wording: what an estimate means for a robot; the sentences of effects are in their own files."""

from __future__ import annotations

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.learned import LEARNED, formula
from monoforce_ros.effects import CATALOGUE, Effect


def finding(estimate: EffectEstimate) -> str:
    """What an estimate means for the robot, as one sentence with its values."""
    found = {key: parameter.value for key, parameter in estimate.parameters.items()}
    if estimate.name == LEARNED:
        return f"An unnamed force or torque acts on the robot: {formula(found)} [N, N m]."
    effect = CATALOGUE.get(estimate.name)
    try:
        if effect is not None:
            outside = frozenset(k for k, v in estimate.parameters.items() if not v.holds(estimate.in_file.get(k, 0.0)))
            values = effect.beyond(found, estimate.in_file, outside)
            return effect.sentence(values) + _determined(estimate) + _in_file(estimate)
    except KeyError:
        # An estimate with other parameters than this sentence expects.
        pass
    summary = estimate.name if effect is None else effect.summary
    listed = ", ".join(f"{key} {value.value:.3g} {value.unit}" for key, value in estimate.parameters.items())
    return f"{summary.rstrip('.')}: {listed}." + _in_file(estimate)


def _in_file(estimate: EffectEstimate) -> str:
    """A sentence on what the robot's file says of the same effect; empty where it says nothing."""
    if not estimate.in_file:
        return ""
    known = {parameter.name: parameter for parameter in CATALOGUE[estimate.name].parameters}
    said = [
        f"{key.replace('_', ' ')} {value:.3g}{'' if known[key].unit == '-' else ' ' + known[key].unit}"
        for key, value in estimate.in_file.items()
        if key in known and value != known[key].neutral
    ]
    if not said:
        return ""
    return f" The robot's file says {', '.join(said)}{', which is more' if eased(estimate) else ''}."


def eased(estimate: EffectEstimate) -> bool:
    """Whether an effect is in the robot's file already, and has become less beyond its interval.

    Only of those that have one size, of which none is the least, such as a delay: factors and forces have no such end.
    """
    effect = CATALOGUE.get(estimate.name)
    if effect is None or len(effect.identified) != 1 or effect.identified[0] not in estimate.in_file:
        return False
    (key,) = effect.identified
    known, value = next(p for p in effect.parameters if p.name == key), estimate.parameters.get(key)
    return value is not None and known.low == known.neutral and value.high < estimate.in_file[key]


def _determined(estimate: EffectEstimate) -> str:
    """A sentence on products that a recording determines where it does not determine their factors; else empty."""
    if not estimate.products:
        return ""
    effect, sentences = CATALOGUE[estimate.name], []
    neutral = {parameter.name: parameter.neutral for parameter in effect.parameters}
    for product in effect.products:
        if product.name not in estimate.products:
            continue
        value, (main, _) = estimate.products[product.name], product.factors
        if not value.holds(0.0) and estimate.parameters[main].holds(neutral[main]):
            sentences.append(f" Only its {product.meaning} is certain: {value.value:.3g} {value.unit}.")
    return "".join(sentences)


def remedy(name: str) -> str:
    """What to check on the robot where this effect was found."""
    return CATALOGUE[name].remedy if name in CATALOGUE else Effect.remedy


def cause(name: str) -> str:
    """The effect in a few words, for lists of what else it could be."""
    known = CATALOGUE[name].cause if name in CATALOGUE else ""
    return known or name.replace("_", " ")
