"""A wall ahead (paper, figure 9): the shipped encoder predicts the crash by heights, and none where none stands."""

import pytest
import torch
import wall

from monoforce_ros.encoder import fused, load_encoder
from monoforce_ros.perception import CameraTerrain
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot


@pytest.fixture(scope="module")
def predictor():
    robot = load_robot("husky")
    return Predictor(robot, CameraTerrain(fused(load_encoder("", "camera")), robot), horizon=wall.HORIZON)


@pytest.mark.parametrize(
    ("seed", "stands"), [(80000, False), (80006, False), (80004, True), (80005, True), (80010, True), (80019, True)]
)
def test_the_shipped_encoder_predicts_where_the_simulated_robot_stops(predictor, seed, stands):
    found = wall.scene(seed)
    least = wall.STOPPED * wall.SPEED * wall.HORIZON
    assert (found.wall is not None) == stands == (found.driven < least)
    driven, by_heights, prediction = wall.predicted(predictor, found)
    assert (driven < least) == (by_heights < least) == stands
    assert bool(torch.isfinite(prediction.terrain.height).all())
