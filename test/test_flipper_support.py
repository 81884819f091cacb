"""A robot on lowered flippers is carried by them: maps of a lidar begin below them, not in them."""

import numpy as np
import pytest
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.perception import Observation, choose_terrain_source
from monoforce_ros.perception.ground_alignment import standing
from monoforce_ros.prediction import Predictor
from monoforce_ros.prediction.joint_motion import JointMotion
from monoforce_ros.robots import load_robot

STILL = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))


@pytest.fixture(scope="module")
def marv():
    return load_robot("marv")


@pytest.mark.parametrize("angle", [-1.0, -0.6, 0.5])
def test_the_ground_is_under_the_flippers_that_carry_a_robot(marv, angle):
    posed = marv.posed(torch.full((4,), angle))
    lowest = float(posed.points[posed.point_drives >= 0][:, 2].min())
    _, support = standing(marv, np.full(4, angle), STILL, 2e6)
    assert len(support) >= 4
    assert np.abs(support[:, 2] - lowest).max() < 0.03
    # On both sides, in front of the centre of mass and behind it.
    assert np.ptp(np.sign(support[:, 0])) == np.ptp(np.sign(support[:, 1])) == 2


@pytest.mark.parametrize("kind", ["lidar", "lidar_interpolation"])
@pytest.mark.parametrize("angle", [-1.0, -0.6])
def test_a_robot_at_rest_on_its_flippers_stays_there(marv, kind, angle):
    angles = np.full(4, angle)
    posed = marv.posed(torch.from_numpy(angles))
    ground = float(posed.points[posed.point_drives >= 0][:, 2].min())
    xy = np.random.default_rng(0).uniform(-6.4, 6.4, (60_000, 2))
    cloud = np.column_stack([xy, np.full(len(xy), ground)])[np.hypot(*xy.T) > 0.8].astype(np.float32)
    predictor = Predictor(marv, choose_terrain_source(kind, marv, fallback=True), horizon=2.0)
    stop = np.zeros((predictor.history + predictor.steps, 2))
    observation = Observation(0, cloud=cloud, flipper_angles=angles)
    predicted = predictor.predict(observation, STILL, stop, joints=JointMotion.of(marv, angles, np.zeros(4)))
    assert predicted.rollout.position[0, :, 2].abs().max() < 0.03
