"""Kernel of the motion: one thread per trajectory, with loops over steps and body points.

Warp's adjoint is wrong for a value that is summed in a dynamic loop and then used non-linearly in the same kernel.
Therefore the summed wrench and gains go through per-step arrays, written after the loop over points and read before the
solve. The backward pass repeats these reads but not the writes, so the arrays must contain all steps by then.
"""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.loads import external_loads
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def integrate_kernel(double: bool) -> Any:
    """The kernel in float64 (``double``) or float32."""
    t = types(double)
    functions = contact_functions(double)
    loads_at = external_loads(double)
    state_at, may_touch, below_ground, touch_ground = (
        functions.state_at, functions.may_touch, functions.below_ground, functions.touch_ground
    )  # fmt: skip
    scalar, vec3, mat33 = t.scalar, t.vec3, t.mat33
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options

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

    @wp.kernel(module="unique")
    def integrate(
        first_trajectory: int,
        steps: int,
        keep: int,
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        states: States,
        summed: wp.array3d(dtype=vec3),
    ):
        thread = wp.tid()
        b = first_trajectory + thread
        page = wp.min(b, ground.height.shape[0] - 1)
        offset = robots.centre_of_mass[b]
        count = body.group_halves.shape[0]
        for step in range(steps):
            slot = step * keep
            state = state_at(states, b, step)
            turned = state.rotation
            force = vec3()
            torque = vec3()
            diagonal = vec3()
            off_diagonal = vec3()
            turning_diagonal = vec3()
            turning_off_diagonal = vec3()
            mixed_x = vec3()
            mixed_y = vec3()
            mixed_z = vec3()
            for group in range(count):
                # Most groups, and in them most clusters, are above all ground within reach and are skipped.
                centre = state.position + turned * (body.group_centres[group] - offset)
                if may_touch(ground, ground.group_ceiling, page, centre, turned, body.group_halves[group]):
                    for cluster in range(body.group_edges[group], body.group_edges[group + 1]):
                        middle = state.position + turned * (body.cluster_centres[cluster] - offset)
                        if may_touch(ground, ground.ceiling, page, middle, turned, body.cluster_halves[cluster]):
                            for i in range(body.cluster_edges[cluster], body.cluster_edges[cluster + 1]):
                                arm = turned * (body.points[i] - offset)
                                # Most of the remaining points are in the air.
                                if below_ground(ground, page, options.lookup, state.position + arm):
                                    touch = touch_ground(ground, body, robots, options, page, b, step, i, state, arm)
                                    acting = (
                                        touch.force[0] * touch.normal
                                        + touch.force[1] * touch.along
                                        + touch.force[2] * touch.across
                                    )
                                    force = force + acting
                                    torque = torque + wp.cross(arm, acting)
                                    normal = touch.normal
                                    along = touch.along
                                    across = touch.across
                                    stiff = touch.gain[0] * normal
                                    rolls = touch.gain[1] * along
                                    slides = touch.gain[2] * across
                                    # Entries of the symmetric gain matrix G, of G [arm]×, and of [arm]× G [arm]×.
                                    xx = stiff[0] * normal[0] + rolls[0] * along[0] + slides[0] * across[0]
                                    yy = stiff[1] * normal[1] + rolls[1] * along[1] + slides[1] * across[1]
                                    zz = stiff[2] * normal[2] + rolls[2] * along[2] + slides[2] * across[2]
                                    yz = stiff[1] * normal[2] + rolls[1] * along[2] + slides[1] * across[2]
                                    xz = stiff[0] * normal[2] + rolls[0] * along[2] + slides[0] * across[2]
                                    xy = stiff[0] * normal[1] + rolls[0] * along[1] + slides[0] * across[1]
                                    first = vec3(
                                        xy * arm[2] - xz * arm[1], xz * arm[0] - xx * arm[2], xx * arm[1] - xy * arm[0]
                                    )
                                    second = vec3(
                                        yy * arm[2] - yz * arm[1], yz * arm[0] - xy * arm[2], xy * arm[1] - yy * arm[0]
                                    )
                                    third = vec3(
                                        yz * arm[2] - zz * arm[1], zz * arm[0] - xz * arm[2], xz * arm[1] - yz * arm[0]
                                    )
                                    diagonal = diagonal + vec3(xx, yy, zz)
                                    off_diagonal = off_diagonal + vec3(yz, xz, xy)
                                    mixed_x = mixed_x + first
                                    mixed_y = mixed_y + second
                                    mixed_z = mixed_z + third
                                    turning_diagonal = turning_diagonal + vec3(
                                        arm[1] * third[0] - arm[2] * second[0],
                                        arm[2] * first[1] - arm[0] * third[1],
                                        arm[0] * second[2] - arm[1] * first[2],
                                    )
                                    turning_off_diagonal = turning_off_diagonal + vec3(
                                        arm[2] * first[2] - arm[0] * third[2],
                                        arm[1] * third[2] - arm[2] * second[2],
                                        arm[1] * third[1] - arm[2] * second[1],
                                    )
            summed[thread, slot, 0] = force
            summed[thread, slot, 1] = torque
            summed[thread, slot, 2] = diagonal
            summed[thread, slot, 3] = off_diagonal
            summed[thread, slot, 4] = turning_diagonal
            summed[thread, slot, 5] = turning_off_diagonal
            summed[thread, slot, 6] = mixed_x
            summed[thread, slot, 7] = mixed_y
            summed[thread, slot, 8] = mixed_z

            loads = loads_at(robots, options, b, state)
            total_force = summed[thread, slot, 0] + loads.force
            total_torque = summed[thread, slot, 1] + loads.torque
            d = summed[thread, slot, 2]
            o = summed[thread, slot, 3]
            td = summed[thread, slot, 4]
            to = summed[thread, slot, 5]
            h = options.time_step
            world_inertia = turned * robots.inertia[b] * wp.transpose(turned)
            total_torque = total_torque - wp.cross(state.angular, world_inertia * state.angular)
            m = robots.mass[b] + h * loads.drag
            upper = mat33(
                m + h * d[0], h * o[2], h * o[1],
                h * o[2], m + h * d[1], h * o[0],
                h * o[1], h * o[0], m + h * d[2],
            )  # fmt: skip
            # Velocities of points are v - [arm]× ω, hence the signs.
            lower = world_inertia - h * mat33(
                td[0], to[2], to[1],
                to[2], td[1], to[0],
                to[1], to[0], td[2],
            )  # fmt: skip
            side = -h * wp.matrix_from_rows(summed[thread, slot, 6], summed[thread, slot, 7], summed[thread, slot, 8])
            inverse = wp.inverse(upper)
            reduced = wp.transpose(side) * inverse
            right = h * total_force
            turn_change = wp.inverse(lower - reduced * side) * (h * total_torque - reduced * right)
            change = inverse * (right - side * turn_change)
            new_linear = state.linear + change
            new_angular = state.angular + turn_change
            states.velocity[b, step + 1] = new_linear
            states.angular_velocity[b, step + 1] = new_angular
            states.centre[b, step + 1] = state.position + h * new_linear
            states.rotation[b, step + 1] = exponential(h * new_angular) * turned

    return integrate
