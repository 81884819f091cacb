"""Contact of one body point with the ground, as device functions (formulas of ``physics/contact.py``)."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.contact import (
    LEAST_RIGID,
    RIGID_PER_MASS,
    RIGID_SLOPE,
    SMALLEST_SLIP,
    STEEPEST_SOIL,
)
from monoforce_ros.physics.soil_contact import FACING
from monoforce_ros.physics.warp_kernels.soil import soil_pressure
from monoforce_ros.physics.warp_kernels.structs import types
from monoforce_ros.physics.warp_kernels.tread import tread_function

CONSTANT_LOOKUP, BILINEAR_LOOKUP = 0, 1
VERTICAL_FORCE, NORMAL_FORCE = 0, 1
NO_FRICTION, COULOMB, SIGMOID = 0, 1, 2
STEEPENING = 1.0 / (STEEPEST_SOIL - RIGID_SLOPE)


@dataclass(frozen=True)
class ContactFunctions:
    """Device functions of one precision."""

    state_at: Any
    may_touch: Any
    below_ground: Any
    touch_ground: Any
    belt_speed: Any
    over_the_step: Any


@cache
def contact_functions(double: bool, soft: bool) -> ContactFunctions:
    """Device functions in float64 (``double``) or float32, on firm ground or on ``soft`` soil."""
    t = types(double)
    scalar, vec2, vec3, vec4, mat33 = t.scalar, t.vec2, t.vec3, t.vec4, t.mat33
    pressure, tread = soil_pressure(double), tread_function(double)
    Ground, Body, Robots, States, State, Options, Touch = (
        t.Ground, t.Body, t.Robots, t.States, t.State, t.Options, t.Touch
    )  # fmt: skip

    @wp.func
    def state_at(states: States, b: int, step: int) -> State:
        state = State()
        state.position = states.centre[b, step]
        state.rotation = states.rotation[b, step]
        state.linear = states.velocity[b, step]
        state.angular = states.angular_velocity[b, step]
        return state

    @wp.func
    def corner(raw: scalar, cells: int) -> int:
        # Never negative, so truncation equals floor, which is a function call on plain x86-64.
        return wp.min(int(wp.clamp(raw, scalar(0.0), scalar(cells - 1))), cells - 2)

    @wp.func
    def nearest(raw: scalar, cells: int) -> int:
        # rint rounds halves to even, like torch.
        return int(wp.rint(wp.clamp(raw, scalar(0.0), scalar(cells - 1))))

    @wp.func
    def nearby(raw: scalar, cells: int) -> int:
        # Rounding of halves does not matter here, and rint is a function call.
        return int(wp.clamp(raw, scalar(0.0), scalar(cells - 1)) + scalar(0.5))

    @wp.func
    def may_touch(
        ground: Ground, ceiling: wp.array3d(dtype=scalar), page: int, middle: vec3, turned: mat33, halves: vec3
    ) -> bool:
        row = nearby((middle[1] - ground.origin_y) * ground.inverse_resolution, ground.rows)
        column = nearby((middle[0] - ground.origin_x) * ground.inverse_resolution, ground.columns)
        # From the middle of a turned box to its lowest corner.
        depth = wp.abs(turned[2, 0]) * halves[0] + wp.abs(turned[2, 1]) * halves[1] + wp.abs(turned[2, 2]) * halves[2]
        return ceiling[page, row, column] > middle[2] - depth

    @wp.func
    def inside_axis(raw: scalar, cells: int) -> scalar:
        return wp.where(raw >= scalar(0.0) and raw <= scalar(cells - 1), scalar(1.0), scalar(0.0))

    @wp.func
    def below_ground(ground: Ground, page: int, lookup: int, point: vec3) -> bool:
        raw_x = (point[0] - ground.origin_x) * ground.inverse_resolution
        raw_y = (point[1] - ground.origin_y) * ground.inverse_resolution
        level = scalar(0.0)
        if lookup == 1:
            column = corner(raw_x, ground.columns)
            row = corner(raw_y, ground.rows)
            u = wp.clamp(raw_x, scalar(0.0), scalar(ground.columns - 1)) - scalar(column)
            w = wp.clamp(raw_y, scalar(0.0), scalar(ground.rows - 1)) - scalar(row)
            h00 = ground.height[page, row, column]
            h01 = ground.height[page, row, column + 1]
            h10 = ground.height[page, row + 1, column]
            h11 = ground.height[page, row + 1, column + 1]
            bottom = h00 + u * (h01 - h00)
            level = bottom + w * (h10 + u * (h11 - h10) - bottom)
        else:
            level = ground.height[page, nearest(raw_y, ground.rows), nearest(raw_x, ground.columns)]
        return level > point[2]

    @wp.func
    def touch_ground(
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        page: int,
        b: int,
        i: int,
        point: vec3,
        velocity: vec3,
        turned: mat33,
        speed: scalar,
        grip: scalar,
    ) -> Touch:
        # ``turned`` is the rotation of the link that carries the point, ``speed`` that of its belt. The grip is 0 on
        # wheels that roll freely.
        touch = Touch()
        raw_x = (point[0] - ground.origin_x) * ground.inverse_resolution
        raw_y = (point[1] - ground.origin_y) * ground.inverse_resolution
        column = corner(raw_x, ground.columns)
        row = corner(raw_y, ground.rows)
        u = wp.clamp(raw_x, scalar(0.0), scalar(ground.columns - 1)) - scalar(column)
        w = wp.clamp(raw_y, scalar(0.0), scalar(ground.rows - 1)) - scalar(row)
        h00 = scalar(0.0)
        h01 = scalar(0.0)
        h10 = scalar(0.0)
        h11 = scalar(0.0)
        level = scalar(0.0)
        if options.lookup == 1:
            h00 = ground.height[page, row, column]
            h01 = ground.height[page, row, column + 1]
            h10 = ground.height[page, row + 1, column]
            h11 = ground.height[page, row + 1, column + 1]
            bottom = h00 + u * (h01 - h00)
            level = bottom + w * (h10 + u * (h11 - h10) - bottom)
        else:
            level = ground.height[page, nearest(raw_y, ground.rows), nearest(raw_x, ground.columns)]
        gap = level - point[2]
        # Most points are in the air and need no further computation.
        if gap > scalar(0.0):
            material = vec4()
            if options.lookup == 1:
                m00 = ground.material[page, row, column]
                m01 = ground.material[page, row, column + 1]
                m10 = ground.material[page, row + 1, column]
                m11 = ground.material[page, row + 1, column + 1]
                below = m00 + u * (m01 - m00)
                above = m10 + u * (m11 - m10)
                material = below + w * (above - below)
            else:
                material = ground.material[page, nearest(raw_y, ground.rows), nearest(raw_x, ground.columns)]
            normal = vec3(scalar(0.0), scalar(0.0), scalar(1.0))
            if options.normal == 1:
                # The height does not depend on clamped coordinates.
                slope_x = (
                    ((scalar(1.0) - w) * (h01 - h00) + w * (h11 - h10))
                    * ground.inverse_resolution
                    * inside_axis(raw_x, ground.columns)
                )
                slope_y = (
                    ((scalar(1.0) - u) * (h10 - h00) + u * (h11 - h01))
                    * ground.inverse_resolution
                    * inside_axis(raw_y, ground.rows)
                )
                upward = scalar(1.0) / wp.sqrt(scalar(1.0) + slope_x * slope_x + slope_y * slope_y)
                normal = vec3(-slope_x * upward, -slope_y * upward, upward)
            area = body.areas[i]
            factors = robots.friction[b]
            ground_factors = robots.ground_factors[b]
            # Faces of the hull meet steep ground stiffly, and it pushes them inwards.
            depth = gap * normal[2]
            outward = turned * body.outward[i]
            if wp.static(soft):
                upwards = normal
            head_on = wp.dot(outward, normal)
            steep = wp.clamp((scalar(STEEPEST_SOIL) - normal[2]) * scalar(STEEPENING), scalar(0.0), scalar(1.0))
            if head_on > scalar(0.0):
                mirrored = normal - scalar(2.0) * steep * head_on * outward
                normal = mirrored * (scalar(1.0) / wp.sqrt(wp.dot(mirrored, mirrored) + scalar(1.0e-12)))
            factor = wp.max(scalar(RIGID_PER_MASS) * robots.mass[b], scalar(LEAST_RIGID))
            rigid = scalar(1.0) + (factor - scalar(1.0)) * steep * wp.abs(head_on)
            if wp.static(soft):
                # The face of a belt lies along its tangent, across the y axis of its link.
                runs = body.tangents[i]
                face = turned * (body.outward[i] + vec3(-runs[2], scalar(0.0), runs[0]))
                push = (scalar(1.0) - wp.dot(face, face)) * upwards - face
                facing = wp.clamp(scalar(1.0) + wp.dot(push, upwards) / scalar(FACING), scalar(0.0), scalar(1.0))
                mixed = (scalar(1.0) - steep) * push + steep * normal
                normal = mixed * (scalar(1.0) / wp.sqrt(wp.dot(mixed, mixed) + scalar(1.0e-12)))
            stiffness = material[0] / ground_factors[0] * rigid
            ground_damping = material[1] / ground_factors[0] * rigid
            resistance = robots.resistance[b]
            belt = turned * (body.tangents[i] * speed)
            lateral = vec3(turned[0, 1], turned[1, 1], turned[2, 1])
            approach = -wp.dot(velocity, normal)
            spring = stiffness * depth
            load = area * wp.max(spring + ground_damping * approach, scalar(0.0))
            # The spring force follows the motion within the step, which acts as additional damping.
            damping = ground_damping + options.time_step * stiffness
            pressing = area * wp.max(spring + damping * approach, scalar(0.0))
            normal_gain = wp.where(pressing > scalar(0.0), area * damping, scalar(0.0))
            across = lateral - wp.dot(lateral, normal) * normal
            across = across * (scalar(1.0) / wp.sqrt(wp.dot(across, across) + scalar(1.0e-12)))
            along = wp.cross(across, normal)
            velocity_along = wp.dot(velocity, along)
            velocity_across = wp.dot(velocity, across)
            rolling_speed = tread(belt, along)
            slip_along = grip * (velocity_along + rolling_speed)
            slip_across = velocity_across + wp.dot(belt, across)
            friction_along = grip * material[2] * factors[0]
            friction_across = material[2] * factors[1]
            # The hull does not roll; the tread of a free wheel moves as fast as the robot.
            slip_square = options.slip_square
            if wp.static(not soft):
                # Soft soil has its own slip at which its shear builds up.
                slip_square = ground_factors[2] * ground_factors[2] * slip_square
                sliding_at = factors[3] * (grip * rolling_speed + (scalar(1.0) - grip) * velocity_along)
                slip_square = slip_square + sliding_at * sliding_at
            # Drives give way under their load; the hull has none.
            kept = scalar(1.0)
            if options.compliant == 1 and body.drives[i] >= 0:
                giving = factors[2] * robots.loads[b, body.drives[i]] * friction_along
                sliding = wp.abs(slip_along)
                square_across = slip_across * slip_across + slip_square
                least = wp.sqrt(square_across)
                kept = wp.max(least / (least + giving), scalar(1.0) - giving / (sliding + scalar(SMALLEST_SLIP)))
                per_slip = scalar(1.0) / wp.sqrt(kept * kept * sliding * sliding + square_across)
                per_square = per_slip * per_slip
                given = giving * per_slip
                excess = kept + given * kept - scalar(1.0)
                slope = scalar(1.0) + given * square_across * per_square
                bend = scalar(1.5) * given * square_across * kept * sliding * sliding * per_square * per_square
                kept = kept - excess * slope / (slope * slope + excess * bend)
            slip_along = kept * slip_along
            force_along = scalar(0.0)
            force_across = scalar(0.0)
            gain_along = scalar(0.0)
            gain_across = scalar(0.0)
            if wp.static(soft):
                slip_speed = wp.sqrt(slip_along * slip_along + slip_across * slip_across + options.slip_square)
                yields = pressure(
                    robots.soil[b], body.strips[i], wp.where(body.drives[i] >= 0, scalar(1.0), scalar(0.0)), depth,
                    approach, vec2(slip_along, slip_across), wp.dot(velocity, wp.cross(across, upwards)),
                    grip * velocity_along, wp.dot(belt, along), -wp.dot(belt, upwards),
                    ground_factors[0], options.time_step, options.slip_square,
                )  # fmt: skip
                yielding = area * (scalar(1.0) - steep) * facing
                held_by = (material[2] * steep * load + yielding * yields[3]) / slip_speed
                load = steep * load + yielding * yields[0]
                pressing = steep * pressing + yielding * yields[1]
                normal_gain = steep * normal_gain + yielding * yields[2]
                gain_along = grip * factors[0] * held_by
                gain_across = factors[1] * held_by
                force_along = -gain_along * slip_along
                force_across = -gain_across * slip_across
            if wp.static(not soft):
                if options.tangential == 1:
                    per_speed = load / wp.sqrt(slip_along * slip_along + slip_across * slip_across + slip_square)
                    gain_along = friction_along * per_speed
                    gain_across = friction_across * per_speed
                    force_along = -gain_along * slip_along
                    force_across = -gain_across * slip_across
                if options.tangential == 2:
                    weight = robots.mass[b] * options.gravity * body.share[i]
                    active_along = scalar(1.0) / (scalar(1.0) + wp.exp(slip_along))
                    active_across = scalar(1.0) / (scalar(1.0) + wp.exp(slip_across))
                    force_along = friction_along * weight * (active_along - scalar(0.5))
                    force_across = friction_across * weight * (active_across - scalar(0.5))
                    gain_along = friction_along * weight * active_along * (scalar(1.0) - active_along)
                    gain_across = friction_across * weight * active_across * (scalar(1.0) - active_across)
            gain_along = kept * gain_along
            touch.grip_force = vec2(force_along, force_across)
            touch.grip_gain = vec2(gain_along, gain_across)
            # Rolling resistance and vegetation depend on the velocity of the body, not on slip.
            over_ground = wp.sqrt(
                velocity_along * velocity_along + velocity_across * velocity_across + options.slip_square
            )
            resistance_across = area * (ground_factors[1] * material[3]) * (scalar(1.0) + resistance[3] / over_ground)
            rolling = resistance[0] * load / wp.sqrt(velocity_along * velocity_along + options.slip_square)
            resistance_along = rolling + resistance_across
            force_along = force_along - resistance_along * velocity_along
            force_across = force_across - resistance_across * velocity_across
            gain_along = gain_along + resistance_along
            gain_across = gain_across + resistance_across
            touch.active = 1
            touch.normal = normal
            touch.along = along
            touch.across = across
            touch.force = vec3(pressing, force_along, force_across)
            touch.gain = vec3(normal_gain, gain_along, gain_across)
        return touch

    @wp.func
    def belt_speed(body: Body, robots: Robots, b: int, step: int, i: int) -> scalar:
        # The hull has no drive; its tangents are zero.
        return robots.speeds[b, step, wp.max(body.drives[i], 0)]

    @wp.func
    def over_the_step(touch: Touch, velocity_change: vec3) -> vec3:
        # The forces over the step, after the point's change of velocity has reduced them.
        return vec3(
            wp.max(touch.force[0] - touch.gain[0] * wp.dot(touch.normal, velocity_change), scalar(0.0)),
            touch.force[1] - touch.gain[1] * wp.dot(touch.along, velocity_change),
            touch.force[2] - touch.gain[2] * wp.dot(touch.across, velocity_change),
        )

    return ContactFunctions(state_at, may_touch, below_ground, touch_ground, belt_speed, over_the_step)
