"""Frames on the robot: transforms, prefixes, and odometry of another frame than the base."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.core import (
    FrameError,
    MotionState,
    MotionTrack,
    RobotFrames,
    TransformTree,
    homogeneous,
    pose_matrix,
)


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return homogeneous(np.eye(3), np.array([x, y, z]))


@pytest.fixture
def tree() -> TransformTree:
    return TransformTree({
        ("base_footprint", "base_link"): at(0.0, 0.0, 0.13),
        ("base_link", "lidar"): pose_matrix([0.2, 0.0, 0.6, 0.0, 0.0, np.pi / 2]),
        ("/odom", "/base_footprint"): at(5.0),
        ("earth", "moon"): at(3.8e8),
    })  # fmt: skip


def test_a_path_is_found_up_and_down_the_tree(tree):
    np.testing.assert_allclose(tree.find("base_link", "base_footprint")[:3, 3], [0, 0, -0.13])
    np.testing.assert_allclose((tree.find("odom", "lidar") @ [1, 0, 0, 1])[:3], [5.2, 1.0, 0.73], atol=1e-12)
    np.testing.assert_allclose(tree.find("/lidar", "lidar"), np.eye(4))
    assert tree.find("base_link", "moon") is None and tree.find("base_link", "nowhere") is None


def test_the_transforms_of_a_path_are_named(tree):
    edges = [("odom", "base_footprint"), ("base_footprint", "base_link"), ("base_link", "lidar")]
    assert tree.path("odom", "lidar") == edges and tree.path("lidar", "/odom") == edges[::-1]
    assert tree.path("lidar", "nowhere") == tree.path("odom", "moon") == []
    assert tree.path("lidar", "lidar") == []


def test_a_missing_path_says_where_it_breaks(tree):
    found = tree.missing_path("base_link", "moon")
    assert found.startswith("'base_link' is connected with base_footprint, lidar, odom, and 'moon' with earth")
    assert "no transform has 'nowhere' (frames there: base_footprint" in tree.missing_path("lidar", "nowhere")


def test_a_frame_with_two_parents_connects_both(tree):
    tree.add("camera", "lidar", at(1.0))
    assert tree.find("base_link", "camera") is not None and tree.find("odom", "lidar") is not None


def test_a_loop_does_not_hang(tree):
    tree.add("lidar", "base_footprint", np.eye(4))
    assert tree.find("base_link", "moon") is None


def test_data_in_the_odometry_frame_use_the_odometry_of_their_stamp(tree):
    """Clouds of lidar odometry: where the robot was then, not where the newest transform puts it."""
    frames = RobotFrames("base_link", {"lidar": at(9.0)})
    tree.add("odom", "map", at(100.0))
    then = {"odometry_frame": "/odom", "odometry_from_base": lambda: pose_matrix([2.0, 1.0, 0.0, 0.0, 0.0, np.pi / 2])}
    np.testing.assert_allclose((frames.sensor_pose("odom", tree, **then) @ [2, 3, 0, 1])[:3], [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose((frames.sensor_pose("map", tree, **then) @ [-98, 3, 0, 1])[:3], [2, 0, 0], atol=1e-12)
    assert frames.sensor_pose("lidar", tree, **then)[0, 3] == pytest.approx(0.2)
    with pytest.raises(FrameError, match="'moon' on the robot is unknown"):
        frames.sensor_pose("moon", tree, **then)


def test_sensor_poses_come_from_transforms_before_the_robot_file(tree):
    frames = RobotFrames("base_link", {"lidar": at(9.0), "camera": at(7.0)})
    assert frames.sensor_pose("lidar", tree)[0, 3] == pytest.approx(0.2)
    assert frames.sensor_pose("camera", tree)[0, 3] == 7.0
    with pytest.raises(FrameError, match=r"'sonar' on the robot is unknown.*path from 'base_link' to 'sonar'"):
        frames.sensor_pose("sonar", tree)
    with pytest.raises(FrameError, match="frame_id is empty"):
        frames.sensor_pose("", tree)


def test_prefixed_frames_are_those_of_their_robot(tree):
    frames = RobotFrames("base_link", {"lidar": at(9.0)})
    assert frames.sensor_pose("robot1/lidar", TransformTree())[0, 3] == 9.0
    tree.add("robot1/base_link", "robot1/lidar", at(0.4))
    tree.add("robot1/base_footprint", "robot1/base_link", at(0.0, 0.0, 0.2))
    assert frames.sensor_pose("robot1/lidar", tree)[0, 3] == 0.4
    assert frames.odometry_child("robot1/base_footprint", tree)[2, 3] == -0.2
    np.testing.assert_allclose(frames.odometry_child("robot1/base_link", tree), np.eye(4))
    # A name that is prefixed by the user is taken as it is.
    assert RobotFrames("robot1/base_link").odometry_child("robot1/base_footprint", tree)[2, 3] == -0.2


def test_odometry_of_another_frame_needs_its_offset(tree):
    frames = RobotFrames("base_link")
    assert frames.odometry_child("base_footprint", tree)[2, 3] == -0.13
    np.testing.assert_allclose(frames.odometry_child("", tree), np.eye(4))
    with pytest.raises(FrameError, match=r"the frame 'imu'.*refer to 'base_link'.*no transform has 'imu'.*/tf_static"):
        frames.odometry_child("imu", tree)
    given = RobotFrames("base_link", odometry_child_pose=at(0.3))
    assert given.odometry_child("imu", TransformTree())[0, 3] == 0.3


def test_a_base_frame_that_is_elsewhere_than_the_robot_file_s_is_refused(tree):
    frames = RobotFrames("base_footprint", file_frame="base_link")
    with pytest.raises(
        FrameError, match=r"got 'base_footprint', expected 'base_link'.* 0.130 m away.*Leave base_frame"
    ):
        frames.odometry_child("base_footprint", tree)
    # Without transforms, and for another name of the same place, nothing contradicts the user.
    np.testing.assert_allclose(frames.odometry_child("base_footprint", TransformTree()), np.eye(4))
    same = TransformTree({("base_footprint", "base_link"): at(0.0)})
    np.testing.assert_allclose(frames.odometry_child("base_footprint", same), np.eye(4))


def test_the_motion_of_the_base_follows_from_that_of_a_frame_on_it():
    """A frame ahead of the base that is turned against it, on a circle: the base's motion is known in closed form."""
    pose = pose_matrix([0.5, 0.2, -0.1, 0.1, -0.2, 0.7])
    rate, radius, times = 0.4, 3.0, np.arange(0.0, 2.0, 0.1)
    base = [
        homogeneous(
            Rotation.from_euler("z", rate * t).as_matrix(),
            np.array([radius * np.sin(rate * t), radius * (1 - np.cos(rate * t)), 0.3]),
        )
        for t in times
    ]
    child = np.array([matrix @ pose for matrix in base])
    turn = pose[:3, :3].T
    speed = turn @ (np.array([rate * radius, 0, 0]) + np.cross([0, 0, rate], pose[:3, 3]))
    track = MotionTrack(
        (times * 1e9).astype(np.int64), child[:, :3, 3], Rotation.from_matrix(child[:, :3, :3]).as_quat(),
        np.tile(speed, (len(times), 1)), np.tile(turn @ [0, 0, rate], (len(times), 1)), "odom", "imu",
    )  # fmt: skip
    moved = track.of_base(pose, "base_link")
    np.testing.assert_allclose(moved.positions, [matrix[:3, 3] for matrix in base], atol=1e-12)
    np.testing.assert_allclose(moved.linear_velocities, np.tile([rate * radius, 0, 0], (len(times), 1)), atol=1e-12)
    np.testing.assert_allclose(moved.angular_velocities, np.tile([0, 0, rate], (len(times), 1)), atol=1e-12)
    assert moved.child_frame_id == "base_link"
    state = MotionState(0, child[7, :3, 3], child[7, :3, :3], speed, turn @ [0, 0, rate]).of_base(pose)
    np.testing.assert_allclose(state.odometry_from_base, base[7], atol=1e-12)
    np.testing.assert_allclose(state.linear_velocity, [rate * radius, 0, 0], atol=1e-12)


def test_a_pose_has_six_numbers():
    with pytest.raises(ValueError, match="got 3 numbers, expected x, y, z, roll, pitch, yaw"):
        pose_matrix([1.0, 2.0, 3.0])
