"""A wall ahead (paper, figure 9), in scenes on which nothing was tuned or selected: the first nine from seed 93000.

With a lidar beside the cameras every crash is predicted. The shipped encoder alone sees few walls (docs/protocol.md);
it must not predict crashes where there is no wall.
"""

from dataclasses import replace

import pytest
import torch
import wall

from monoforce_ros.perception import choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import CameraSettings, CourseSettings, LiveSettings
from monoforce_ros.synthetic.random_streams import random_stream

HORIZON = 5.0
THRESHOLD = 0.7 * wall.SPEED * HORIZON
"""A robot that covers less than this of the commanded distance has crashed [m]."""


def simulated(seed: int):
    """What is seen of a course, the robot's state, whether there is a wall, and how far the robot drives [m]."""
    random = random_stream(seed, "wall ahead")
    distance = float(random.uniform(2.0, 3.2)) if random.random() < 0.6 else None
    course = replace(
        CourseSettings.draw(seed), wall=distance, grass=None, wall_width=4.0, roughness=float(random.uniform(0.1, 0.5))
    )
    settings = LiveSettings(seed=seed, course=course, camera=CameraSettings())
    observation, state, driven = wall.simulated(settings, HORIZON)
    return observation, state, distance is not None, driven


def predicted(predictor: Predictor, observation, state) -> float:
    """Distance that is predicted [m]; heights must be finite."""
    prediction = wall.predicted(predictor, observation, state)
    assert torch.isfinite(prediction.terrain.height).all()
    return wall.distance(prediction)


@pytest.fixture(scope="module")
def predictors():
    robot = load_robot("husky")
    return {
        # The node's default with a lidar; the cameras' map as it is.
        kind: Predictor(robot, choose_terrain_source(kind, robot, fallback=fallback), horizon=HORIZON)
        for kind, fallback in (("lidar_camera", True), ("camera", False))
    }


@pytest.mark.parametrize(("seed", "crash"), [(seed, seed not in (93001, 93003)) for seed in range(93000, 93009)])
def test_crashes_are_predicted_with_a_lidar_and_no_false_ones_without(predictors, seed, crash):
    observation, state, walled, driven = simulated(seed)
    assert walled == crash == (driven < THRESHOLD)
    assert (predicted(predictors["lidar_camera"], observation, state) < THRESHOLD) == crash
    assert crash or predicted(predictors["camera"], observation, state) >= THRESHOLD
