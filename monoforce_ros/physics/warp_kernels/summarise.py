"""Kernel of the contact forces summed over the body: one thread per trajectory and step, without gradients."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def summarise_kernel(double: bool, soft: bool) -> Any:
    """The kernel in float64 (``double``) or float32, on firm ground or on ``soft`` soil."""
    t = types(double)
    functions = contact_functions(double, soft)
    state_at, may_touch, touch_ground, belt_speed, over_the_step = (
        functions.state_at, functions.may_touch, functions.touch_ground, functions.belt_speed, functions.over_the_step
    )  # fmt: skip
    scalar, vec3 = t.scalar, t.vec3
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options

    @wp.kernel(module="unique", enable_backward=False)
    def summarise(
        first_trajectory: int,
        every: int,
        steep: scalar,
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        states: States,
        sums: wp.array3d(dtype=scalar),
    ):
        part, slot = wp.tid()
        b = first_trajectory + part
        step = slot * every
        page = wp.min(b, ground.height.shape[0] - 1)
        state = state_at(states, b, step)
        turned = state.rotation
        offset = robots.centre_of_mass[b]
        ahead = vec3(turned[0, 0], turned[1, 0], turned[2, 0])
        change = states.velocity[b, step + 1] - state.linear
        turning_change = states.angular_velocity[b, step + 1] - state.angular
        number = robots.speeds.shape[2]
        left = scalar(0.0)
        right = scalar(0.0)
        push = vec3()
        whole = vec3()
        for group in range(body.group_halves.shape[0]):
            # Most groups, and in them most clusters, are above all ground within reach and are skipped.
            centre = state.position + turned * (body.group_centres[group] - offset)
            if may_touch(ground, ground.group_ceiling, page, centre, turned, body.group_halves[group]):
                for cluster in range(body.group_edges[group], body.group_edges[group + 1]):
                    middle = state.position + turned * (body.cluster_centres[cluster] - offset)
                    if may_touch(ground, ground.ceiling, page, middle, turned, body.cluster_halves[cluster]):
                        for i in range(body.cluster_edges[cluster], body.cluster_edges[cluster + 1]):
                            arm = turned * (body.points[i] - offset)
                            touch = touch_ground(
                                ground, body, robots, options, page, b, i, state.position + arm,
                                state.linear + wp.cross(state.angular, arm), turned,
                                belt_speed(body, robots, b, step, i), scalar(1.0),
                            )  # fmt: skip
                            if touch.active == 1:
                                acted = over_the_step(touch, change + wp.cross(turning_change, arm))
                                tangential = acted[1] * touch.along + acted[2] * touch.across
                                whole = whole + acted[0] * touch.normal + tangential
                                if touch.normal[2] < steep:
                                    push = push + acted[0] * touch.normal
                                if body.points[i][1] > scalar(0.0):
                                    left = left + acted[0]
                                if body.points[i][1] < scalar(0.0):
                                    right = right + acted[0]
                                drive = wp.where(body.drives[i] >= 0, body.drives[i], number)
                                sums[b, slot, drive] = sums[b, slot, drive] + acted[0]
                                if body.drives[i] >= 0:
                                    place = number + 1 + drive
                                    sums[b, slot, place] = sums[b, slot, place] + wp.dot(tangential, ahead)
        after = 2 * number + 1
        sums[b, slot, after] = left
        sums[b, slot, after + 1] = right
        sums[b, slot, after + 2] = push[0]
        sums[b, slot, after + 3] = push[1]
        sums[b, slot, after + 4] = whole[0]
        sums[b, slot, after + 5] = whole[1]
        sums[b, slot, after + 6] = whole[2]

    return summarise
