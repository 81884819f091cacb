"""Measured motion and commands over time; the frame that predictions are made in."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack, MotionState, MotionTrack, StaleDataError, quaternions, transform_points

SECOND = 10**9


def track(times, headings=None) -> MotionTrack:
    times = np.asarray(times, float)
    headings = np.zeros(len(times)) if headings is None else np.asarray(headings)
    return MotionTrack(
        stamps=(times * SECOND).astype(np.int64),
        positions=np.stack([times, 0 * times, 0 * times], axis=1),
        quaternions=np.stack([0 * times, 0 * times, np.sin(headings / 2), np.cos(headings / 2)], axis=1),
        linear_velocities=np.tile([1.0, 0, 0], (len(times), 1)),
        angular_velocities=np.zeros((len(times), 3)),
    )


def test_motion_is_interpolated_also_across_half_a_turn():
    state = track([0, 1], [np.radians(170), np.radians(-170)]).at(SECOND // 2, maximum_gap=1.0)
    assert state.position[0] == pytest.approx(0.5)
    assert abs(state.heading) == pytest.approx(np.pi)


@pytest.mark.parametrize("seconds", [-1.0, 12.0, 5.0])
def test_no_motion_is_invented_far_from_a_measurement(seconds):
    with pytest.raises(StaleDataError, match="nearest odometry is"):
        track([0, 1, 9, 10]).at(int(seconds * SECOND), maximum_gap=0.5)


def test_close_to_one_side_of_a_gap_the_motion_goes_on_from_that_side():
    assert track([0, 1, 9, 10]).at(int(1.2 * SECOND)).position[0] == pytest.approx(1.2)
    assert track([0, 1, 9, 10]).at(int(8.9 * SECOND)).position[0] == pytest.approx(8.9)


def test_an_empty_track_says_so():
    with pytest.raises(StaleDataError, match="no odometry"):
        track([]).at(0)


def test_commands_hold_until_the_next_and_expire():
    commands = CommandTrack(np.array([1, 2]) * SECOND, np.array([[0.5, 0.1], [1.0, 0.0]]))
    at = (np.array([0.5, 1.0, 1.9, 2.0, 2.4, 2.6]) * SECOND).astype(np.int64)
    assert commands.sample(at, timeout=0.5)[:, 0].tolist() == [0.0, 0.5, 0.0, 1.0, 1.0, 0.0]
    assert commands.sample(at)[:, 0].tolist() == [0.0, 0.5, 0.5, 1.0, 1.0, 1.0]


def test_the_terrain_frame_is_level_at_the_robot_and_along_its_heading():
    rotation = Rotation.from_euler("xyz", [0.2, -0.3, 1.1]).as_matrix()
    state = MotionState(0, np.array([3.0, -2.0, 1.0]), rotation, np.zeros(3), np.zeros(3))
    transform = state.odometry_from_terrain
    np.testing.assert_allclose(transform[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(transform_points(transform, np.zeros(3)), [3, -2, 1])
    forward = state.terrain_from_base[:3, 0]
    assert forward[1] == pytest.approx(0, abs=1e-12) and forward[0] > 0
    np.testing.assert_allclose(state.terrain_from_base[:3, 3], 0, atol=1e-12)


def test_what_was_seen_before_is_seen_from_where_the_robot_is_now():
    moved = track([0, 1], [0.0, np.pi / 2])
    pose = moved.base_between(0, SECOND, maximum_gap=1.0)
    # A metre ahead of the start is where the robot is now; two ahead are to its right.
    np.testing.assert_allclose(
        transform_points(pose, np.array([[1.0, 0, 0], [2.0, 0, 0.5]])), [[0, 0, 0], [0, -1, 0.5]], atol=1e-9
    )
    np.testing.assert_array_equal(moved.base_between(5, 5), np.eye(4))
    with pytest.raises(StaleDataError):
        moved.base_between(0, 9 * SECOND)


def test_the_motion_goes_on_after_the_last_measurement_as_it_did():
    turning = replace(track([0, 1]), angular_velocities=np.tile([0, 0, 2.0], (2, 1)))
    state = turning.at(int(1.2 * SECOND))
    # An arc of radius 0.5 m, begun at x = 1.
    assert state.heading == pytest.approx(0.4) and state.stamp == int(1.2 * SECOND)
    np.testing.assert_allclose(state.position, [1 + 0.5 * np.sin(0.4), 0.5 * (1 - np.cos(0.4)), 0], atol=2e-3)
    assert track([0, 1]).at(int(-0.2 * SECOND)).position[0] == 0.0


def test_quaternions_are_those_of_the_rotations():
    expected = Rotation.from_quat(np.random.default_rng(3).normal(size=(500, 4)))
    half_turns = Rotation.from_rotvec(np.pi * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, 0, 0]]))
    for rotations in (expected, half_turns):
        found = quaternions(rotations.as_matrix())
        assert float(np.max((Rotation.from_quat(found) * rotations.inv()).magnitude())) < 1e-7
    assert quaternions(np.full((2, 3, 3), np.nan)).shape == (2, 4)
    assert quaternions(np.zeros((0, 3, 3))).shape == (0, 4)
    assert np.isnan(quaternions(np.full((3, 3), np.nan))).all()
