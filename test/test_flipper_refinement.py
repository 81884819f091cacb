"""Flipper angles over the horizon, improved by the gradient of a candidate's cost."""

import numpy as np
import pytest
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.planning import refine
from monoforce_ros.prediction import JointMotion, Prediction, Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")


def test_refined_flippers_cost_less_at_a_step_than_any_held_angles():
    import flippers

    result = flippers.compare(0.3, seconds=60.0)
    best = min(result.held.values())
    assert np.isfinite(best) and len(result.held) > 400 and result.rounds > 0
    assert result.refined < 0.95 * result.program
    assert result.refined < 0.8 * best
    # It stands on the step; with held angles it leans on its edge.
    assert result.climbed[0] < 0.25 and result.climbed[1] > 0.28
    robot = load_robot("marv")
    low, high = robot.joints[0].low, robot.joints[0].high
    assert result.flippers.min() >= low and result.flippers.max() <= high


def test_flippers_before_the_candidate_and_robots_without_them_stay():
    class Flat:
        grid = Grid.square(8.0, 0.2)

    robot = load_robot("marv")
    predictor = Predictor(robot, Flat(), horizon=0.5, history=0.1)
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    terrain = TerrainMap.flat(Flat.grid, height=-robot.ground_clearance)
    start = robot.joint_angles.double().numpy()
    joints = JointMotion.of(robot, start, np.zeros(4), targets=np.full(4, 0.3))
    prediction = Prediction(still, terrain, None, joints)
    # The candidate starts 0.2 s later.
    before = np.zeros((predictor.history + 20, 2))
    found = refine(predictor, prediction, before, np.array([[0.4, 0.0]]), seconds=20.0)
    assert found.sequence.shape == (30, 2) and found.flippers.shape == (50, 4)
    assert np.allclose(found.flippers[:20], 0.3)
    held = refine(predictor, prediction, before, np.array([[0.4, 0.0]]), seconds=0.0)
    assert held.rounds == 0 and np.allclose(held.flippers, 0.3)
    with pytest.raises(ValueError, match=r"flippers: got shape \(3, 4\), expected \[50, 4\]"):
        refine(predictor, prediction, before, np.array([[0.4, 0.0]]), flippers=np.zeros((3, 4)))
    husky = Predictor(load_robot("husky"), Flat(), horizon=0.2, history=0.1)
    rolled = Prediction(still, terrain, None)
    assert refine(husky, rolled, np.zeros((10, 2)), np.array([[0.4, 0.0]]), seconds=0.0).flippers is None


def test_flippers_given_to_a_rollout_go_before_those_of_the_prediction():
    class Flat:
        grid = Grid.square(8.0, 0.2)

    robot = load_robot("marv")
    predictor = Predictor(robot, Flat(), horizon=0.6, history=0.1)
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    joints = JointMotion.of(robot, robot.joint_angles.double().numpy(), np.zeros(4))
    twists = np.zeros((1, predictor.history + predictor.steps, 2))
    raised = np.full((1, predictor.steps, 4), 0.3)
    result = predictor.roll_out(
        TerrainMap.flat(Flat.grid, height=-0.3), [still], twists, joints=joints, flippers=raised
    )
    assert torch.allclose(result.joint_angles[0, -1], torch.full((4,), 0.3), atol=0.02)
