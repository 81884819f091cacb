"""The catalogue of effects, which extend the physics. A new effect is one file in this package and a test."""

from monoforce_ros.effects.blocked_flipper import flipper_place
from monoforce_ros.effects.catalogue import (
    CATALOGUE,
    EffectError,
    applied_setup,
    corrected_commands,
    corrected_motion,
    drive_speeds,
    effect_values,
    identifiable_effects,
    only_effect,
    recorded_commands,
    recorded_motion,
    separating_manoeuvre,
    separating_sensor,
    speed_effects,
    turned_effects,
    wheel_effects,
)
from monoforce_ros.effects.effect import STAGES, Effect, Fastest, Parameter, Product, WheelResponse, per_trajectory
from monoforce_ros.effects.joint_controls import controls
from monoforce_ros.effects.setup import FEATURE_SIZES, FEATURES, Loads, Setup
from monoforce_ros.effects.timing import contains, values_from, values_growing

__all__ = [
    "CATALOGUE",
    "FEATURES",
    "FEATURE_SIZES",
    "STAGES",
    "Effect",
    "EffectError",
    "Fastest",
    "Loads",
    "Parameter",
    "Product",
    "Setup",
    "WheelResponse",
    "applied_setup",
    "contains",
    "controls",
    "corrected_commands",
    "corrected_motion",
    "drive_speeds",
    "effect_values",
    "flipper_place",
    "identifiable_effects",
    "only_effect",
    "per_trajectory",
    "recorded_commands",
    "recorded_motion",
    "separating_manoeuvre",
    "separating_sensor",
    "speed_effects",
    "turned_effects",
    "values_from",
    "values_growing",
    "wheel_effects",
]
