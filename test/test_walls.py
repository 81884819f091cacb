"""A wall ahead (paper, figure 9), in scenes on which nothing was tuned or selected: the first twelve from seed 93000.

The shipped encoder predicts 6 of 7 crashes there and none without a wall. On all 32 scenes from there it
is 16 of 21.
"""

import pytest
import torch
import wall

from monoforce_ros.encoder import fused, load_encoder
from monoforce_ros.perception import CameraTerrain
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot

SEEDS = range(93000, 93012)
WALLS, PREDICTED = 7, 6


@pytest.fixture(scope="module")
def predictor():
    robot = load_robot("husky")
    return Predictor(robot, CameraTerrain(fused(load_encoder("", "camera")), robot), horizon=wall.HORIZON)


def test_the_shipped_encoder_predicts_crashes_and_no_false_ones(predictor):
    threshold = wall.STOPPED * wall.SPEED * wall.HORIZON
    walls = crashes = crashes_by_height = 0
    for seed in SEEDS:
        found = wall.scene(seed)
        is_wall = found.wall is not None
        assert (found.driven < threshold) == is_wall, seed
        driven, by_height, prediction = wall.predicted(predictor, found)
        assert torch.isfinite(prediction.terrain.height).all(), seed
        assert is_wall or min(driven, by_height) >= threshold, f"seed {seed}: false crash"
        walls += is_wall
        crashes += driven < threshold
        crashes_by_height += by_height < threshold
    assert walls == WALLS
    assert crashes >= PREDICTED and crashes_by_height >= PREDICTED
