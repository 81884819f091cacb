"""Speeds of wheels from joint states as real drivers publish them."""

from __future__ import annotations

import numpy as np
import pytest

from monoforce_ros.bags import BagWriter, Recording, builders
from monoforce_ros.bags.wheel_joints import wheel_track
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.messages import decoding

SECOND = 10**9
STEP = SECOND // 20
RADIUS, HALF = 0.2, 0.3


def driven(seconds: float = 20.0, seed: int = 0):
    """Stamps, twists and the speeds of left and right wheels [rad/s] of a drive that turns both ways."""
    random = np.random.default_rng(seed)
    stamps = SECOND + np.arange(int(seconds * 20), dtype=np.int64) * STEP
    twists = np.repeat(random.uniform([-0.3, -1.0], [1.0, 1.0], (len(stamps) // 20 + 1, 2)), 20, axis=0)[: len(stamps)]
    sides = np.stack([twists[:, 0] - HALF * twists[:, 1], twists[:, 0] + HALF * twists[:, 1]], axis=1)
    return stamps, twists, sides / RADIUS


def motion_of(stamps, twists, sign: float = 1.0) -> MotionTrack:
    count = len(stamps)
    zeros = np.zeros(count)
    return MotionTrack(
        stamps=stamps, positions=np.zeros((count, 3)), quaternions=np.tile([0.0, 0, 0, 1], (count, 1)),
        linear_velocities=sign * np.stack([twists[:, 0], zeros, zeros], axis=1),
        angular_velocities=sign * np.stack([zeros, zeros, twists[:, 1]], axis=1),
        frame_id="odom", child_frame_id="base_link",
    )  # fmt: skip


def track_of(samples, commands=None, motion=None):
    stamps, twists, _ = driven()
    sides = {name: decoding.wheel_side(name) for _, joints in samples for name in joints}
    commands = CommandTrack(stamps, twists) if commands is None else commands
    return wheel_track(samples, sides, commands, motion_of(stamps, twists) if motion is None else motion)


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("front_left_wheel_joint", "left"), ("wheelRight", "right"), ("fl_wheel", "left"), ("wheel_RR", "right"),
        ("lr_wheel", "left"), ("rl_wheel_joint", "left"), ("wheelFL", "left"), ("wheel_l", "left"),
        ("r_track", "right"), ("tire_fr", "right"), ("arm_left", None), ("wheel_1", None), ("left_right_wheel", None),
        ("front_left_wheel_steering", None), ("rear_wheel", None), ("", None),
    ],
)  # fmt: skip
def test_sides_of_wheels_by_their_names(name, side):
    assert decoding.wheel_side(name) == side


def test_the_mean_of_each_side_counts():
    names = ["front_left_wheel", "rear_left_wheel_joint", "front_right_wheel", "arm_left"]
    state = builders.joint_state(1, names, [0.0] * 4, [1.0, 3.0, 5.0, 99.0])
    track, texts = track_of([(1, decoding.decode_wheels(state))])
    assert track.speeds.tolist() == [[2.0, 5.0]] and texts == []
    assert track_of([(1, {"front_left_wheel": (0.0, 1.0)})]) == (None, [])
    assert track_of([(1, {"left_track": (np.nan, np.nan), "right_track": (0.0, 1.0)})]) == (None, [])
    assert track_of([]) == (None, [])


@pytest.mark.parametrize("reversed_wheels", [(), ("right",), ("left",), ("left", "right")])
def test_wheels_that_are_mounted_mirrored_are_turned(reversed_wheels):
    stamps, _, speeds = driven()
    signs = [-1.0 if side in reversed_wheels else 1.0 for side in ("left", "right")]
    noise = np.random.default_rng(1).normal(0.0, 0.2, speeds.shape)
    samples = [
        (int(stamp), {"left_wheel": (0.0, signs[0] * left), "right_wheel": (0.0, signs[1] * right)})
        for stamp, (left, right) in zip(stamps, speeds + noise, strict=True)
    ]
    track, texts = track_of(samples)
    np.testing.assert_allclose(track.speeds, speeds + noise)
    assert len(texts) == (1 if reversed_wheels else 0)
    assert all(f"{side}_wheel" in texts[0] for side in reversed_wheels)


def test_one_of_two_wheels_of_a_side_does_not_cancel_the_other():
    stamps, _, speeds = driven()
    samples = [
        (int(stamp), {"fl_wheel": (0.0, left), "rl_wheel": (0.0, -left), "fr_wheel": (0.0, right)})
        for stamp, (left, right) in zip(stamps, speeds, strict=True)
    ]
    track, texts = track_of(samples)
    np.testing.assert_allclose(track.speeds, speeds)
    assert "rl_wheel: the speeds have the opposite sign" in texts[0]


def test_wheels_are_not_turned_where_the_commands_have_the_wrong_sign():
    stamps, twists, speeds = driven()
    samples = [
        (int(stamp), {"left_wheel": (0.0, left), "right_wheel": (0.0, right)})
        for stamp, (left, right) in zip(stamps, speeds, strict=True)
    ]
    track, texts = track_of(samples, commands=CommandTrack(stamps, -twists))
    np.testing.assert_allclose(track.speeds, speeds)
    assert texts == []


@pytest.mark.parametrize("rate", [np.nan, 0.0])
@pytest.mark.parametrize("wrapped", [False, True])
def test_missing_speeds_follow_from_the_angles(rate, wrapped):
    stamps, _, speeds = driven()
    angles = np.cumsum(speeds, axis=0) / 20.0
    if wrapped:
        angles = np.mod(angles + np.pi, 2 * np.pi) - np.pi
    samples = [
        (int(stamp), {"left_wheel": (left, rate), "right_wheel": (right, rate)})
        for stamp, (left, right) in zip(stamps, angles, strict=True)
    ]
    track, texts = track_of(samples)
    np.testing.assert_allclose(track.speeds, speeds[1:], atol=1e-9)
    assert "they follow from the angles" in texts[0]
    assert (track.stamps == stamps[:-1] + STEP // 2).all()


def test_wheels_in_messages_of_their_own_belong_together():
    stamps, _, speeds = driven()
    samples = []
    for stamp, (left, right) in zip(stamps.tolist(), speeds, strict=True):
        samples += [(stamp, {"left_wheel": (0.0, left)}), (stamp + STEP // 2, {"right_wheel": (0.0, right)})]
    track, _ = track_of(samples)
    np.testing.assert_allclose(track.speeds[:, 0], speeds[1:, 0])
    np.testing.assert_allclose(track.speeds[:, 1], 0.5 * (speeds[1:, 1] + speeds[:-1, 1]))


def test_a_gap_of_one_side_is_not_bridged():
    stamps, _, speeds = driven()
    samples = []
    for index, (stamp, (left, right)) in enumerate(zip(stamps.tolist(), speeds, strict=True)):
        samples.append((stamp, {"left_wheel": (0.0, left)}))
        if not 100 <= index < 200:
            samples.append((stamp + 1000, {"right_wheel": (0.0, right)}))
    track, _ = track_of(samples)
    assert not ((track.stamps > stamps[100]) & (track.stamps < stamps[199])).any()
    assert len(track) > 290


def test_a_recording_says_which_wheels_it_turned(tmp_path):
    stamps, twists, speeds = driven()
    messages, x, yaw = [], np.zeros(2), 0.0
    for stamp, (speed, rate), (left, right) in zip(stamps.tolist(), twists, speeds, strict=True):
        pose = [np.cos(yaw / 2), np.sin(yaw / 2)]
        messages += [
            ("/odom", stamp, builders.odometry(stamp, "odom", "base_link", [*x, 0.0], [0, 0, pose[1], pose[0]],
                                               [speed, 0, 0], [0, 0, rate])),
            ("/cmd_vel", stamp, builders.twist(speed, rate)),
            ("/joint_states", stamp, builders.joint_state(stamp, ["wheel_fl", "wheel_fr"], [], [left, -right])),
        ]  # fmt: skip
        x = x + speed * np.array([np.cos(yaw), np.sin(yaw)]) / 20.0
        yaw += rate / 20.0
    with BagWriter(tmp_path / "bag") as bag:
        for topic, stamp, message in messages:
            bag.write(topic, message, stamp)
    recording = Recording.open(tmp_path / "bag")
    np.testing.assert_allclose(recording.wheels.speeds, speeds)
    assert any("wheel_fr: the speeds have the opposite sign" in text for text in recording.choices)
