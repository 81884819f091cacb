"""Structs passed to the kernels, in one precision.

Warp needs annotations as objects, not strings, so modules of this package must not use
``from __future__ import annotations``.
"""

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import warp as wp

from monoforce_ros.effects import FEATURES
from monoforce_ros.physics.soil import Soil


@dataclass(frozen=True)
class Types:
    """Scalar, vector and struct types of one precision."""

    scalar: Any
    vec2: Any
    vec3: Any
    vec4: Any
    mat33: Any
    features: Any
    soil: Any
    wrench: Any
    Ground: Any
    Body: Any
    Robots: Any
    States: Any
    State: Any
    Options: Any
    Touch: Any
    Loads: Any
    Joints: Any
    Links: Any


@cache
def types(double: bool) -> Types:
    """Types in float64 (``double``) or float32."""
    scalar = wp.float64 if double else wp.float32
    vec2 = wp.types.vector(length=2, dtype=scalar)
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    features = wp.types.vector(length=len(FEATURES), dtype=scalar)
    soil_values = wp.types.vector(length=len(fields(Soil)), dtype=scalar)
    wrench_matrix = wp.types.matrix(shape=(6, len(FEATURES)), dtype=scalar)

    @wp.struct
    class Ground:
        height: wp.array3d(dtype=scalar)  # [pages, rows, columns]
        ceiling: wp.array3d(dtype=scalar)  # highest ground near each node, within reach of clusters
        group_ceiling: wp.array3d(dtype=scalar)  # and of groups
        material: wp.array3d(dtype=vec4)  # stiffness, damping, friction, height of vegetation
        rows: int
        columns: int
        origin_x: scalar
        origin_y: scalar
        inverse_resolution: scalar

    @wp.struct
    class Body:
        points: wp.array(dtype=vec3)
        areas: wp.array(dtype=scalar)
        tangents: wp.array(dtype=vec3)
        share: wp.array(dtype=scalar)  # of the robot's weight
        drives: wp.array(dtype=wp.int32)  # -1 on the hull
        outward: wp.array(dtype=vec3)  # normal of the hull, zero on belts
        strips: wp.array(dtype=vec2)  # width and curvature of the surface, where the ground is soft soil
        cluster_centres: wp.array(dtype=vec3)
        cluster_halves: wp.array(dtype=vec3)
        cluster_edges: wp.array(dtype=wp.int32)
        group_centres: wp.array(dtype=vec3)
        group_halves: wp.array(dtype=vec3)
        group_edges: wp.array(dtype=wp.int32)

    @wp.struct
    class Robots:  # one entry per trajectory
        speeds: wp.array3d(dtype=scalar)  # [B, T, D]
        mass: wp.array(dtype=scalar)
        centre_of_mass: wp.array(dtype=vec3)
        inertia: wp.array(dtype=mat33)
        friction: wp.array(dtype=vec4)  # longitudinal and lateral factor, compliance of drives, slip ratio of tyres
        ground_factors: wp.array(dtype=vec3)  # divisor of stiffness and damping, drag of vegetation, factor on slip
        tilt: wp.array(dtype=vec2)  # of gravity
        resistance: wp.array(dtype=vec4)  # rolling, linear drag, quadratic drag, yield speed of vegetation
        wrench: wp.array(dtype=wrench_matrix)
        soil: wp.array(dtype=soil_values)  # parameters of soft soil
        loads: wp.array2d(dtype=scalar)  # of drives beside those of the robot's file, [B, D]

    @wp.struct
    class States:  # [B, T + 1]
        centre: wp.array2d(dtype=vec3)
        rotation: wp.array2d(dtype=mat33)
        velocity: wp.array2d(dtype=vec3)
        angular_velocity: wp.array2d(dtype=vec3)
        angles: wp.array3d(dtype=scalar)  # of joints, [B, T + 1, J]; these three only where something moves
        rates: wp.array3d(dtype=scalar)
        belts: wp.array3d(dtype=scalar)  # of drives, [B, T + 1, D]

    @wp.struct
    class State:  # of one trajectory at one step
        position: vec3
        rotation: mat33
        linear: vec3
        angular: vec3

    @wp.struct
    class Options:
        time_step: scalar
        gravity: scalar
        slip_square: scalar
        lookup: int
        normal: int
        tangential: int
        compliant: int  # 1 if drives give way

    @wp.struct
    class Touch:  # of one point with the ground
        active: int
        normal: vec3
        along: vec3
        across: vec3
        force: vec3  # along normal, along, across
        gain: vec3
        grip_force: vec2  # friction alone, which also acts on the belt
        grip_gain: vec2

    @wp.struct
    class Loads:  # other than contact, about the centre of mass
        force: vec3
        torque: vec3
        drag: scalar
        weight: vec3

    @wp.struct
    class Joints:  # J joints, then D drives; K of them with dynamics
        number: int  # J
        size: int  # K
        limited: int  # whether servos have limits
        axes: wp.array(dtype=vec3)  # [J]
        origins: wp.array(dtype=vec3)
        places: wp.array(dtype=vec3)
        masses: wp.array(dtype=scalar)
        rest: wp.array(dtype=scalar)
        slides: wp.array(dtype=wp.int32)
        parents: wp.array(dtype=wp.int32)
        coordinates: wp.array(dtype=wp.int32)  # [J + D], -1 without dynamics
        parameters: wp.array2d(dtype=scalar)  # [J + D, 11]
        links: wp.array(dtype=wp.int32)  # of each point
        grip: wp.array(dtype=scalar)  # of each point
        target_angles: wp.array3d(dtype=scalar)  # [B, T, J]
        target_rates: wp.array3d(dtype=scalar)

    @wp.struct
    class Links:  # [threads, slots, L], in terrain axes relative to the centre of mass
        turns: wp.array3d(dtype=mat33)
        frames: wp.array4d(dtype=vec3)  # shift, spin, drift, axis, origin, place

    return Types(
        scalar,
        vec2,
        vec3,
        vec4,
        mat33,
        features,
        soil_values,
        wrench_matrix,
        Ground,
        Body,
        Robots,
        States,
        State,
        Options,
        Touch,
        Loads,
        Joints,
        Links,
    )
