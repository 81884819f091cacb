"""Pressure and shear of soft soil, as device functions (``physics/soil_contact.py`` has the same formulas)."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.soil_contact import SHALLOWEST, SMALLEST_CURVATURE
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def soil_pressure(double: bool) -> Any:
    """Device function in float64 (``double``) or float32."""
    t = types(double)
    scalar, vec2, vec4, soil_values = t.scalar, t.vec2, t.vec4, t.soil

    @wp.func
    def pressure(
        soil: soil_values,
        strip: vec2,
        belted: scalar,
        below: scalar,
        approach: scalar,
        slip: vec2,
        travel: scalar,
        rolling: scalar,
        belt: scalar,
        entering: scalar,
        softness: scalar,
        step_time: scalar,
        slow_square: scalar,
    ) -> vec4:
        # Load, pressure over the step, its gain, and shear strength.
        one = scalar(1.0)
        slowest = wp.sqrt(slow_square)
        depth = wp.max(below, scalar(1.0e-9))
        turning = wp.sqrt(belt * belt + slow_square)
        fastest = wp.max(turning, wp.sqrt(travel * travel + slow_square))
        sliding = wp.sqrt((travel + belt) * (travel + belt) + slip[1] * slip[1] + slow_square)
        ratio = belted * wp.min((sliding - slowest) / fastest, one)
        dug = one + soil[7] * scalar(1.5) * ratio / (one - scalar(0.5) * ratio)
        sunk = depth / dug
        square = sunk * sunk + scalar(SHALLOWEST * SHALLOWEST)
        stiffness = (soil[0] / strip[0] + soil[1]) / softness * wp.pow(square, scalar(0.5) * (soil[2] - one))
        static = stiffness * sunk
        slope = stiffness * (one + (soil[2] - one) * sunk * sunk / square) / dug
        rises = one / soil[8]
        hardening = scalar(0.0)
        if approach >= scalar(0.0):
            rises = soil[6]
            hardening = soil[6]
        follows = one + approach * rises
        holds = wp.max(follows, scalar(0.0))
        load = static * holds
        pressing = load + step_time * slope * holds * approach
        gain = scalar(0.0)
        if pressing > scalar(0.0):
            fading = scalar(0.0)
            if follows > scalar(0.0):
                fading = one / (wp.max(approach, scalar(0.0)) + soil[8])
            gain = static * (hardening + fading) + step_time * slope * holds
        curvature = wp.max(strip[1], scalar(SMALLEST_CURVATURE))
        incline = entering / turning
        reach = wp.abs(incline) + wp.sqrt(incline * incline + scalar(2.0) * depth * curvature)
        way = reach / curvature
        if incline >= scalar(0.0):
            way = scalar(2.0) * depth / reach
        along = slip[0] - rolling * curvature * way * (scalar(0.5) * incline + curvature * way / scalar(6.0))
        displacement = wp.sqrt(along * along + slip[1] * slip[1] + slow_square) * way / turning
        mobilised = one - wp.exp(-displacement / soil[5])
        strength = (soil[4] * load + soil[3] * wp.min(holds, one)) * mobilised
        return vec4(load, wp.max(pressing, scalar(0.0)), gain, strength)

    return pressure
