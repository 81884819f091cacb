"""Every robot file of config/robots/ makes a robot that stands, drives straight and turns; new files are found."""

import numpy as np
import pytest
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.effects import controls
from monoforce_ros.perception import support_points
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot, shipped_robots
from monoforce_ros.terrain import Grid, TerrainMap

FLAT = TerrainMap.flat(Grid.square(12.0, 0.5))


def drive(robot, speed, yaw_rate, seconds=2.0):
    """Rollout from rest under one command; the first second is for settling."""
    steps = round(seconds / 0.01)
    twists = torch.tensor([[0.0, 0.0]] * 100 + [[speed, yaw_rate]] * steps)[None]
    return rollout(FLAT, robot, controls(robot, twists, 0.01), State.at_rest(robot.ground_clearance))


def heading(result):
    return float(np.degrees(torch.atan2(result.rotation[0, -1, 1, 0], result.rotation[0, -1, 0, 0])))


@pytest.mark.parametrize("name", shipped_robots())
def test_it_stands_still_at_rest(name):
    robot = load_robot(name)
    result = drive(robot, 0.0, 0.0)
    # The first second is for settling: belly and wheels meet the ground at once.
    moved = result.position[0, -1] - result.position[0, 100]
    assert float(moved.norm()) < 2e-3
    assert float(result.rotation[0, -1, 2, 2]) > 0.995
    weight = float(robot.mass) * 9.81
    assert float(result.normal_forces[0, -1].sum()) == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize("name", shipped_robots())
def test_it_drives_straight_and_turns_to_the_side_that_is_commanded(name):
    robot = load_robot(name)
    ahead = drive(robot, 0.5, 0.0)
    moved = ahead.position[0, -1] - ahead.position[0, 100]
    assert 0.75 < float(moved[0]) < 1.02 and abs(float(moved[1])) < 0.02
    assert abs(heading(ahead)) < 1.0
    # A car turns only as it drives.
    speed = 0.0 if robot.steered is None else 1.0
    left, right = drive(robot, speed, 0.6), drive(robot, speed, -0.6)
    assert heading(left) > 3.0
    assert heading(right) == pytest.approx(-heading(left), abs=2.0)


@pytest.mark.parametrize("name", shipped_robots())
def test_every_robot_touches_the_ground_beneath_it(name):
    robot = load_robot(name)
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    points = support_points(robot, still, 2e6)
    # Ahead of, behind, left and right of the base.
    assert (points[:, :2].max(axis=0) > 0.05).all() and (points[:, :2].min(axis=0) < -0.05).all()
    assert points[:, 2] == pytest.approx(-robot.ground_clearance, abs=0.05)
