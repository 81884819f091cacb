"""A wall ahead (paper, figure 9), in scenes on which nothing was tuned or selected: the first nine from seed 93000.

With a lidar beside the cameras every crash is predicted. The shipped encoder alone sees few walls (docs/protocol.md);
it must not predict crashes where there is no wall.
"""

import pytest
import torch
import wall

from monoforce_ros.perception import choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot

THRESHOLD = wall.STOPPED * wall.SPEED * wall.HORIZON


@pytest.fixture(scope="module")
def predictors():
    robot = load_robot("husky")
    return {
        # The node's default with a lidar; the cameras' map as it is.
        kind: Predictor(robot, choose_terrain_source(kind, robot, fallback=fallback), horizon=wall.HORIZON)
        for kind, fallback in (("lidar_camera", True), ("camera", False))
    }


@pytest.mark.parametrize(("seed", "crash"), [(seed, seed not in (93001, 93003)) for seed in range(93000, 93009)])
def test_crashes_are_predicted_with_a_lidar_and_no_false_ones_without(predictors, seed, crash):
    found = wall.scene(seed)
    assert (found.wall is not None) == crash == (found.driven < THRESHOLD)
    driven, _, prediction = wall.predicted(predictors["lidar_camera"], found)
    assert (driven < THRESHOLD) == crash
    assert torch.isfinite(prediction.terrain.height).all()
    seen, _, prediction = wall.predicted(predictors["camera"], found)
    assert torch.isfinite(prediction.terrain.height).all()
    assert crash or seen >= THRESHOLD
