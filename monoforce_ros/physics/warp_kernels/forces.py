"""Kernel of the contact forces: one thread per trajectory, step and body point."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.structs import types


@cache
def forces_kernel(double: bool, soft: bool) -> Any:
    """The kernel in float64 (``double``) or float32, on firm ground or on ``soft`` soil."""
    t = types(double)
    functions = contact_functions(double, soft)
    state_at, touch_ground, belt_speed, over_the_step = (
        functions.state_at, functions.touch_ground, functions.belt_speed, functions.over_the_step
    )  # fmt: skip
    scalar, vec3 = t.scalar, t.vec3
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options

    @wp.kernel(module="unique")
    def forces(
        first_trajectory: int,
        every: int,
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        states: States,
        normal_forces: wp.array3d(dtype=scalar),
        tangential_forces: wp.array3d(dtype=vec3),
        whole_forces: wp.array3d(dtype=vec3),
    ):
        part, slot, i = wp.tid()
        b = first_trajectory + part
        step = slot * every
        page = wp.min(b, ground.height.shape[0] - 1)
        state = state_at(states, b, step)
        arm = state.rotation * (body.points[i] - robots.centre_of_mass[b])
        touch = touch_ground(
            ground, body, robots, options, page, b, i, state.position + arm,
            state.linear + wp.cross(state.angular, arm), state.rotation, belt_speed(body, robots, b, step, i),
            scalar(1.0),
        )  # fmt: skip
        if touch.active == 1:
            turning_change = states.angular_velocity[b, step + 1] - state.angular
            change = states.velocity[b, step + 1] - state.linear + wp.cross(turning_change, arm)
            acted = over_the_step(touch, change)
            normal_forces[b, slot, i] = acted[0]
            tangential = acted[1] * touch.along + acted[2] * touch.across
            tangential_forces[b, slot, i] = tangential
            whole_forces[b, slot, i] = acted[0] * touch.normal + tangential

    return forces
