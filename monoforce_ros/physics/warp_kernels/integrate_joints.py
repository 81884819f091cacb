"""Kernel of the motion of robots in which something moves; like ``integrate.py``, with links and coordinates."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.body import body_functions
from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.joints import joint_functions
from monoforce_ros.physics.warp_kernels.loads import external_loads
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def integrate_joints_kernel(double: bool, differentiable: bool, soft: bool) -> Any:
    """The kernel in float64 (``double``) or float32, with its adjoint or, compiled sooner, without."""
    t = types(double)
    functions, rigid, moving = contact_functions(double, soft), body_functions(double), joint_functions(double)
    loads_at = external_loads(double)
    state_at, may_touch, below_ground, touch_ground = (
        functions.state_at, functions.may_touch, functions.below_ground, functions.touch_ground
    )  # fmt: skip
    exponential, gains_of, upper_block, lower_block, solved, Blocks = (
        rigid.exponential, rigid.gains_of, rigid.upper_block, rigid.lower_block, rigid.solved, rigid.Blocks
    )  # fmt: skip
    pose_links, load_coordinates, find_limits, couple, clear, solve, Work = (
        moving.pose_links, moving.load_coordinates, moving.find_limits, moving.couple, moving.clear, moving.solve,
        moving.Work,
    )  # fmt: skip
    scalar, vec3 = t.scalar, t.vec3
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options
    Joints, Links = t.Joints, t.Links

    @wp.kernel(module="unique", enable_backward=differentiable)
    def integrate_joints(
        first_trajectory: int,
        steps: int,
        keep: int,
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        states: States,
        joints: Joints,
        links: Links,
        work: Work,
        summed: wp.array3d(dtype=vec3),
    ):
        thread = wp.tid()
        b = first_trajectory + thread
        page = wp.min(b, ground.height.shape[0] - 1)
        count = body.group_halves.shape[0]
        drives = robots.speeds.shape[2]
        size = joints.size
        h = options.time_step
        for step in range(steps):
            slot = step * keep
            state = state_at(states, b, step)
            turned = state.rotation
            pose_links(joints, robots, states, work, links, b, step, thread, slot, turned)
            if size > 0:
                clear(joints, work, thread, slot)
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
                # A group belongs to one link. Most groups, and in them most clusters, are above all ground within reach
                # and are skipped.
                link = joints.links[body.cluster_edges[body.group_edges[group]]]
                turn = links.turns[thread, slot, link]
                shift = links.frames[thread, slot, link, 0]
                middle = state.position + turn * body.group_centres[group] + shift
                if may_touch(ground, ground.group_ceiling, page, middle, turn, body.group_halves[group]):
                    for cluster in range(body.group_edges[group], body.group_edges[group + 1]):
                        centre = state.position + turn * body.cluster_centres[cluster] + shift
                        if may_touch(ground, ground.ceiling, page, centre, turn, body.cluster_halves[cluster]):
                            for i in range(body.cluster_edges[cluster], body.cluster_edges[cluster + 1]):
                                arm = turn * body.points[i] + shift
                                # Most of the remaining points are in the air.
                                if below_ground(ground, page, options.lookup, state.position + arm):
                                    spin = state.angular + links.frames[thread, slot, link, 1]
                                    velocity = state.linear + links.frames[thread, slot, link, 2] + wp.cross(spin, arm)
                                    touch = touch_ground(
                                        ground, body, robots, options, page, b, i, state.position + arm, velocity, turn,
                                        states.belts[b, step, wp.max(body.drives[i], 0)], joints.grip[i],
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
                                    if size > 0:
                                        couple(joints, body, links, work, thread, slot, link, i, touch, arm)
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
            mass = robots.mass[b]
            offset = work.centre[thread, slot, 0] - robots.centre_of_mass[b]
            # The sum of the links' inertias is about the centre of mass at the rest angles.
            inertia = work.inertia[thread, slot] - mass * (
                wp.dot(offset, offset) * wp.identity(n=3, dtype=scalar) - wp.outer(offset, offset)
            )
            world_inertia = turned * inertia * wp.transpose(turned)
            total_torque = total_torque - wp.cross(state.angular, world_inertia * state.angular)
            blocks = Blocks()
            blocks.upper = upper_block(mass + h * loads.drag, h, summed[thread, slot, 2], summed[thread, slot, 3])
            blocks.lower = lower_block(world_inertia, h, summed[thread, slot, 4], summed[thread, slot, 5])
            blocks.side = -h * wp.matrix_from_rows(
                summed[thread, slot, 6], summed[thread, slot, 7], summed[thread, slot, 8]
            )
            new_linear = vec3()
            new_angular = vec3()
            if size == 0:
                change = solved(blocks, h * total_force, h * total_torque)
                new_linear = state.linear + change.linear
                new_angular = state.angular + change.angular
            else:
                for r in range(3):
                    work.values[thread, slot, size + r, 0] = h * total_force[r]
                    work.values[thread, slot, size + 3 + r, 0] = h * total_torque[r]
                    for c in range(3):
                        work.block[thread, slot, r, c] = blocks.upper[r, c]
                        work.block[thread, slot, 3 + r, 3 + c] = blocks.lower[r, c]
                        work.block[thread, slot, 3 + r, c] = blocks.side[c, r]
                weight = loads.weight / mass
                if joints.limited == 1:
                    find_limits(joints, robots, states, links, work, b, step, thread, slot, weight, h)
                # The search may have ended with the solution; an adjoint needs the steps to it.
                if joints.limited == 0 or keep == 1 or work.values[thread, slot, size, 5] == scalar(1.0):
                    load_coordinates(joints, robots, states, links, work, b, step, thread, slot, weight, h)
                    solve(joints, work, thread, slot, h)
                new_linear = state.linear + vec3(
                    work.values[thread, slot, size, 4],
                    work.values[thread, slot, size + 1, 4],
                    work.values[thread, slot, size + 2, 4],
                )
                new_angular = state.angular + vec3(
                    work.values[thread, slot, size + 3, 4],
                    work.values[thread, slot, size + 4, 4],
                    work.values[thread, slot, size + 5, 4],
                )
                for entry in range(joints.number + drives):
                    k = joints.coordinates[entry]
                    if k >= 0:
                        if entry < joints.number:
                            rate = states.rates[b, step, entry] + work.values[thread, slot, k, 4]
                            states.rates[b, step + 1, entry] = rate
                            states.angles[b, step + 1, entry] = states.angles[b, step, entry] + h * rate
                        else:
                            drive = entry - joints.number
                            states.belts[b, step + 1, drive] = (
                                states.belts[b, step, drive] + work.values[thread, slot, k, 4]
                            )
            states.velocity[b, step + 1] = new_linear
            states.angular_velocity[b, step + 1] = new_angular
            states.centre[b, step + 1] = state.position + h * new_linear
            states.rotation[b, step + 1] = exponential(h * new_angular) * turned

    return integrate_joints
