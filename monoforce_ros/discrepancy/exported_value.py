"""Exported values: how a file for another tool states a value and how sure it is."""

from __future__ import annotations

from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate


def stated(value: ParameterEstimate) -> str:
    """Value, unit and interval, or that the robot's file says it without one."""
    unit = "" if value.unit == "-" else f" {value.unit}"
    return f"{value.value:.4g}{unit}, {_interval(value)}"


def stated_effect(effect: EffectEstimate, key: str) -> str:
    """The same of a parameter of an effect, with the effect's name."""
    return f"{effect.name} {stated(effect.parameters[key])}"


def scaled_interval(value: ParameterEstimate, scaled: float) -> str:
    """The interval of a value that is proportional to an estimate."""
    factor = scaled / value.value
    return _interval(ParameterEstimate(scaled, factor * value.low, factor * value.high, value.unit), digits=3)


def _interval(value: ParameterEstimate, digits: int = 4) -> str:
    if value.low == value.high:
        return "from the robot's file, which has no interval"
    return f"{value.low:.{digits}g} to {value.high:.{digits}g}"
