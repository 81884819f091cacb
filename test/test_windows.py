"""Smoothed motion, windows and frames by time, the basis of all offline processing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, Frame, Recording, builders, cut_windows, nearest_frame, smooth
from monoforce_ros.core import CommandTrack, MotionTrack, StaleDataError, nearest_stamp
from monoforce_ros.messages.decoding import decode_cloud

START = 1_700_000_000_000_000_000


def track(times, positions, rotations, **kinds):
    zeros = np.zeros((len(times), 3))
    return MotionTrack(
        stamps=START + np.rint(np.asarray(times) * 1e9).astype(np.int64),
        positions=np.asarray(positions, float),
        quaternions=rotations.as_quat(),
        linear_velocities=kinds.get("linear", zeros),
        angular_velocities=kinds.get("angular", zeros),
    )


def planar(times, speed, rate):
    """Motion on a plane at changing speed and yaw rate, integrated in fine steps."""
    fine = np.arange(0.0, times[-1] + 1e-9, 1e-3)
    heading = np.concatenate([[0.0], np.cumsum(rate(fine)[:-1]) * 1e-3])
    x = np.concatenate([[0.0], np.cumsum((speed(fine) * np.cos(heading))[:-1]) * 1e-3])
    y = np.concatenate([[0.0], np.cumsum((speed(fine) * np.sin(heading))[:-1]) * 1e-3])
    index = np.rint(times / 1e-3).astype(int)
    angles = np.stack([heading[index], np.zeros(len(times)), np.zeros(len(times))], axis=1)
    return np.stack([x[index], y[index], np.zeros(len(times))], axis=1), Rotation.from_euler("ZYX", angles)


def noisy(positions, rotations, position_noise, rotation_noise, seed=0):
    random = np.random.default_rng(seed)
    turned = rotations * Rotation.from_rotvec(rotation_noise * random.standard_normal((len(positions), 3)))
    return positions + position_noise * random.standard_normal(positions.shape), turned


TIMES = np.arange(0.0, 40.0, 0.05)


@pytest.mark.parametrize(("position_noise", "degrees"), [(0.01, 0.5), (0.03, 1.5)])
def test_noise_is_estimated_and_removed(position_noise, degrees):
    def speed(t):
        return 0.5 + 0.4 * np.sin(0.6 * t)

    def rate(t):
        return 0.6 * np.sin(0.35 * t)

    true, rotations = planar(TIMES, speed, rate)
    positions, turned = noisy(true, rotations, position_noise, np.radians(degrees))
    smoothed = smooth(track(TIMES, positions, turned))
    assert smoothed.position_noise == pytest.approx(position_noise, rel=0.15)
    assert smoothed.rotation_noise == pytest.approx(np.radians(degrees), rel=0.15)
    inner = slice(20, -20)
    assert (smoothed.motion.positions - true)[inner].std() < 0.35 * position_noise
    assert (smoothed.motion.linear_velocities[:, 0] - speed(TIMES))[inner].std() < 2.0 * position_noise
    assert (smoothed.motion.angular_velocities[:, 2] - rate(TIMES))[inner].std() < 2.0 * np.radians(degrees)


def test_a_given_noise_is_removed():
    true, rotations = planar(TIMES, lambda t: 0.5 + 0 * t, lambda t: 0.3 * np.sin(0.5 * t))
    positions, turned = noisy(true, rotations, 0.02, 0.01)
    motion = track(TIMES, positions, turned)
    smoothed = smooth(motion, position_noise=0.02, rotation_noise=0.01)
    assert (smoothed.motion.positions - motion.positions).std() == pytest.approx(0.02, rel=0.05)
    with pytest.raises(ValueError, match="position noise: got -1"):
        smooth(motion, position_noise=-1.0)


@pytest.mark.parametrize(
    ("speed", "rate"), [(-0.6, 0.4), (0.0, 0.8), (0.0, 0.0), (0.5, -0.5)], ids=["reverse", "spin", "stand", "forward"]
)
def test_yaw_rate_is_right_whichever_way_the_robot_goes(speed, rate):
    true, rotations = planar(TIMES, lambda t: speed + 0 * t, lambda t: rate + 0 * t)
    positions, turned = noisy(true, rotations, 0.01, np.radians(0.5))
    motion = smooth(track(TIMES, positions, turned)).motion
    inner = slice(20, -20)
    assert np.abs(motion.angular_velocities[inner, 2] - rate).max() < 0.06
    assert np.abs(motion.linear_velocities[inner, 0] - speed).max() < 0.06
    assert np.abs(motion.linear_velocities[inner, 1]).max() < 0.08


def test_rates_in_base_axes_are_right_on_a_slope():
    angles = np.stack([0.4 * TIMES, np.full(len(TIMES), 0.3), np.full(len(TIMES), -0.2)], axis=1)
    rotations = Rotation.from_euler("ZYX", angles)
    motion = smooth(track(TIMES, np.zeros((len(TIMES), 3)), rotations)).motion
    expected = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / 0.05
    np.testing.assert_allclose(motion.angular_velocities[5:-5], expected[5:-4], atol=2e-3)


def test_gaps_and_jumps_of_the_localisation_are_not_smoothed_over():
    times = np.concatenate([np.arange(0, 10, 0.05), np.arange(15, 25, 0.05)])
    positions = np.stack([0.5 * times, 0 * times, 0 * times], axis=1)
    positions[300:] += 4.0
    smoothed = smooth(track(times, positions, Rotation.identity(len(times))))
    assert [(s.start, s.stop) for s in smoothed.stretches] == [(0, 200), (200, 300), (300, 400)]
    np.testing.assert_allclose(smoothed.motion.positions, positions, atol=1e-6)
    np.testing.assert_allclose(smoothed.motion.linear_velocities[:, 0], 0.5, atol=1e-6)


def test_windows_carry_the_commands_before_them():
    true, rotations = planar(TIMES, lambda t: 0.5 + 0 * t, lambda t: 0 * t)
    changes = np.array([0.0, 3.9, 7.0])
    commands = CommandTrack(
        START + np.rint(changes * 1e9).astype(np.int64), np.array([[0.1, 0.0], [0.2, 0.3], [0.5, 0.0]])
    )
    windows = cut_windows(track(TIMES, true, rotations), commands, length=2.0, stride=1.0, history=1.5)
    assert len(windows) == 38
    assert windows.history == 150
    assert windows.twists.shape == (38, 350, 2)
    fifth = windows.twists[5]  # starts at 5 s: its history reaches back to 3.5 s, across the change at 3.9 s
    assert (fifth[:40, 0] == 0.1).all()
    assert (fifth[40:350, 0] == 0.2).all()
    assert (windows.twists[0][:150] == 0.0).all()  # before the first command
    np.testing.assert_allclose(windows.positions[5, :, 0], 2.5 + 0.5 * windows.times, atol=1e-3)


def test_windows_with_a_gap_are_left_out_and_none_at_all_is_an_error():
    times = np.concatenate([np.arange(0, 10, 0.05), np.arange(12, 20, 0.05)])
    motion = track(times, np.zeros((len(times), 3)), Rotation.identity(len(times)))
    commands = CommandTrack(np.zeros(0, np.int64), np.zeros((0, 2)))
    starts = [(s.stamp - START) * 1e-9 for s in cut_windows(motion, commands, length=3.0).starts]
    assert starts == pytest.approx([0, 1, 2, 3, 4, 5, 6, 7, 12, 13, 14, 15, 16])
    with pytest.raises(ValueError, match=r"got 20.0 s of odometry, expected at least 30 s"):
        cut_windows(motion, commands, length=30.0)


def frames_at(*seconds):
    return [Frame("/topic", START + round(1e9 * second), 0) for second in seconds]


@pytest.mark.parametrize("limit", [0.05, 0.25, np.inf])
def test_the_nearest_frame_is_taken_within_the_limit_and_none_beyond(limit):
    frames = frames_at(0.0, 0.2, 0.5, 1.0)
    for nanoseconds in range(-400_000_000, 1_600_000_000, 10_000_000):
        stamp = START + nanoseconds + 1
        distances = [abs(frame.stamp - stamp) for frame in frames]
        expected = frames[int(np.argmin(distances))] if min(distances) <= limit * 1e9 else None
        assert nearest_frame(frames, stamp, limit=limit) == expected
    assert nearest_frame([], START, limit=limit) is None


def test_the_limit_itself_counts_and_a_nanosecond_more_does_not():
    frames = frames_at(0.0, 1.0)
    assert nearest_frame(frames, START - 50_000_000, limit=0.05) == frames[0]
    assert nearest_frame(frames, START + 50_000_000, limit=0.05) == frames[0]
    assert nearest_frame(frames, START - 50_000_001, limit=0.05) is None
    assert nearest_frame(frames, START + 50_000_001, limit=0.05) is None
    # Doubles would not resolve differences of 10 ns at stamps of this size.
    stamps = np.array([START, START + 10], np.int64)
    assert [nearest_stamp(stamps, START + shift) for shift in (0, 4, 6, 10, 99)] == [0, 0, 1, 1, 1]
    assert nearest_stamp(stamps[:0], START) is None


def test_frames_of_several_topics_are_paired_within_the_limit_and_not_beyond(tmp_path):
    with BagWriter(tmp_path / "drive") as bag:
        for i in range(40):
            at = START + i * 50_000_000
            if not 20 <= i < 32:
                message = builders.odometry(at, "odom", "base_link", [i, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3)
                bag.write("/odom", message, at)
        for i in range(10):
            at = START + i * 200_000_000
            bag.write("/left/image_raw", builders.image(at, "left", np.full((2, 2, 3), i, np.uint8)), at)
            late = at + (30 if i < 5 else 90) * 1_000_000
            bag.write("/right/image_raw", builders.image(late, "right", np.full((2, 2, 3), i, np.uint8)), late)
            bag.write("/points", builders.point_cloud(at + 10_000_000, "lidar", np.ones((3, 3))), at + 10_000_000)
    recording = Recording.open(tmp_path / "drive")
    left, right = recording.images["/left/image_raw"], recording.images["/right/image_raw"]
    assert len(left) == len(right) == len(recording.clouds) == 10
    pairs = [nearest_frame(right, frame.stamp, limit=0.05) for frame in left]
    assert [pair and pair.stamp - frame.stamp for pair, frame in zip(pairs, left, strict=True)] == (
        5 * [30_000_000] + 5 * [None]
    )
    assert all((recording.image(pairs[i]) == i).all() for i in range(5))
    clouds = [nearest_frame(recording.clouds, frame.stamp, limit=0.05) for frame in left]
    assert [cloud.stamp - frame.stamp for cloud, frame in zip(clouds, left, strict=True)] == 10 * [10_000_000]
    assert nearest_frame(recording.clouds, left[0].stamp, limit=0.009) is None

    def has_odometry(frame):
        try:
            return recording.motion.at(frame.stamp, maximum_gap=0.1).stamp == frame.stamp
        except StaleDataError:
            return False

    assert [has_odometry(frame) for frame in left].count(False) == 2


def test_windows_do_not_span_a_jump_of_the_localisation():
    times = np.arange(0.0, 20.0, 0.05)
    positions = np.c_[times + 3.0 * (times >= 10.0), np.zeros((len(times), 2))]
    motion = track(times, positions, Rotation.identity(len(times)))
    commands = CommandTrack(motion.stamps, np.tile([1.0, 0.0], (len(times), 1)))
    smoothed = smooth(motion)
    assert len(smoothed.stretches) == 2
    windows = cut_windows(smoothed.motion, commands, length=5.0, stretches=smoothed.stretches)
    moved = np.linalg.norm(windows.positions[:, -1] - windows.positions[:, 0], axis=1)
    assert len(windows) >= 8 and moved.max() < 5.2
    assert len(cut_windows(smoothed.motion, commands, length=5.0)) > len(windows)


def test_clouds_received_at_one_time_keep_their_own_stamps(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(40):
            stamp = START + i * 50_000_000
            received = START + (i // 2) * 100_000_000
            message = builders.odometry(stamp, "odom", "base_link", [0, 0, 0], [0, 0, 0, 1], [0] * 3, [0] * 3)
            bag.write("/odom", message, received)
            bag.write("/points", builders.point_cloud(stamp, "lidar", np.full((3, 3), 1.0 + i)), received)
    recording = Recording.open(tmp_path / "bag")
    found = {frame.stamp: decode_cloud(message) for frame, message in recording._decoded(recording.clouds)}
    assert len(found) == 40
    assert all(points[0, 0] == 1.0 + (stamp - START) // 50_000_000 for stamp, points in found.items())
