"""Where a goal lies in the odometry frame: which frames move with the robot, and at what time."""

import numpy as np
import pytest

from monoforce_ros.core import FrameError, MotionState, PoseHistory, TransformHistory, TransformTree, pose_matrix
from monoforce_ros.nodes.course import TRANSFORM_TIMEOUT, Course, CourseFrames

SECOND = 10**9


class Transforms:
    """The part of a TransformListener that courses need."""

    def __init__(self, *edges: tuple[str, str]):
        self.tree, self.history, self.unavailable = TransformTree(), TransformHistory(), ""
        for parent, child in edges:
            self.add(parent, child, [0.0] * 6)

    def add(self, parent: str, child: str, pose: list[float]) -> None:
        self.tree.add(parent, child, pose_matrix(pose))
        self.history.add(parent, child, pose_matrix(pose), None)


def frames_at(transforms: Transforms, *, base: str = "base_link", child: str = "", odometry: str = "odom"):
    """Courses of a robot that drove from the origin to (9, 0) at 1 m/s."""
    frames = CourseFrames(transforms, transforms.history)
    for second in range(10):
        motion = MotionState(second * SECOND, np.array([second, 0.0, 0.0]), np.eye(3), np.zeros(3), np.zeros(3))
        frames.add_odometry(odometry, motion, {base: np.eye(4), child or base: np.eye(4)})
    return frames


def course(frame: str, stamp: float = 0.0) -> Course:
    return Course("goal", frame, round(stamp * SECOND), np.array([[2.0, 0.0, 0.0]]), 100.0)


STANDARD = (("map", "odom"), ("odom", "base_footprint"), ("base_footprint", "base_link"), ("base_link", "lidar"))


@pytest.mark.parametrize(
    ("edges", "frame", "fixed"),
    [
        (STANDARD, "base_link", True),
        (STANDARD, "lidar", True),
        # It lies between the odometry frame and the base, and moves as the base does.
        (STANDARD, "base_footprint", True),
        (STANDARD, "map", False),
        ((*STANDARD, ("utm", "map"), ("map", "door")), "door", False),
        # The path from the odometry frame to the base is not on TF.
        ((("map", "odom"), ("base_link", "lidar")), "lidar", True),
        ((("map", "odom"), ("base_link", "lidar")), "map", False),
        # Published the other way round, as some localisations do.
        ((("odom", "map"), ("odom", "base_link")), "map", False),
        ((("base_link", "odom"), ("odom", "map"), ("base_link", "lidar")), "lidar", True),
        # The robot's frames have other names than the parameter says.
        ((("map", "odom"), ("odom", "chassis"), ("chassis", "lidar")), "lidar", True),
        ((("map", "odom"), ("odom", "chassis"), ("chassis", "lidar")), "map", False),
    ],
)
def test_a_course_in_a_frame_that_moves_with_the_robot_is_transformed_once(edges, frame, fixed):
    frames = frames_at(Transforms(*edges))
    kept, _ = frames.resolved(course(frame), 100.0)
    assert kept.frame_id == ("odom" if fixed else frame)
    again, points = frames.resolved(kept, 130.0)
    assert again is kept
    motion = MotionState(10 * SECOND, np.array([10.0, 0.0, 0.0]), np.eye(3), np.zeros(3), np.zeros(3))
    frames.add_odometry("odom", motion, {"base_link": np.eye(4)})
    assert frames.resolved(kept, 131.0)[1].tolist() == points.tolist()


def test_a_course_in_the_map_follows_each_correction():
    transforms = Transforms(*STANDARD)
    frames = frames_at(transforms)
    for shift in (0.0, 1.0, -3.0):
        transforms.add("map", "odom", [shift, 0.0, 0.0, 0.0, 0.0, 0.0])
        kept, points = frames.resolved(course("map", stamp=4.0), 500.0)
        assert kept.frame_id == "map" and points[0, 0] == pytest.approx(2.0 - shift)


def test_a_course_counts_from_its_stamp_or_from_now_without_one():
    frames = frames_at(Transforms(*STANDARD))
    assert frames.resolved(course("base_link"), 100.0)[1][0, 0] == pytest.approx(9.0 + 2.0)
    assert frames.resolved(course("base_link", 3.5), 100.0)[1][0, 0] == pytest.approx(3.5 + 2.0)


def test_the_pose_of_a_sensor_that_turns_is_that_of_the_stamp():
    transforms = Transforms(("odom", "base_link"))
    for second in (3, 4):
        turned = pose_matrix([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2 * (second - 3)])
        transforms.tree.add("base_link", "camera", turned)
        transforms.history.add("base_link", "camera", turned, second * SECOND)
    points = frames_at(transforms).resolved(course("camera", 3.5), 100.0)[1]
    np.testing.assert_allclose(points[0], [3.5 + np.sqrt(2.0), np.sqrt(2.0), 0.0], atol=1e-9)
    with pytest.raises(FrameError, match="at the goal's stamp there is no transform between 'base_link' and 'camera'"):
        frames_at(transforms).resolved(course("camera", 6.0), 100.0)


@pytest.mark.parametrize(
    ("frame", "stamp", "now", "message"),
    [
        ("attic", 0.0, 100.0, "the goal is in frame 'attic', odometry in 'odom': no transform has 'attic'"),
        ("base_link", 12.0, 100.0, "there is no odometry: the newest one is 3.00 s older"),
        ("base_link", -5.0, 100.0, "there is no odometry: the oldest one kept is 5.00 s newer"),
        ("base_link", 0.0, 101.0 + TRANSFORM_TIMEOUT, "the goal without a stamp is too old"),
    ],
)
def test_a_course_without_a_transform_is_an_error_that_names_what_is_missing(frame, stamp, now, message):
    with pytest.raises(FrameError, match=message):
        frames_at(Transforms(*STANDARD)).resolved(course(frame, stamp), now)


def test_the_history_forgets_after_ten_seconds_and_starts_anew_after_a_backward_jump():
    history = PoseHistory()
    for second in range(30):
        history.add(second * SECOND, pose_matrix([second, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert history.at(18 * SECOND) is None and history.at(19 * SECOND)[0, 3] == 19.0
    history.add(29 * SECOND - 10**8, np.eye(4))
    assert history.at(29 * SECOND)[0, 3] == 29.0, "a late message is no jump"
    history.add(5 * SECOND, np.eye(4))
    assert history.at(29 * SECOND) is None and history.at(5 * SECOND) is not None
