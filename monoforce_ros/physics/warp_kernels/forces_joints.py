"""Kernel of the contact forces of robots in which something moves: one thread per trajectory, step and body point."""

from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.contact import contact_functions
from monoforce_ros.physics.warp_kernels.structs import types
from monoforce_ros.physics.warp_kernels.tread import tread_function


@cache
def forces_joints_kernel(double: bool, differentiable: bool, soft: bool) -> Any:
    """The kernel in float64 (``double``) or float32, with its adjoint or, compiled sooner, without."""
    t = types(double)
    functions = contact_functions(double, soft)
    state_at, touch_ground, over_the_step = functions.state_at, functions.touch_ground, functions.over_the_step
    tread = tread_function(double)
    scalar, vec3 = t.scalar, t.vec3
    Ground, Body, Robots, States, Options = t.Ground, t.Body, t.Robots, t.States, t.Options
    Joints, Links = t.Joints, t.Links

    @wp.func
    def moved_by(joints: Joints, links: Links, states: States, b: int, step: int, slot: int, j: int, arm: vec3) -> vec3:
        # Change of a point's velocity over the step by that of a joint with dynamics.
        result = vec3()
        if joints.coordinates[j] >= 0:
            change = states.rates[b, step + 1, j] - states.rates[b, step, j]
            axis = links.frames[b, slot, j + 1, 3]
            if joints.slides[j] == 1:
                result = change * axis
            else:
                result = change * wp.cross(axis, arm - links.frames[b, slot, j + 1, 4])
        return result

    @wp.kernel(module="unique", enable_backward=differentiable)
    def forces_joints(
        first_trajectory: int,
        every: int,
        ground: Ground,
        body: Body,
        robots: Robots,
        options: Options,
        states: States,
        joints: Joints,
        links: Links,
        normal_forces: wp.array3d(dtype=scalar),
        tangential_forces: wp.array3d(dtype=vec3),
        whole_forces: wp.array3d(dtype=vec3),
    ):
        part, slot, i = wp.tid()
        b = first_trajectory + part
        step = slot * every
        page = wp.min(b, ground.height.shape[0] - 1)
        state = state_at(states, b, step)
        link = joints.links[i]
        turn = links.turns[b, slot, link]
        arm = turn * body.points[i] + links.frames[b, slot, link, 0]
        spin = state.angular + links.frames[b, slot, link, 1]
        velocity = state.linear + links.frames[b, slot, link, 2] + wp.cross(spin, arm)
        drive = body.drives[i]
        speed = states.belts[b, step, wp.max(drive, 0)]
        touch = touch_ground(
            ground, body, robots, options, page, b, i, state.position + arm, velocity, turn, speed, joints.grip[i]
        )
        if touch.active == 1:
            turning_change = states.angular_velocity[b, step + 1] - state.angular
            change = states.velocity[b, step + 1] - state.linear + wp.cross(turning_change, arm)
            if link > 0:
                change = change + moved_by(joints, links, states, b, step, slot, link - 1, arm)
                if joints.parents[link - 1] >= 0:
                    change = change + moved_by(joints, links, states, b, step, slot, joints.parents[link - 1], arm)
            acted = over_the_step(touch, change)
            if drive >= 0:  # noqa: SIM102  (Warp evaluates both sides of `and`)
                if joints.coordinates[joints.number + drive] >= 0:
                    belt = turn * body.tangents[i]
                    gained = states.belts[b, step + 1, drive] - speed
                    acted = acted - gained * vec3(
                        scalar(0.0),
                        touch.grip_gain[0] * tread(belt, touch.along),
                        touch.grip_gain[1] * wp.dot(belt, touch.across),
                    )
            normal_forces[b, slot, i] = acted[0]
            tangential = acted[1] * touch.along + acted[2] * touch.across
            tangential_forces[b, slot, i] = tangential
            whole_forces[b, slot, i] = acted[0] * touch.normal + tangential

    return forces_joints
