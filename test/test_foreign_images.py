"""Foreign pictures: with cameras that show something else, paths are hardly worse than with level ground."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording
from monoforce_ros.core import CameraModel, MotionState
from monoforce_ros.evaluation import evaluate_recording
from monoforce_ros.evaluation.tables import FLAT_PHYSICS, PHYSICS
from monoforce_ros.perception import Observation, choose_terrain_source, support_points
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import TerrainDefaults

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


@pytest.mark.parametrize("name", ["husky", "tradr", "warthog"])
@pytest.mark.parametrize(
    "picture",
    [
        np.full((240, 320, 3), 128, np.uint8),
        np.zeros((240, 320, 3), np.uint8),
        np.random.default_rng(2).integers(0, 255, (240, 320, 3), np.uint8),
    ],
    ids=["grey", "black", "noise"],
)
def test_a_picture_that_says_nothing_yields_the_ground_that_carries_the_robot(name, picture, one_thread):
    robot = load_robot(name)
    camera = CameraModel(320, 240, np.array([[200.0, 0, 160], [0, 200.0, 120], [0, 0, 1]]), np.zeros(5))
    tilt = Rotation.from_euler("x", -15.0, degrees=True).as_matrix()
    forward = np.eye(4)
    forward[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ tilt
    forward[:3, 3] = [0.3, 0.0, 0.6 - robot.ground_clearance]
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    source = choose_terrain_source("camera", robot)
    found = source.terrain(Observation(0, None, {"front": picture}, {"front": camera}, {"front": forward}), still)
    ground = float(support_points(robot, still, TerrainDefaults().stiffness)[:, 2].mean())
    off = (found.height - ground)[found.observed].numpy()
    assert abs(np.median(off)) < 0.08 and np.quantile(np.abs(off), 0.95) < 0.16


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
