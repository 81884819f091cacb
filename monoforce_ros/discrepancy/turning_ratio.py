"""Turning ratio: how fast a skid-steered robot turns on level ground for the yaw rate that it is commanded.

The tyres' scrub is part of the contact physics: even a healthy robot turns more slowly than its wheels alone would turn
it. An effect on the track width is a factor on top of that.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from monoforce_ros.effects import controls
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

_STEP, _SETTLING, _DRIVING, _MEASURED = 0.01, 1.0, 5.0, 2.0
"""Time step, time at rest before, time of driving, and its last part, whose yaw rate counts [s]."""
_SHARE = 0.15
"""Speed and yaw rate of the manoeuvres over their largest ones: with any multiplier no limit is reached."""
_UNLIMITED = 1.0
"""Speed that stands for a limit which a robot's file does not say [m/s]: its share is slow for any base."""
_ITERATIONS = 4
"""Corrections at most; a ratio within half a per cent ends them earlier."""


def turning_ratio(robot: RobotModel, multiplier: float = 1.0) -> float:
    """Achieved over commanded yaw rate, the mean of a turn on the spot and a curve, on level ground of usual friction.

    Args:
        robot: with its effects; those with a delay or a lag must reach their final speed within 3 s.
        multiplier: on the commanded yaw rate, as ``wheel_separation_multiplier`` of diff_drive_controller has it.
    """
    top = robot.maximum_speed if math.isfinite(robot.maximum_speed) else _UNLIMITED
    yaw_rate = _SHARE * min(top / float(robot.drive_offsets.abs().max()), robot.maximum_yaw_rate)
    commands = torch.tensor([[0.0, yaw_rate * multiplier], [_SHARE * top, yaw_rate * multiplier]])
    twists = torch.zeros(2, round((_SETTLING + _DRIVING) / _STEP), 2)
    twists[:, round(_SETTLING / _STEP) :] = commands[:, None]
    terrain = TerrainMap.flat(Grid.square(max(16.0, 4.0 * _DRIVING * top), 0.5))
    start = State.at_rest(robot.ground_clearance, batch=2)
    run = rollout(terrain, robot, controls(robot, twists, _STEP), start)
    ahead = run.rotation[:, -round(_MEASURED / _STEP) :, :2, 0].double().numpy()
    headings = np.unwrap(np.arctan2(ahead[..., 1], ahead[..., 0]), axis=1)
    return float(np.mean((headings[:, -1] - headings[:, 0]) / (_MEASURED - _STEP))) / yaw_rate


def separation_multiplier(robot: RobotModel) -> float:
    """Multiplier on the wheel separation with which a robot turns as it is commanded.

    Scrub grows with the wheels' speeds, so that the reciprocal of the ratio does not suffice: regula falsi from there.
    """
    multiplier = 1.0 / max(turning_ratio(robot), 0.1)
    for _ in range(_ITERATIONS):
        ratio = turning_ratio(robot, multiplier)
        if abs(ratio - 1.0) < 0.005:
            break
        multiplier /= max(ratio, 0.1)
    return multiplier
