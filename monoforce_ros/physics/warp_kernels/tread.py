"""Speed of a flattened belt along the ground, as a device function (formula of ``physics/contact.py``)."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.contact import FLAT_TREAD
from monoforce_ros.physics.warp_kernels.structs import types

FULL_TREAD = 1.0 / FLAT_TREAD


@cache
def tread_function(double: bool) -> Any:
    """Device function in float64 (``double``) or float32."""
    t = types(double)
    scalar, vec3 = t.scalar, t.vec3

    @wp.func
    def tread(belt: vec3, along: vec3) -> scalar:
        fastest = wp.sqrt(wp.dot(belt, belt) + scalar(1.0e-12))
        return wp.clamp(wp.dot(belt, along) * scalar(FULL_TREAD), -fastest, fastest)

    return tread
