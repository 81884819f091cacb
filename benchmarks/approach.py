"""Approach: what a robot sees on its way towards an obstacle, with odometry that drifts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.perception import Observation
from monoforce_ros.synthetic import LiveWorld

RUN_UP = 1.6
"""Distance that the robot drives before the prediction [m]: the longer baseline of two, and half a metre."""
INTERVAL = 0.2
"""Time between two images [s]."""
YAW_DRIFT, SCALE_ERROR = math.radians(0.3), 0.02
"""Standard deviations, from one drive to another, of odometry's yaw rate [rad/s] and of the length of its way."""
ATTITUDE_NOISE, POSITION_NOISE = math.radians(0.2), 0.003
"""Standard deviations of each pose: about each axis [rad], and along each [m]."""


@dataclass(frozen=True)
class Seen:
    """What the robot's sensors measured at one time, and its odometry."""

    observation: Observation
    motion: MotionState


def driven_up(
    world: LiveWorld, observed: Callable[[LiveWorld, int], tuple[Observation, MotionState]], speed: float, seed: int
) -> tuple[list[Seen], MotionState]:
    """Drive straight ahead over :data:`RUN_UP` and look every :data:`INTERVAL`.

    Args:
        world: the simulation.
        observed: what is measured in it at a stamp [ns].
        speed: commanded [m/s].
        seed: of odometry's errors.

    Returns:
        what was seen, the last one at the end, and the true motion there.
    """
    start = 10**9
    frames = [observed(world, start)]
    world.simulation.drive(speed, 0.0)
    first = frames[0][1].position
    # A robot that an obstacle stops before the end has driven as far as it can.
    for index in range(1, math.ceil(2.0 * RUN_UP / speed / INTERVAL) + 1):
        world.advance(INTERVAL * index)
        frames.append(observed(world, start + round(1e9 * INTERVAL * index)))
        if float(np.linalg.norm(frames[-1][1].position[:2] - first[:2])) >= RUN_UP - 0.5 * speed * INTERVAL:
            break
    drifting = with_odometry_errors([motion for _, motion in frames], seed)
    seen = [Seen(observation, motion) for (observation, _), motion in zip(frames, drifting, strict=True)]
    return seen, frames[-1][1]


def with_odometry_errors(states: list[MotionState], seed: int) -> list[MotionState]:
    """True states of a drive as odometry that drifts measures them."""
    random = np.random.default_rng(seed)
    rate, scale = YAW_DRIFT * random.standard_normal(), 1.0 + SCALE_ERROR * random.standard_normal()
    position, found = states[0].position, []
    for index, state in enumerate(states):
        turn = Rotation.from_euler("z", rate * (state.stamp - states[0].stamp) * 1e-9).as_matrix()
        if index:
            position = position + scale * turn @ (state.position - states[index - 1].position)
        noise = Rotation.from_rotvec(ATTITUDE_NOISE * random.standard_normal(3)).as_matrix()
        found.append(
            replace(
                state,
                position=position + POSITION_NOISE * random.standard_normal(3),
                rotation=turn @ state.rotation @ noise,
            )
        )
    return found
