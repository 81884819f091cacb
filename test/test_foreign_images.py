"""Foreign pictures: with cameras that show something else, paths are hardly worse than with level ground."""

from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.bags import Recording
from monoforce_ros.evaluation import evaluate_recording
from monoforce_ros.evaluation.tables import FLAT_PHYSICS, PHYSICS
from monoforce_ros.perception import choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot

HORIZON = 3.0


class Foreign:
    """A terrain source whose images are replaced before they reach it."""

    def __init__(self, source, change):
        self.source, self.change = source, change
        self.sensors, self.grid = source.sensors, source.grid

    def terrain(self, observation, motion):
        images = {name: np.ascontiguousarray(self.change(image)) for name, image in observation.images.items()}
        return self.source.terrain(replace(observation, images=images), motion)


def shuffled(image):
    tiles = [np.hsplit(row, 4) for row in np.vsplit(image, 4)]
    order = np.random.default_rng(1).permutation(16)
    return np.vstack([np.hstack([tiles[i // 4][i % 4] for i in order[4 * r : 4 * r + 4]]) for r in range(4)])


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image[::-1],
        shuffled,
        lambda image: np.full_like(image, 8),
        lambda image: np.random.default_rng(2).integers(0, 255, image.shape, np.uint8),
    ],
    ids=["upside down", "shuffled", "covered lens", "noise"],
)
def test_foreign_pictures_do_no_harm(demo_bag, change, one_thread):
    robot = load_robot("husky")
    recording = Recording.open(demo_bag).in_base_frame(robot.base_frame)
    source = Foreign(choose_terrain_source("camera", robot, fallback=True), change)
    found = evaluate_recording(
        recording, Predictor(robot, source, horizon=HORIZON), image_topics=tuple(recording.images), horizons=(HORIZON,),
        stride=0.5, quiet=True, minimum_duration=1.0,
    )  # fmt: skip
    own, level = (found.summary(method)[HORIZON][0].mean for method in (PHYSICS, FLAT_PHYSICS))
    assert own <= 1.05 * level
