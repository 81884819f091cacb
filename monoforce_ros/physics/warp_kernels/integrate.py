"""Kernel of the motion: one thread per trajectory, with loops over steps and body points.

Warp's adjoint is wrong for a value that is summed in a dynamic loop and then used non-linearly in the same kernel.
Therefore the summed wrench and gains go through per-step arrays, written after the loop over points and read before the
solve. The backward pass repeats these reads but not the writes, so the arrays must contain all steps by then.
"""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.body import body_functions
from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.loads import external_loads
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def integrate_kernel(double: bool, soft: bool) -> Any:
    """The kernel in float64 (``double``) or float32, on firm ground or on ``soft`` soil."""
    t = types(double)
    functions = contact_functions(double, soft)
    loads_at = external_loads(double)
    rigid = body_functions(double)
    state_at, may_touch, below_ground, touch_ground, belt_speed = (
        functions.state_at, functions.may_touch, functions.below_ground, functions.touch_ground, functions.belt_speed
    )  # fmt: skip
    exponential, gains_of, upper_block, lower_block, solved, Blocks = (
        rigid.exponential, rigid.gains_of, rigid.upper_block, rigid.lower_block, rigid.solved, rigid.Blocks
    )  # fmt: skip
    scalar, vec3 = t.scalar, t.vec3
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options

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
                                    touch = touch_ground(
                                        ground, body, robots, options, page, b, i, state.position + arm,
                                        state.linear + wp.cross(state.angular, arm), turned,
                                        belt_speed(body, robots, b, step, i), scalar(1.0),
                                    )  # fmt: skip
                                    acting = (
                                        touch.force[0] * touch.normal
                                        + touch.force[1] * touch.along
                                        + touch.force[2] * touch.across
                                    )
                                    force = force + acting
                                    torque = torque + wp.cross(arm, acting)
                                    gains = gains_of(touch, arm)
                                    diagonal = diagonal + gains.diagonal
                                    off_diagonal = off_diagonal + gains.off_diagonal
                                    mixed_x = mixed_x + gains.mixed_x
                                    mixed_y = mixed_y + gains.mixed_y
                                    mixed_z = mixed_z + gains.mixed_z
                                    turning_diagonal = turning_diagonal + gains.turning_diagonal
                                    turning_off_diagonal = turning_off_diagonal + gains.turning_off_diagonal
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
            h = options.time_step
            world_inertia = turned * robots.inertia[b] * wp.transpose(turned)
            total_torque = total_torque - wp.cross(state.angular, world_inertia * state.angular)
            blocks = Blocks()
            blocks.upper = upper_block(
                robots.mass[b] + h * loads.drag, h, summed[thread, slot, 2], summed[thread, slot, 3]
            )
            blocks.lower = lower_block(world_inertia, h, summed[thread, slot, 4], summed[thread, slot, 5])
            blocks.side = -h * wp.matrix_from_rows(
                summed[thread, slot, 6], summed[thread, slot, 7], summed[thread, slot, 8]
            )
            change = solved(blocks, h * total_force, h * total_torque)
            new_linear = state.linear + change.linear
            new_angular = state.angular + change.angular
            states.velocity[b, step + 1] = new_linear
            states.angular_velocity[b, step + 1] = new_angular
            states.centre[b, step + 1] = state.position + h * new_linear
            states.rotation[b, step + 1] = exponential(h * new_angular) * turned

    return integrate
