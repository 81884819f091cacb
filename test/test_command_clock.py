"""Clocks of a recording: messages without a stamp, simulated time, a clock that was set, commands that expire."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, Recording, builders
from monoforce_ros.bags.command_timeout import TIMEOUT, expired
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.evaluation.check import check_bag
from monoforce_ros.robots import load_robot

RECEIVED = 1_750_000_000_000_000_000
COUNT = 200


def write(path, *, first=0, unstamped=0, twists="stamped", clouds="stamped", jump=0):
    """Ten seconds of simulated time from ``first`` [ns] on, received in wall time."""
    with BagWriter(path) as bag:
        bag.write("/tf_static", builders.static_transforms(RECEIVED, "base_link", {"lidar": np.eye(4)}), RECEIVED)
        for i in range(COUNT):
            elapsed = i * 50_000_000
            received = RECEIVED + elapsed
            stamp = 0 if i < unstamped else first + elapsed + jump * (i >= 40)
            place = [0.025 * i, 0.0, 0.0]
            bag.write("/odom", builders.odometry(stamp, "odom", "base_link", place, [0, 0, 0, 1], [0.5, 0, 0], [0] * 3),
                      received)  # fmt: skip
            if twists == "stamped":
                bag.write("/cmd_vel", builders.twist_stamped(stamp, "base_link", 0.5, 0.01 * i), received)
            else:
                bag.write("/cmd_vel", builders.twist(0.5, 0.01 * i), received)
            at = 0 if clouds == "unstamped" else stamp
            bag.write("/points", builders.point_cloud(at, "lidar", np.full((30, 3), float(i + 1))), received)
    return path


def test_messages_before_the_simulation_s_clock_runs_are_left_out(tmp_path):
    recording = Recording.open(write(tmp_path / "drive", first=10**9, unstamped=3))
    assert len(recording.motion) == len(recording.commands) == len(recording.clouds) == COUNT - 3
    assert recording.motion.stamps[-1] - recording.motion.stamps[0] < 10 * 10**9
    assert any("3 messages without a stamp" in text for text in recording.warnings)
    check = check_bag(tmp_path / "drive", load_robot("husky"))
    texts = " ".join(finding.text for finding in check.findings)
    assert "3 headers have no stamp; these are left out" in texts and "no messages for" not in texts


def test_commands_without_stamps_are_put_on_the_clock_of_the_poses(tmp_path):
    recording = Recording.open(write(tmp_path / "drive", first=5 * 10**9, twists="bare", clouds="unstamped"))
    np.testing.assert_allclose(recording.commands.stamps - recording.motion.stamps, 0, atol=10**6)
    np.testing.assert_allclose([f.stamp for f in recording.clouds] - recording.motion.stamps, 0, atol=10**6)
    points, _ = recording.cloud(recording.clouds[7])
    assert (points == 8.0).all()
    assert any("simulated time" in text for text in recording.warnings)


def test_clouds_without_stamps_are_found_by_their_time_of_reception(tmp_path):
    recording = Recording.open(write(tmp_path / "drive", first=RECEIVED, clouds="unstamped"))
    assert recording.clouds[7].stamp == RECEIVED + 7 * 50_000_000
    assert (recording.cloud(recording.clouds[7])[0] == 8.0).all()
    found = list(recording.clouds_between(RECEIVED, RECEIVED + 10**9))
    assert len(found) == 21 and not recording.warnings


def test_of_a_recording_whose_clock_was_set_forward_the_longest_part_is_used(tmp_path):
    years = 50 * 365 * 86_400 * 10**9
    recording = Recording.open(write(tmp_path / "drive", first=10**9, jump=years))
    assert len(recording.motion) == len(recording.commands) == len(recording.clouds) == COUNT - 40
    assert any("set forward by 18250 days" in text for text in recording.warnings)


def driven(stops):
    """A robot that drives for 2 s after a command, and then stops or not; commands fall silent for 4 s each time."""
    times = np.arange(0.0, 30.0, 0.05)
    phase = times % 6.0
    speed = np.where(phase < 2.0, 0.5, 0.0 if stops else 0.5)
    positions = np.column_stack([np.cumsum(speed) * 0.05, 0 * times, 0 * times])
    stamps = RECEIVED + np.rint(times * 1e9).astype(np.int64)
    still = np.zeros((len(times), 3))
    motion = MotionTrack(stamps, positions, Rotation.identity(len(times)).as_quat(), still, still)
    said = phase < 1.5
    return CommandTrack(stamps[said], np.tile([0.5, 0.0], (int(said.sum()), 1))), motion


def test_commands_expire_for_a_base_that_stops_in_silence_and_for_no_other():
    commands, motion = driven(stops=True)
    found, count = expired(commands, motion)
    assert count == 5 and (np.diff(found.stamps) >= 0).all()
    at = RECEIVED + np.array([1.0, 1.9, 3.0, 5.9, 7.0]) * 1e9
    np.testing.assert_allclose(found.sample(at.astype(np.int64))[:, 0], [0.5, 0.5, 0.0, 0.0, 0.5])
    assert found.stamps[30] == commands.stamps[29] + round(TIMEOUT * 1e9)
    commands, motion = driven(stops=False)
    held, count = expired(commands, motion)
    assert count == 0 and held is commands


@pytest.mark.parametrize("commands", [CommandTrack(np.zeros(0, np.int64), np.zeros((0, 2)))])
def test_without_commands_nothing_expires(commands):
    assert expired(commands, driven(stops=True)[1]) == (commands, 0)
