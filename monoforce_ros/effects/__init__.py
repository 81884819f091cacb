"""The catalogue of effects: how physics grows. A new effect is one new file here and its test."""

from monoforce_ros.effects.catalogue import (
    CATALOGUE,
    EffectError,
    applied_setup,
    corrected_commands,
    corrected_motion,
    drive_speeds,
    effect_values,
    recorded_commands,
    recorded_motion,
    turned_effects,
)
from monoforce_ros.effects.effect import STAGES, Effect, Parameter, per_trajectory
from monoforce_ros.effects.setup import FEATURES

__all__ = [
    "CATALOGUE",
    "FEATURES",
    "STAGES",
    "Effect",
    "EffectError",
    "Parameter",
    "applied_setup",
    "corrected_commands",
    "corrected_motion",
    "drive_speeds",
    "effect_values",
    "per_trajectory",
    "recorded_commands",
    "recorded_motion",
    "turned_effects",
]
