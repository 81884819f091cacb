"""Equations of a rigid body as device functions: gains of its contacts and the linear system of a step."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.structs import types


@dataclass(frozen=True)
class BodyFunctions:
    """Device functions and structs of one precision."""

    exponential: Any
    gains_of: Any
    upper_block: Any
    lower_block: Any
    solved: Any
    Blocks: Any


@cache
def body_functions(double: bool) -> BodyFunctions:
    """Device functions in float64 (``double``) or float32."""
    t = types(double)
    scalar, vec3, mat33, Touch = t.scalar, t.vec3, t.mat33, t.Touch

    @wp.struct
    class Gains:  # entries of the symmetric gain matrix G, of G [arm]×, and of [arm]× G [arm]×
        diagonal: vec3
        off_diagonal: vec3
        mixed_x: vec3
        mixed_y: vec3
        mixed_z: vec3
        turning_diagonal: vec3
        turning_off_diagonal: vec3

    @wp.struct
    class Blocks:  # of the symmetric system: linear, angular, and between them
        upper: mat33
        lower: mat33
        side: mat33

    @wp.struct
    class Change:
        linear: vec3
        angular: vec3

    @wp.func
    def exponential(turn: vec3) -> mat33:
        square = wp.dot(turn, turn)
        first = scalar(1.0) - square / scalar(6.0)
        second = scalar(0.5) - square / scalar(24.0)
        if square >= scalar(1.0e-8):
            angle = wp.sqrt(square)
            first = wp.sin(angle) / angle
            second = (scalar(1.0) - wp.cos(angle)) / square
        cross = wp.skew(turn)
        return wp.identity(n=3, dtype=scalar) + first * cross + second * (cross * cross)

    @wp.func
    def gains_of(touch: Touch, arm: vec3) -> Gains:
        normal = touch.normal
        along = touch.along
        across = touch.across
        stiff = touch.gain[0] * normal
        rolls = touch.gain[1] * along
        slides = touch.gain[2] * across
        xx = stiff[0] * normal[0] + rolls[0] * along[0] + slides[0] * across[0]
        yy = stiff[1] * normal[1] + rolls[1] * along[1] + slides[1] * across[1]
        zz = stiff[2] * normal[2] + rolls[2] * along[2] + slides[2] * across[2]
        yz = stiff[1] * normal[2] + rolls[1] * along[2] + slides[1] * across[2]
        xz = stiff[0] * normal[2] + rolls[0] * along[2] + slides[0] * across[2]
        xy = stiff[0] * normal[1] + rolls[0] * along[1] + slides[0] * across[1]
        first = vec3(xy * arm[2] - xz * arm[1], xz * arm[0] - xx * arm[2], xx * arm[1] - xy * arm[0])
        second = vec3(yy * arm[2] - yz * arm[1], yz * arm[0] - xy * arm[2], xy * arm[1] - yy * arm[0])
        third = vec3(yz * arm[2] - zz * arm[1], zz * arm[0] - xz * arm[2], xz * arm[1] - yz * arm[0])
        gains = Gains()
        gains.diagonal = vec3(xx, yy, zz)
        gains.off_diagonal = vec3(yz, xz, xy)
        gains.mixed_x = first
        gains.mixed_y = second
        gains.mixed_z = third
        gains.turning_diagonal = vec3(
            arm[1] * third[0] - arm[2] * second[0],
            arm[2] * first[1] - arm[0] * third[1],
            arm[0] * second[2] - arm[1] * first[2],
        )
        gains.turning_off_diagonal = vec3(
            arm[2] * first[2] - arm[0] * third[2],
            arm[1] * third[2] - arm[2] * second[2],
            arm[1] * third[1] - arm[2] * second[1],
        )
        return gains

    @wp.func
    def upper_block(mass: scalar, h: scalar, d: vec3, o: vec3) -> mat33:
        return mat33(
            mass + h * d[0], h * o[2], h * o[1],
            h * o[2], mass + h * d[1], h * o[0],
            h * o[1], h * o[0], mass + h * d[2],
        )  # fmt: skip

    @wp.func
    def lower_block(inertia: mat33, h: scalar, d: vec3, o: vec3) -> mat33:
        # Velocities of points are v - [arm]× ω, hence the sign.
        return inertia - h * mat33(
            d[0], o[2], o[1],
            o[2], d[1], o[0],
            o[1], o[0], d[2],
        )  # fmt: skip

    @wp.func
    def solved(blocks: Blocks, force: vec3, torque: vec3) -> Change:
        inverse = wp.inverse(blocks.upper)
        reduced = wp.transpose(blocks.side) * inverse
        change = Change()
        change.angular = wp.inverse(blocks.lower - reduced * blocks.side) * (torque - reduced * force)
        change.linear = inverse * (force - blocks.side * change.angular)
        return change

    return BodyFunctions(exponential, gains_of, upper_block, lower_block, solved, Blocks)
