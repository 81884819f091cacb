"""Loads other than contact, as a device function (formulas of ``physics/loads.py``; a test compares both)."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.structs import types

SMALLEST_SPEED_SQUARE = 1e-12


@cache
def external_loads(double: bool) -> Any:
    """Device function in float64 (``double``) or float32."""
    t = types(double)
    scalar, vec3, features = t.scalar, t.vec3, t.features
    Robots, State, Options, Loads = t.Robots, t.State, t.Options, t.Loads

    @wp.func
    def loads_at(robots: Robots, options: Options, b: int, state: State) -> Loads:
        loads = Loads()
        turned = state.rotation
        linear = state.linear
        in_body = wp.transpose(turned) * linear
        rate = (wp.transpose(turned) * state.angular)[2]
        measured = features(
            scalar(1.0), in_body[0], in_body[1], rate,
            in_body[0] * wp.abs(in_body[0]), in_body[1] * wp.abs(in_body[1]), rate * wp.abs(rate),
            in_body[0] * rate, in_body[1] * rate, turned[2, 0], turned[2, 1],
        )  # fmt: skip
        extra = robots.wrench[b] * measured
        tilt = robots.tilt[b]
        resistance = robots.resistance[b]
        level = wp.cos(tilt[1])
        weight = (-options.gravity * robots.mass[b]) * vec3(
            wp.sin(tilt[1]), -wp.sin(tilt[0]) * level, wp.cos(tilt[0]) * level
        )
        drag = resistance[1] + resistance[2] * wp.sqrt(wp.dot(linear, linear) + scalar(SMALLEST_SPEED_SQUARE))
        loads.weight = weight
        loads.force = weight - drag * linear + turned * vec3(extra[0], extra[1], extra[2])
        loads.torque = turned * vec3(extra[3], extra[4], extra[5])
        loads.drag = drag
        return loads

    return loads_at
