"""The rollout as Warp kernels: one thread a trajectory, loops over steps and body points inside.

Warp's adjoint of a value that is summed in a dynamic loop and then used non-linearly in the same kernel is wrong, so
the summed wrench and gains go through per-step arrays: stored after the loop over points, loaded before the solve.
On the way back Warp repeats the loads of a step but not its stores, so the arrays must hold every step by then.

Types follow the precision asked for; annotations must be real objects here, not strings.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.effects import FEATURES

CONSTANT_LOOKUP, BILINEAR_LOOKUP = 0, 1
VERTICAL_FORCE, NORMAL_FORCE = 0, 1
NO_FRICTION, COULOMB, SIGMOID = 0, 1, 2
SMALLEST_SPEED_SQUARE = 1e-12

wp.config.log_level = wp.LOG_ERROR


@dataclass(frozen=True)
class Kernels:
    """Kernels and vector types of one precision."""

    scalar: Any
    vec2: Any
    vec3: Any
    vec4: Any
    mat33: Any
    wrench: Any
    integrate: Any
    forces: Any
    summarise: Any


@cache
def kernels(double: bool) -> Kernels:
    """Kernels in float64 (``double``) or float32; compiled at their first launch and cached on disk by Warp."""
    scalar = wp.float64 if double else wp.float32
    vec2 = wp.types.vector(length=2, dtype=scalar)
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    features_vector = wp.types.vector(length=len(FEATURES), dtype=scalar)
    wrench_matrix = wp.types.matrix(shape=(6, len(FEATURES)), dtype=scalar)

    @wp.struct
    class Grid:
        rows: int
        columns: int
        origin_x: scalar
        origin_y: scalar
        inverse_resolution: scalar

    @wp.struct
    class Options:
        time_step: scalar
        gravity: scalar
        slip_square: scalar
        lookup: int
        normal: int
        tangential: int

    @wp.struct
    class Touch:
        active: int
        normal: vec3
        along: vec3
        across: vec3
        force: vec3  # along normal, along, across
        gain: vec3

    @wp.func
    def corner(raw: scalar, cells: int) -> int:
        # Never negative, so that cutting off the fraction is the floor, which would be a call on plain x86-64.
        return wp.min(int(wp.clamp(raw, scalar(0.0), scalar(cells - 1))), cells - 2)

    @wp.func
    def nearest(raw: scalar, cells: int) -> int:
        # rint rounds halves to even, as torch does.
        return int(wp.rint(wp.clamp(raw, scalar(0.0), scalar(cells - 1))))

    @wp.func
    def nearby(raw: scalar, cells: int) -> int:
        # Which way halves are rounded is all the same here, and rint would be a call.
        return int(wp.clamp(raw, scalar(0.0), scalar(cells - 1)) + scalar(0.5))

    @wp.func
    def may_touch(ceiling: wp.array3d(dtype=scalar), page: int, grid: Grid, middle: vec3, radius: scalar) -> bool:
        row = nearby((middle[1] - grid.origin_y) * grid.inverse_resolution, grid.rows)
        column = nearby((middle[0] - grid.origin_x) * grid.inverse_resolution, grid.columns)
        return ceiling[page, row, column] > middle[2] - radius

    @wp.func
    def inside_axis(raw: scalar, cells: int) -> scalar:
        return wp.where(raw >= scalar(0.0) and raw <= scalar(cells - 1), scalar(1.0), scalar(0.0))

    @wp.func
    def ground_level(
        height: wp.array3d(dtype=scalar), page: int, grid: Grid, lookup: int, raw_x: scalar, raw_y: scalar
    ) -> scalar:
        level = scalar(0.0)
        if lookup == 1:
            column = corner(raw_x, grid.columns)
            row = corner(raw_y, grid.rows)
            u = wp.clamp(raw_x, scalar(0.0), scalar(grid.columns - 1)) - scalar(column)
            w = wp.clamp(raw_y, scalar(0.0), scalar(grid.rows - 1)) - scalar(row)
            h00 = height[page, row, column]
            h01 = height[page, row, column + 1]
            h10 = height[page, row + 1, column]
            h11 = height[page, row + 1, column + 1]
            bottom = h00 + u * (h01 - h00)
            level = bottom + w * (h10 + u * (h11 - h10) - bottom)
        else:
            level = height[page, nearest(raw_y, grid.rows), nearest(raw_x, grid.columns)]
        return level

    @wp.func
    def touch_ground(
        height: wp.array3d(dtype=scalar),
        material: wp.array3d(dtype=vec4),
        page: int,
        grid: Grid,
        options: Options,
        position: vec3,
        arm: vec3,
        turned: mat33,
        linear: vec3,
        angular: vec3,
        tangent: vec3,
        speed: scalar,
        area: scalar,
        weight: scalar,
        factors: vec2,
        rolling: scalar,
        yielding: scalar,
    ) -> Touch:
        touch = Touch()
        point = position + arm
        raw_x = (point[0] - grid.origin_x) * grid.inverse_resolution
        raw_y = (point[1] - grid.origin_y) * grid.inverse_resolution
        column = corner(raw_x, grid.columns)
        row = corner(raw_y, grid.rows)
        u = wp.clamp(raw_x, scalar(0.0), scalar(grid.columns - 1)) - scalar(column)
        w = wp.clamp(raw_y, scalar(0.0), scalar(grid.rows - 1)) - scalar(row)
        h00 = scalar(0.0)
        h01 = scalar(0.0)
        h10 = scalar(0.0)
        h11 = scalar(0.0)
        level = scalar(0.0)
        if options.lookup == 1:
            h00 = height[page, row, column]
            h01 = height[page, row, column + 1]
            h10 = height[page, row + 1, column]
            h11 = height[page, row + 1, column + 1]
            bottom = h00 + u * (h01 - h00)
            level = bottom + w * (h10 + u * (h11 - h10) - bottom)
        else:
            level = height[page, nearest(raw_y, grid.rows), nearest(raw_x, grid.columns)]
        gap = level - point[2]
        # Most points are in the air: nothing more is computed for them.
        if gap > scalar(0.0):
            stuff = vec4()
            if options.lookup == 1:
                m00 = material[page, row, column]
                m01 = material[page, row, column + 1]
                m10 = material[page, row + 1, column]
                m11 = material[page, row + 1, column + 1]
                below = m00 + u * (m01 - m00)
                above = m10 + u * (m11 - m10)
                stuff = below + w * (above - below)
            else:
                stuff = material[page, nearest(raw_y, grid.rows), nearest(raw_x, grid.columns)]
            normal = vec3(scalar(0.0), scalar(0.0), scalar(1.0))
            if options.normal == 1:
                # Where the coordinate was clamped the height no longer depends on it.
                slope_x = (
                    ((scalar(1.0) - w) * (h01 - h00) + w * (h11 - h10))
                    * grid.inverse_resolution
                    * inside_axis(raw_x, grid.columns)
                )
                slope_y = (
                    ((scalar(1.0) - u) * (h10 - h00) + u * (h11 - h01))
                    * grid.inverse_resolution
                    * inside_axis(raw_y, grid.rows)
                )
                upward = scalar(1.0) / wp.sqrt(scalar(1.0) + slope_x * slope_x + slope_y * slope_y)
                normal = vec3(-slope_x * upward, -slope_y * upward, upward)
            velocity = linear + wp.cross(angular, arm)
            belt = turned * (tangent * speed)
            lateral = vec3(turned[0, 1], turned[1, 1], turned[2, 1])
            depth = gap * normal[2]
            approach = -wp.dot(velocity, normal)
            spring = stuff[0] * depth
            load = area * wp.max(spring + stuff[1] * approach, scalar(0.0))
            # Within the step the spring follows the motion: it acts as further damping.
            damping = stuff[1] + options.time_step * stuff[0]
            pressing = area * wp.max(spring + damping * approach, scalar(0.0))
            normal_gain = wp.where(pressing > scalar(0.0), area * damping, scalar(0.0))
            across = lateral - wp.dot(lateral, normal) * normal
            across = across * (scalar(1.0) / wp.sqrt(wp.dot(across, across) + scalar(1.0e-12)))
            along = wp.cross(across, normal)
            moved_along = wp.dot(velocity, along)
            moved_across = wp.dot(velocity, across)
            slip_along = moved_along + wp.dot(belt, along)
            slip_across = moved_across + wp.dot(belt, across)
            friction_along = stuff[2] * factors[0]
            friction_across = stuff[2] * factors[1]
            force_along = scalar(0.0)
            force_across = scalar(0.0)
            gain_along = scalar(0.0)
            gain_across = scalar(0.0)
            if options.tangential == 1:
                per_speed = load / wp.sqrt(slip_along * slip_along + slip_across * slip_across + options.slip_square)
                gain_along = friction_along * per_speed
                gain_across = friction_across * per_speed
                force_along = -gain_along * slip_along
                force_across = -gain_across * slip_across
            if options.tangential == 2:
                active_along = scalar(1.0) / (scalar(1.0) + wp.exp(slip_along))
                active_across = scalar(1.0) / (scalar(1.0) + wp.exp(slip_across))
                force_along = friction_along * weight * (active_along - scalar(0.5))
                force_across = friction_across * weight * (active_across - scalar(0.5))
                gain_along = friction_along * weight * active_along * (scalar(1.0) - active_along)
                gain_across = friction_across * weight * active_across * (scalar(1.0) - active_across)
            # What holds the body back, rather than the belt: rolling resistance and vegetation.
            moved = wp.sqrt(moved_along * moved_along + moved_across * moved_across + options.slip_square)
            held_across = area * stuff[3] * (scalar(1.0) + yielding / moved)
            held_along = rolling * load / wp.sqrt(moved_along * moved_along + options.slip_square) + held_across
            force_along = force_along - held_along * moved_along
            force_across = force_across - held_across * moved_across
            gain_along = gain_along + held_along
            gain_across = gain_across + held_across
            touch.active = 1
            touch.normal = normal
            touch.along = along
            touch.across = across
            touch.force = vec3(pressing, force_along, force_across)
            touch.gain = vec3(normal_gain, gain_along, gain_across)
        return touch

    @wp.func
    def over_the_step(touch: Touch, arm: vec3, change: vec3, turning_change: vec3) -> vec3:
        # The forces that acted over the step: what the point's change of velocity left of them.
        moved = change + wp.cross(turning_change, arm)
        return vec3(
            wp.max(touch.force[0] - touch.gain[0] * wp.dot(touch.normal, moved), scalar(0.0)),
            touch.force[1] - touch.gain[1] * wp.dot(touch.along, moved),
            touch.force[2] - touch.gain[2] * wp.dot(touch.across, moved),
        )

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
        height: wp.array3d(dtype=scalar),
        ceiling: wp.array3d(dtype=scalar),
        material: wp.array3d(dtype=vec4),
        grid: Grid,
        options: Options,
        speeds: wp.array3d(dtype=scalar),
        cluster_centres: wp.array(dtype=vec3),
        cluster_radii: wp.array(dtype=scalar),
        cluster_edges: wp.array(dtype=wp.int32),
        points: wp.array(dtype=vec3),
        areas: wp.array(dtype=scalar),
        tangents: wp.array(dtype=vec3),
        drives: wp.array(dtype=wp.int32),
        share: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar),
        centre_of_mass: wp.array(dtype=vec3),
        inertia: wp.array(dtype=mat33),
        factors: wp.array(dtype=vec2),
        tilt: wp.array(dtype=vec2),
        resistance: wp.array(dtype=vec4),
        wrench: wp.array(dtype=wrench_matrix),
        centre: wp.array2d(dtype=vec3),
        rotation: wp.array2d(dtype=mat33),
        velocity: wp.array2d(dtype=vec3),
        angular_velocity: wp.array2d(dtype=vec3),
        summed: wp.array3d(dtype=vec3),
    ):
        thread = wp.tid()
        b = first_trajectory + thread
        page = wp.min(b, height.shape[0] - 1)
        weight_total = mass[b] * options.gravity
        offset = centre_of_mass[b]
        count = cluster_radii.shape[0]
        for step in range(steps):
            slot = step * keep
            position = centre[b, step]
            turned = rotation[b, step]
            linear = velocity[b, step]
            angular = angular_velocity[b, step]
            force = vec3()
            torque = vec3()
            diagonal = vec3()
            beside = vec3()
            turning_diagonal = vec3()
            turning_beside = vec3()
            mixed_x = vec3()
            mixed_y = vec3()
            mixed_z = vec3()
            for cluster in range(count):
                # Most clusters are higher than any ground below them: nothing is computed for their points.
                middle = position + turned * (cluster_centres[cluster] - offset)
                if may_touch(ceiling, page, grid, middle, cluster_radii[cluster]):
                    for i in range(cluster_edges[cluster], cluster_edges[cluster + 1]):
                        arm = turned * (points[i] - offset)
                        raw_x = (position[0] + arm[0] - grid.origin_x) * grid.inverse_resolution
                        raw_y = (position[1] + arm[1] - grid.origin_y) * grid.inverse_resolution
                        # Of the rest most points are in the air.
                        if ground_level(height, page, grid, options.lookup, raw_x, raw_y) > position[2] + arm[2]:
                            # The hull has no drive; its tangents are zero.
                            drive = wp.max(drives[i], 0)
                            touch = touch_ground(
                                height,
                                material,
                                page,
                                grid,
                                options,
                                position,
                                arm,
                                turned,
                                linear,
                                angular,
                                tangents[i],
                                speeds[b, step, drive],
                                areas[i],
                                weight_total * share[i],
                                factors[b],
                                resistance[b][0],
                                resistance[b][3],
                            )
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
                            # The symmetric gain matrix, it times [arm]×, and [arm]× on both sides, entry by entry.
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
                            beside = beside + vec3(yz, xz, xy)
                            mixed_x = mixed_x + first
                            mixed_y = mixed_y + second
                            mixed_z = mixed_z + third
                            turning_diagonal = turning_diagonal + vec3(
                                arm[1] * third[0] - arm[2] * second[0],
                                arm[2] * first[1] - arm[0] * third[1],
                                arm[0] * second[2] - arm[1] * first[2],
                            )
                            turning_beside = turning_beside + vec3(
                                arm[2] * first[2] - arm[0] * third[2],
                                arm[1] * third[2] - arm[2] * second[2],
                                arm[1] * third[1] - arm[2] * second[1],
                            )
            summed[thread, slot, 0] = force
            summed[thread, slot, 1] = torque
            summed[thread, slot, 2] = diagonal
            summed[thread, slot, 3] = beside
            summed[thread, slot, 4] = turning_diagonal
            summed[thread, slot, 5] = turning_beside
            summed[thread, slot, 6] = mixed_x
            summed[thread, slot, 7] = mixed_y
            summed[thread, slot, 8] = mixed_z

            in_body = wp.transpose(turned) * linear
            rate = (wp.transpose(turned) * angular)[2]
            shown = features_vector(
                scalar(1.0), in_body[0], in_body[1], rate,
                in_body[0] * wp.abs(in_body[0]), in_body[1] * wp.abs(in_body[1]), rate * wp.abs(rate),
                in_body[0] * rate, in_body[1] * rate, turned[2, 0], turned[2, 1],
            )  # fmt: skip
            extra = wrench[b] * shown
            about_x = tilt[b][0]
            about_y = tilt[b][1]
            level = wp.cos(about_y)
            weight = (-options.gravity * mass[b]) * vec3(
                wp.sin(about_y), -wp.sin(about_x) * level, wp.cos(about_x) * level
            )
            drag = resistance[b][1] + resistance[b][2] * wp.sqrt(wp.dot(linear, linear) + scalar(SMALLEST_SPEED_SQUARE))
            pushed = turned * vec3(extra[0], extra[1], extra[2])
            twisted = turned * vec3(extra[3], extra[4], extra[5])
            total_force = summed[thread, slot, 0] + (weight - drag * linear + pushed)
            total_torque = summed[thread, slot, 1] + twisted
            d = summed[thread, slot, 2]
            o = summed[thread, slot, 3]
            td = summed[thread, slot, 4]
            to = summed[thread, slot, 5]
            h = options.time_step
            world_inertia = turned * inertia[b] * wp.transpose(turned)
            total_torque = total_torque - wp.cross(angular, world_inertia * angular)
            m = mass[b] + h * drag
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
            new_linear = linear + change
            new_angular = angular + turn_change
            velocity[b, step + 1] = new_linear
            angular_velocity[b, step + 1] = new_angular
            centre[b, step + 1] = position + h * new_linear
            rotation[b, step + 1] = exponential(h * new_angular) * turned

    @wp.kernel(module="unique")
    def forces(
        first_trajectory: int,
        every: int,
        height: wp.array3d(dtype=scalar),
        material: wp.array3d(dtype=vec4),
        grid: Grid,
        options: Options,
        speeds: wp.array3d(dtype=scalar),
        points: wp.array(dtype=vec3),
        areas: wp.array(dtype=scalar),
        tangents: wp.array(dtype=vec3),
        drives: wp.array(dtype=wp.int32),
        share: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar),
        centre_of_mass: wp.array(dtype=vec3),
        factors: wp.array(dtype=vec2),
        tilt: wp.array(dtype=vec2),
        resistance: wp.array(dtype=vec4),
        wrench: wp.array(dtype=wrench_matrix),
        centre: wp.array2d(dtype=vec3),
        rotation: wp.array2d(dtype=mat33),
        velocity: wp.array2d(dtype=vec3),
        angular_velocity: wp.array2d(dtype=vec3),
        normal_forces: wp.array3d(dtype=scalar),
        tangential_forces: wp.array3d(dtype=vec3),
        whole_forces: wp.array3d(dtype=vec3),
    ):
        part, slot, i = wp.tid()
        b = first_trajectory + part
        step = slot * every
        page = wp.min(b, height.shape[0] - 1)
        turned = rotation[b, step]
        arm = turned * (points[i] - centre_of_mass[b])
        drive = wp.max(drives[i], 0)
        touch = touch_ground(
            height,
            material,
            page,
            grid,
            options,
            centre[b, step],
            arm,
            turned,
            velocity[b, step],
            angular_velocity[b, step],
            tangents[i],
            speeds[b, step, drive],
            areas[i],
            mass[b] * options.gravity * share[i],
            factors[b],
            resistance[b][0],
            resistance[b][3],
        )
        if touch.active == 1:
            acted = over_the_step(
                touch,
                arm,
                velocity[b, step + 1] - velocity[b, step],
                angular_velocity[b, step + 1] - angular_velocity[b, step],
            )
            normal_forces[b, slot, i] = acted[0]
            tangential = acted[1] * touch.along + acted[2] * touch.across
            tangential_forces[b, slot, i] = tangential
            whole_forces[b, slot, i] = acted[0] * touch.normal + tangential

    @wp.kernel(module="unique", enable_backward=False)
    def summarise(
        first_trajectory: int,
        every: int,
        steep: scalar,
        height: wp.array3d(dtype=scalar),
        ceiling: wp.array3d(dtype=scalar),
        material: wp.array3d(dtype=vec4),
        grid: Grid,
        options: Options,
        speeds: wp.array3d(dtype=scalar),
        cluster_centres: wp.array(dtype=vec3),
        cluster_radii: wp.array(dtype=scalar),
        cluster_edges: wp.array(dtype=wp.int32),
        points: wp.array(dtype=vec3),
        areas: wp.array(dtype=scalar),
        tangents: wp.array(dtype=vec3),
        drives: wp.array(dtype=wp.int32),
        share: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar),
        centre_of_mass: wp.array(dtype=vec3),
        factors: wp.array(dtype=vec2),
        tilt: wp.array(dtype=vec2),
        resistance: wp.array(dtype=vec4),
        wrench: wp.array(dtype=wrench_matrix),
        centre: wp.array2d(dtype=vec3),
        rotation: wp.array2d(dtype=mat33),
        velocity: wp.array2d(dtype=vec3),
        angular_velocity: wp.array2d(dtype=vec3),
        sums: wp.array3d(dtype=scalar),
    ):
        part, slot = wp.tid()
        b = first_trajectory + part
        step = slot * every
        page = wp.min(b, height.shape[0] - 1)
        turned = rotation[b, step]
        position = centre[b, step]
        offset = centre_of_mass[b]
        ahead = vec3(turned[0, 0], turned[1, 0], turned[2, 0])
        change = velocity[b, step + 1] - velocity[b, step]
        turning_change = angular_velocity[b, step + 1] - angular_velocity[b, step]
        number = speeds.shape[2]
        left = scalar(0.0)
        right = scalar(0.0)
        push = vec3()
        whole = vec3()
        for cluster in range(cluster_radii.shape[0]):
            middle = position + turned * (cluster_centres[cluster] - offset)
            if may_touch(ceiling, page, grid, middle, cluster_radii[cluster]):
                for i in range(cluster_edges[cluster], cluster_edges[cluster + 1]):
                    arm = turned * (points[i] - offset)
                    touch = touch_ground(
                        height,
                        material,
                        page,
                        grid,
                        options,
                        position,
                        arm,
                        turned,
                        velocity[b, step],
                        angular_velocity[b, step],
                        tangents[i],
                        speeds[b, step, wp.max(drives[i], 0)],
                        areas[i],
                        mass[b] * options.gravity * share[i],
                        factors[b],
                        resistance[b][0],
                        resistance[b][3],
                    )
                    if touch.active == 1:
                        acted = over_the_step(touch, arm, change, turning_change)
                        tangential = acted[1] * touch.along + acted[2] * touch.across
                        whole = whole + acted[0] * touch.normal + tangential
                        if touch.normal[2] < steep:
                            push = push + acted[0] * touch.normal
                        if points[i][1] > scalar(0.0):
                            left = left + acted[0]
                        if points[i][1] < scalar(0.0):
                            right = right + acted[0]
                        drive = wp.where(drives[i] >= 0, drives[i], number)
                        sums[b, slot, drive] = sums[b, slot, drive] + acted[0]
                        if drives[i] >= 0:
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

    # Structs are reached through the kernels' signatures by the caller.
    integrate.grid_type, integrate.options_type = Grid, Options
    return Kernels(scalar, vec2, vec3, vec4, mat33, wrench_matrix, integrate, forces, summarise)
