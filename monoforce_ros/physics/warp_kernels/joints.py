"""Links and coordinates of robots in which something moves, as device functions (formulas of ``articulation.py``).

Values that a loop sums go through arrays before they are used further, see ``integrate.py``.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.physics.warp_kernels.body import body_functions
from monoforce_ros.physics.warp_kernels.structs import types
from monoforce_ros.physics.warp_kernels.tread import tread_function

SLOWEST = 1e-3
SHIFT, SPIN, DRIFT, AXIS, ORIGIN, PLACE = range(6)
"""Columns of a link's frames."""
TORQUE, GAIN, CONTACT, FORWARD, CHANGE, LIMITED = range(6)
"""Columns of the values of a coordinate."""
ROUNDS = 3


@dataclass(frozen=True)
class JointFunctions:
    """Device functions and structs of one precision."""

    pose_links: Any
    load_coordinates: Any
    find_limits: Any
    couple: Any
    clear: Any
    solve: Any
    Work: Any


@cache
def joint_functions(double: bool) -> JointFunctions:
    """Device functions in float64 (``double``) or float32."""
    t = types(double)
    tread = tread_function(double)
    exponential = body_functions(double).exponential
    scalar, vec2, vec3, mat33 = t.scalar, t.vec2, t.vec3, t.mat33
    Robots, States, Joints, Links, Touch, Body = t.Robots, t.States, t.Joints, t.Links, t.Touch, t.Body

    @wp.struct
    class Work:  # [threads, slots, …]
        turns: wp.array3d(dtype=mat33)  # of links, in base axes
        frames: wp.array4d(dtype=vec3)
        centre: wp.array3d(dtype=vec3)  # centre of mass and its rate, in base axes
        inertia: wp.array2d(dtype=mat33)
        block: wp.array4d(dtype=scalar)  # of the body in the system, [6, 6]
        joined: wp.array4d(dtype=scalar)  # contact gains between coordinates, then body and coordinates, [K + 6, K]
        pivots: wp.array4d(dtype=scalar)  # of the factorisation L D Lᵀ, [K + 6, K + 6]
        factor: wp.array4d(dtype=scalar)
        values: wp.array4d(dtype=scalar)  # of each coordinate, then of the body, [K + 6, 6]
        block_gradient: wp.array4d(
            dtype=scalar
        )  # memory of the gradients of these three, for the adjoint of the solver
        joined_gradient: wp.array4d(dtype=scalar)
        values_gradient: wp.array4d(dtype=scalar)

    @wp.func
    def square(arm: vec3) -> mat33:
        return wp.dot(arm, arm) * wp.identity(n=3, dtype=scalar) - wp.outer(arm, arm)

    @wp.func
    def pose_links(
        joints: Joints,
        robots: Robots,
        states: States,
        work: Work,
        links: Links,
        b: int,
        step: int,
        thread: int,
        slot: int,
        turned: mat33,
    ):
        work.turns[thread, slot, 0] = wp.identity(n=3, dtype=scalar)
        work.frames[thread, slot, 0, 0] = vec3()
        work.frames[thread, slot, 0, 1] = vec3()
        work.frames[thread, slot, 0, 2] = vec3()
        nominal = robots.centre_of_mass[b]
        centre = robots.centre_of_mass[b]
        centre_rate = vec3()
        inertia = robots.inertia[b]
        for j in range(joints.number):
            carrier = joints.parents[j] + 1
            carried = work.turns[thread, slot, carrier]
            shift = work.frames[thread, slot, carrier, 0]
            spin = work.frames[thread, slot, carrier, 1]
            drift = work.frames[thread, slot, carrier, 2]
            axis = carried * joints.axes[j]
            origin = carried * joints.origins[j] + shift
            moved = (states.angles[b, step, j] - joints.rest[j]) * axis
            rate = states.rates[b, step, j] * axis
            if joints.slides[j] == 1:
                work.turns[thread, slot, j + 1] = carried
                work.frames[thread, slot, j + 1, 0] = shift + moved
                work.frames[thread, slot, j + 1, 1] = spin
                work.frames[thread, slot, j + 1, 2] = drift + rate
            else:
                turn = exponential(moved) * carried
                work.turns[thread, slot, j + 1] = turn
                work.frames[thread, slot, j + 1, 0] = origin - turn * joints.origins[j]
                work.frames[thread, slot, j + 1, 1] = spin + rate
                work.frames[thread, slot, j + 1, 2] = drift - wp.cross(rate, origin)
            work.frames[thread, slot, j + 1, 3] = axis
            work.frames[thread, slot, j + 1, 4] = origin
            mass = joints.masses[j]
            if mass > scalar(0.0):
                start = joints.places[j]
                place = work.turns[thread, slot, j + 1] * start + work.frames[thread, slot, j + 1, 0]
                speed = wp.cross(work.frames[thread, slot, j + 1, 1], place) + work.frames[thread, slot, j + 1, 2]
                work.frames[thread, slot, j + 1, 5] = place
                share = mass / robots.mass[b]
                centre = centre + share * (place - start)
                centre_rate = centre_rate + share * speed
                inertia = inertia + mass * (square(place - nominal) - square(start - nominal))
        work.centre[thread, slot, 0] = centre
        work.centre[thread, slot, 1] = centre_rate
        work.inertia[thread, slot] = inertia
        middle = work.centre[thread, slot, 0]
        middle_rate = work.centre[thread, slot, 1]
        for link in range(joints.number + 1):
            links.turns[thread, slot, link] = turned * work.turns[thread, slot, link]
            turning = work.frames[thread, slot, link, 1]
            links.frames[thread, slot, link, 0] = turned * (work.frames[thread, slot, link, 0] - middle)
            links.frames[thread, slot, link, 1] = turned * turning
            links.frames[thread, slot, link, 2] = turned * (
                wp.cross(turning, middle) + work.frames[thread, slot, link, 2] - middle_rate
            )
            # Only coordinates need the axes.
            if link > 0 and joints.size > 0:
                links.frames[thread, slot, link, 3] = turned * work.frames[thread, slot, link, 3]
                links.frames[thread, slot, link, 4] = turned * (work.frames[thread, slot, link, 4] - middle)
                links.frames[thread, slot, link, 5] = turned * (work.frames[thread, slot, link, 5] - middle)

    @wp.func
    def servo_at(
        joints: Joints, entry: int, angle: scalar, rate: scalar, target: scalar, target_rate: scalar, h: scalar
    ) -> vec2:
        # Torque of springs and servos without limits, and the rate at which it decreases with the coordinate's rate.
        gain = joints.parameters[entry, 2] + h * joints.parameters[entry, 1]
        return vec2(joints.parameters[entry, 1] * (target - angle) + gain * (target_rate - rate), gain)

    @wp.func
    def limit_at(joints: Joints, entry: int, rate: scalar, side: scalar) -> vec2:
        # Largest torque in a direction, and the rate at which it decreases with the rate in that direction.
        forward = wp.max(side * rate, scalar(0.0))
        stall = joints.parameters[entry, 4]
        no_load = joints.parameters[entry, 5]
        curve = stall * wp.max(scalar(1.0) - forward / no_load, scalar(0.0))
        moving = wp.max(forward, scalar(SLOWEST))
        by_power = joints.parameters[entry, 7] / moving
        limit = wp.min(wp.min(curve, by_power), joints.parameters[entry, 6])
        falls = scalar(0.0)
        if curve <= limit and forward > scalar(0.0) and forward < no_load:
            falls = falls + stall / no_load
        if by_power <= limit and forward > scalar(SLOWEST):
            falls = falls + by_power / moving
        return vec2(limit, falls)

    @wp.func
    def torque_at(
        joints: Joints,
        entry: int,
        angle: scalar,
        rate: scalar,
        target: scalar,
        target_rate: scalar,
        limited: scalar,
        h: scalar,
    ) -> vec2:
        # Torque of springs, servos and stops, and the rate at which it decreases with the coordinate's rate.
        found = servo_at(joints, entry, angle, rate, target, target_rate, h)
        torque = found[0]
        gain = found[1]
        if limited != scalar(0.0):
            side = wp.where(limited > scalar(0.0), scalar(1.0), scalar(-1.0))
            most = limit_at(joints, entry, rate, side)
            torque = side * most[0]
            gain = most[1]
        torque = torque - joints.parameters[entry, 3]
        low = joints.parameters[entry, 8]
        high = joints.parameters[entry, 9]
        stop = joints.parameters[entry, 10]
        ahead = angle + h * rate
        if angle > high:
            torque = torque - stop * (ahead - high)
            gain = gain + h * stop
        if angle < low:
            torque = torque - stop * (ahead - low)
            gain = gain + h * stop
        return vec2(torque, gain)

    @wp.func
    def load_at(
        joints: Joints,
        robots: Robots,
        states: States,
        links: Links,
        b: int,
        step: int,
        thread: int,
        slot: int,
        entry: int,
        limited: scalar,
        weight: vec3,
        h: scalar,
    ) -> vec2:
        # Torque on a joint's or drive's coordinate without contact, and the rate at which it decreases.
        found = vec2()
        if entry < joints.number:
            found = torque_at(
                joints, entry, states.angles[b, step, entry], states.rates[b, step, entry],
                joints.target_angles[b, step, entry], joints.target_rates[b, step, entry], limited, h,
            )  # fmt: skip
            if joints.masses[entry] > scalar(0.0):
                lever = links.frames[thread, slot, entry + 1, 5] - links.frames[thread, slot, entry + 1, 4]
                turning = wp.dot(weight, wp.cross(links.frames[thread, slot, entry + 1, 3], lever))
                found = found + vec2(joints.masses[entry] * turning, scalar(0.0))
        else:
            drive = entry - joints.number
            found = torque_at(
                joints, entry, scalar(0.0), states.belts[b, step, drive], scalar(0.0), robots.speeds[b, step, drive],
                limited, h,
            )  # fmt: skip
        return found

    @wp.func
    def motion_along(joints: Joints, links: Links, thread: int, slot: int, j: int, touch: Touch, arm: vec3) -> vec3:
        # Velocity of a point along the contact's directions for a unit rate of the joint.
        axis = links.frames[thread, slot, j + 1, 3]
        move = axis
        if joints.slides[j] == 0:
            move = wp.cross(axis, arm - links.frames[thread, slot, j + 1, 4])
        return vec3(wp.dot(touch.normal, move), wp.dot(touch.along, move), wp.dot(touch.across, move))

    @wp.func
    def join_body(work: Work, thread: int, slot: int, size: int, k: int, linear: vec3, arm: vec3):
        angular = wp.cross(arm, linear)
        for r in range(3):
            wp.atomic_add(work.joined, thread, slot, size + r, k, linear[r])
            wp.atomic_add(work.joined, thread, slot, size + 3 + r, k, angular[r])

    @wp.func
    def join_joint(work: Work, thread: int, slot: int, size: int, k: int, motion: vec3, touch: Touch, arm: vec3):
        weighted = wp.cw_mul(touch.gain, motion)
        wp.atomic_add(work.values, thread, slot, k, 2, wp.dot(motion, touch.force))
        wp.atomic_add(work.joined, thread, slot, k, k, wp.dot(weighted, motion))
        linear = weighted[0] * touch.normal + weighted[1] * touch.along + weighted[2] * touch.across
        join_body(work, thread, slot, size, k, linear, arm)

    @wp.func
    def couple(
        joints: Joints,
        body: Body,
        links: Links,
        work: Work,
        thread: int,
        slot: int,
        link: int,
        i: int,
        touch: Touch,
        arm: vec3,
    ):
        # Forces and gains of a touching point on what moves it: its joint, the joint's carrier, its drive.
        size = joints.size
        own = -1
        carrier = -1
        own_motion = vec3()
        carrier_motion = vec3()
        if link > 0:
            own = joints.coordinates[link - 1]
            if joints.parents[link - 1] >= 0:
                carrier = joints.coordinates[joints.parents[link - 1]]
        if own >= 0:
            own_motion = motion_along(joints, links, thread, slot, link - 1, touch, arm)
            join_joint(work, thread, slot, size, own, own_motion, touch, arm)
        if carrier >= 0:
            carrier_motion = motion_along(joints, links, thread, slot, joints.parents[link - 1], touch, arm)
            join_joint(work, thread, slot, size, carrier, carrier_motion, touch, arm)
            if own >= 0:
                shared = wp.dot(wp.cw_mul(touch.gain, own_motion), carrier_motion)
                wp.atomic_add(work.joined, thread, slot, own, carrier, shared)
        if body.drives[i] >= 0:
            drive = joints.coordinates[joints.number + body.drives[i]]
            if drive >= 0:
                belt = links.turns[thread, slot, link] * body.tangents[i]
                slips = vec2(tread(belt, touch.along), wp.dot(belt, touch.across))
                weighted = wp.cw_mul(touch.grip_gain, slips)
                wp.atomic_add(work.values, thread, slot, drive, 2, wp.dot(slips, touch.grip_force))
                wp.atomic_add(work.joined, thread, slot, drive, drive, wp.dot(weighted, slips))
                join_body(work, thread, slot, size, drive, weighted[0] * touch.along + weighted[1] * touch.across, arm)
                if own >= 0:
                    shared = weighted[0] * own_motion[1] + weighted[1] * own_motion[2]
                    wp.atomic_add(work.joined, thread, slot, drive, own, shared)
                if carrier >= 0:
                    shared = weighted[0] * carrier_motion[1] + weighted[1] * carrier_motion[2]
                    wp.atomic_add(work.joined, thread, slot, drive, carrier, shared)

    @wp.func
    def clear(joints: Joints, work: Work, thread: int, slot: int):
        size = joints.size
        for k in range(size):
            work.values[thread, slot, k, 2] = scalar(0.0)
            work.values[thread, slot, k, 5] = scalar(0.0)
            for r in range(size + 6):
                work.joined[thread, slot, r, k] = scalar(0.0)

    @wp.func
    def solve(joints: Joints, work: Work, thread: int, slot: int, h: scalar):
        # The system of coordinates and body by L D Lᵀ. Right sides of the body are in its TORQUE column.
        size = joints.size
        total = size + 6
        for i in range(total):
            for j in range(i + 1):
                entry = scalar(0.0)
                if j < size:
                    entry = h * work.joined[thread, slot, i, j]
                else:
                    entry = work.block[thread, slot, i - size, j - size]
                if i == j and i < size:
                    entry = entry + work.values[thread, slot, i, 1]
                for k in range(j):
                    entry = entry - (
                        work.factor[thread, slot, i, k]
                        * work.factor[thread, slot, j, k]
                        * work.pivots[thread, slot, k, k]
                    )
                work.pivots[thread, slot, i, j] = entry
                if j < i:
                    work.factor[thread, slot, i, j] = work.pivots[thread, slot, i, j] / work.pivots[thread, slot, j, j]
        for i in range(total):
            reduced = work.values[thread, slot, i, 0]
            for k in range(i):
                reduced = reduced - work.factor[thread, slot, i, k] * work.values[thread, slot, k, 3]
            work.values[thread, slot, i, 3] = reduced
        for n in range(total):
            i = total - 1 - n
            found = work.values[thread, slot, i, 3] / work.pivots[thread, slot, i, i]
            for k in range(i + 1, total):
                found = found - work.factor[thread, slot, k, i] * work.values[thread, slot, k, 4]
            work.values[thread, slot, i, 4] = found

    @wp.func_grad(solve)
    def adjoint_solve(joints: Joints, work: Work, thread: int, slot: int, h: scalar):
        # With A x = r: the gradient of r is μ = A⁻¹ x̄, that of A is -μ xᵀ. The factors are those of the solution.
        size = joints.size
        total = size + 6
        for i in range(total):
            reduced = work.values_gradient[thread, slot, i, 4]
            for k in range(i):
                reduced = reduced - work.factor[thread, slot, i, k] * work.values[thread, slot, k, 3]
            work.values[thread, slot, i, 3] = reduced
        for n in range(total):
            i = total - 1 - n
            found = work.values[thread, slot, i, 3] / work.pivots[thread, slot, i, i]
            for k in range(i + 1, total):
                found = found - work.factor[thread, slot, k, i] * work.values[thread, slot, k, 3]
            work.values[thread, slot, i, 3] = found
        for i in range(total):
            work.values_gradient[thread, slot, i, 0] = (
                work.values_gradient[thread, slot, i, 0] + work.values[thread, slot, i, 3]
            )
            for j in range(i + 1):
                gradient = -work.values[thread, slot, i, 3] * work.values[thread, slot, j, 4]
                if j < i:
                    gradient = gradient - work.values[thread, slot, j, 3] * work.values[thread, slot, i, 4]
                if j >= size:
                    work.block_gradient[thread, slot, i - size, j - size] = (
                        work.block_gradient[thread, slot, i - size, j - size] + gradient
                    )
                else:
                    work.joined_gradient[thread, slot, i, j] = work.joined_gradient[thread, slot, i, j] + h * gradient
                    if i == j:
                        work.values_gradient[thread, slot, i, 1] = work.values_gradient[thread, slot, i, 1] + gradient

    @wp.func
    def load_coordinates(
        joints: Joints,
        robots: Robots,
        states: States,
        links: Links,
        work: Work,
        b: int,
        step: int,
        thread: int,
        slot: int,
        weight: vec3,
        h: scalar,
    ):
        # Right sides and diagonals of the coordinates in the system, with the servos that are known to be limited.
        for entry in range(joints.number + robots.speeds.shape[2]):
            k = joints.coordinates[entry]
            if k >= 0:
                limited = work.values[thread, slot, k, 5]
                found = load_at(joints, robots, states, links, b, step, thread, slot, entry, limited, weight, h)
                work.values[thread, slot, k, 0] = h * (found[0] + work.values[thread, slot, k, 2])
                work.values[thread, slot, k, 1] = joints.parameters[entry, 0] + h * found[1]

    @wp.func
    def find_limits(
        joints: Joints,
        robots: Robots,
        states: States,
        links: Links,
        work: Work,
        b: int,
        step: int,
        thread: int,
        slot: int,
        weight: vec3,
        h: scalar,
    ):
        # Which servos give all that they can in this step (``newly_limited`` of articulation.py).
        drives = robots.speeds.shape[2]
        # Whether the last round found one, in a column that the body's rows do not use.
        work.values[thread, slot, joints.size, 5] = scalar(1.0)
        for _round in range(ROUNDS):
            if work.values[thread, slot, joints.size, 5] == scalar(1.0):
                load_coordinates(joints, robots, states, links, work, b, step, thread, slot, weight, h)
                solve(joints, work, thread, slot, h)
                work.values[thread, slot, joints.size, 5] = scalar(0.0)
                for entry in range(joints.number + drives):
                    k = joints.coordinates[entry]
                    if k >= 0 and work.values[thread, slot, k, 5] == scalar(0.0):
                        rate = scalar(0.0)
                        servo = vec2()
                        if entry < joints.number:
                            rate = states.rates[b, step, entry]
                            servo = servo_at(
                                joints, entry, states.angles[b, step, entry], rate,
                                joints.target_angles[b, step, entry], joints.target_rates[b, step, entry], h,
                            )  # fmt: skip
                        else:
                            rate = states.belts[b, step, entry - joints.number]
                            servo = servo_at(
                                joints, entry, scalar(0.0), rate, scalar(0.0),
                                robots.speeds[b, step, entry - joints.number], h,
                            )  # fmt: skip
                        change = work.values[thread, slot, k, 4]
                        given = servo[0] - servo[1] * change
                        side = wp.where(given >= scalar(0.0), scalar(1.0), scalar(-1.0))
                        most = limit_at(joints, entry, rate, side)
                        if side * given > most[0] - side * most[1] * change:
                            work.values[thread, slot, k, 5] = side
                            work.values[thread, slot, joints.size, 5] = scalar(1.0)

    # Which servos are limited has no gradient.
    @wp.func_grad(find_limits)
    def adjoint_find_limits(
        joints: Joints,
        robots: Robots,
        states: States,
        links: Links,
        work: Work,
        b: int,
        step: int,
        thread: int,
        slot: int,
        weight: vec3,
        h: scalar,
    ):
        pass

    # The adjoint of a kernel repeats the functions that it calls before it differentiates them. These write what is
    # still in the arrays.
    @wp.func_replay(pose_links)
    def repeat_poses(
        joints: Joints,
        robots: Robots,
        states: States,
        work: Work,
        links: Links,
        b: int,
        step: int,
        thread: int,
        slot: int,
        turned: mat33,
    ):
        pass

    @wp.func_replay(couple)
    def repeat_coupling(
        joints: Joints,
        body: Body,
        links: Links,
        work: Work,
        thread: int,
        slot: int,
        link: int,
        i: int,
        touch: Touch,
        arm: vec3,
    ):
        pass

    @wp.func_replay(join_body)
    def repeat_body(work: Work, thread: int, slot: int, size: int, k: int, linear: vec3, arm: vec3):
        pass

    @wp.func_replay(join_joint)
    def repeat_joint(work: Work, thread: int, slot: int, size: int, k: int, motion: vec3, touch: Touch, arm: vec3):
        pass

    @wp.func_replay(clear)
    def repeat_clear(joints: Joints, work: Work, thread: int, slot: int):
        pass

    @wp.func_replay(solve)
    def repeat_solution(joints: Joints, work: Work, thread: int, slot: int, h: scalar):
        pass

    @wp.func_replay(find_limits)
    def repeat_limits(
        joints: Joints,
        robots: Robots,
        states: States,
        links: Links,
        work: Work,
        b: int,
        step: int,
        thread: int,
        slot: int,
        weight: vec3,
        h: scalar,
    ):
        pass

    return JointFunctions(pose_links, load_coordinates, find_limits, couple, clear, solve, Work)
