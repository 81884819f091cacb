"""Inputs and rate limiter of the predictor node."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.nodes.alternating_poses import AlternatingPoses
from monoforce_ros.nodes.inputs import Inputs
from monoforce_ros.nodes.rate_limiter import RateLimiter

SECOND = 10**9


def inputs(sensors, patience=0.2):
    jumps = []
    kept = Inputs(sensors, slop=0.05, patience=patience, on_time_jump=lambda topic, back: jumps.append((topic, back)))
    return kept, jumps


def moved(kept, stamp):
    state = MotionState(stamp, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    kept.add_motion("odometry", state, "odom", "base_link")


def test_the_newest_set_is_taken_once_odometry_has_caught_up():
    kept, _ = inputs(["a"])
    kept.add_sensor("a", 1 * SECOND, "old")
    kept.add_sensor("a", 2 * SECOND, "new")
    assert kept.take(odometry_timeout=5.0, wait=0.05) is None
    moved(kept, 2 * SECOND)
    assert kept.take(odometry_timeout=5.0, wait=0.05)["a"].message == "new"
    assert kept.take(odometry_timeout=5.0, wait=0.05) is None
    assert kept.dropped == 1


def test_sensors_faster_than_the_lag_of_odometry_are_used_with_odometry_that_has_caught_up():
    """A lidar at 20 Hz beside SLAM that publishes 0.15 s late: odometry never catches up with the newest cloud."""
    kept, _ = inputs(["a"])
    taken = []
    for tick in range(1, 40):
        stamp = tick * SECOND // 20
        kept.add_sensor("a", stamp, stamp)
        moved(kept, stamp - 3 * SECOND // 20)
        if found := kept.take(odometry_timeout=5.0, wait=0.0):
            taken.append(found["a"].stamp)
    assert taken == [tick * SECOND // 20 for tick in range(1, 37)]
    assert kept.dropped == 0


def test_sensors_do_not_wait_for_odometry_that_never_comes():
    kept, _ = inputs(["a"])
    began = time.monotonic()
    for tick in range(1, 200):
        kept.add_sensor("a", tick * SECOND // 20, tick)
        # The next message comes long before the timeout.
        if taken := kept.take(odometry_timeout=0.3, wait=0.02):
            break
    assert taken["a"].message == tick, "the newest one is given"
    assert 0.25 < time.monotonic() - began < 2.0


def test_cameras_are_used_together_when_their_stamps_agree():
    kept, _ = inputs(["a", "b"], patience=5.0)
    moved(kept, 9 * SECOND)
    kept.add_sensor("a", 1 * SECOND, 1)
    assert kept.take(odometry_timeout=1.0, wait=0.01) is None
    kept.add_sensor("b", int(1.2 * SECOND), 2)
    assert kept.take(odometry_timeout=1.0, wait=0.01) is None
    kept.add_sensor("a", int(1.21 * SECOND), 3)
    taken = kept.take(odometry_timeout=1.0, wait=0.01)
    assert {name: entry.message for name, entry in taken.items()} == {"a": 3, "b": 2}


def test_images_triggered_together_are_not_mixed_with_previous_ones():
    kept = Inputs(["a", "b", "c"], slop=0.1, patience=5.0, on_time_jump=lambda *_: None)
    moved(kept, 9 * SECOND)
    taken = []
    for frame in range(6):
        for name in "abc":
            kept.add_sensor(name, frame * SECOND // 10, frame)
            if found := kept.take(odometry_timeout=1.0, wait=0.005):
                taken.append({entry.message for entry in found.values()})
    # Until a sensor has sent twice its rate is not known.
    assert taken[-4:] == [{2}, {3}, {4}, {5}]


def used_sets(offsets, *, rate=10.0, seconds=6.0, clocks=None):
    """Names of the sensors in each set of cameras whose messages come at these phases [s]."""
    names = [f"c{index}" for index in range(len(offsets))]
    kept = Inputs(names, slop=0.1, patience=2.0, on_time_jump=lambda *_: None)
    events = sorted(
        (offset + tick / rate, name, clock)
        for name, offset, clock in zip(names, offsets, clocks or [0.0] * len(names), strict=True)
        for tick in range(1, int(seconds * rate))
    )
    moved(kept, 0)
    sets = []
    for time_, name, clock in events:
        moved(kept, round(time_ * SECOND))
        kept.add_sensor(name, round((time_ + clock) * SECOND), name)
        if found := kept.take(odometry_timeout=0.0, wait=0.0):
            sets.append(set(found))
    return sets, kept


@pytest.mark.parametrize("offsets", [(0.0, 0.02, 0.04, 0.08), (0.0, 0.033, 0.066), (0.0, 0.05)])
def test_cameras_that_are_not_triggered_together_are_used_together(offsets):
    sets, kept = used_sets(offsets)
    assert len(sets) > 25
    assert all(len(found) == len(offsets) for found in sets[1:]) and not kept.apart


@pytest.mark.parametrize("clock", [-0.3, 0.3])
def test_a_camera_with_another_clock_is_left_out_and_named(clock):
    sets, kept = used_sets((0.0, 0.0, 0.0, 0.0), clocks=[0.0, 0.0, 0.0, clock])
    assert len(sets) > 25 and sets[-1] == {"c0", "c1", "c2"}
    assert kept.apart == {"c3": pytest.approx(-clock, abs=0.11)}


def test_inputs_are_skipped_instead_of_delayed():
    def used(interval, rate, jitter):
        times = np.arange(400) * interval + np.random.default_rng(0).uniform(-jitter, jitter, 400)
        limiter = RateLimiter()
        return np.array([limiter.due(now, rate) for now in times]), times

    assert used(0.1, 10.0, 0.01)[0].mean() > 0.99
    for interval in (0.01, 0.0333, 0.09):
        kept, times = used(interval, 10.0, 0.2 * interval)
        span = times[kept]
        assert 0.45 * min(10.0, 1 / interval) < (len(span) - 1) / (span[-1] - span[0]) < 10.3
        assert np.diff(span).min() > 0.05
    assert used(1.0, 10.0, 0.1)[0].all()


def test_flat_ground_is_predicted_from_each_new_odometry_once():
    kept, _ = inputs([])
    assert kept.take_motion(0, wait=0.01) is None
    moved(kept, 3 * SECOND)
    assert kept.take_motion(0, wait=0.01)["odometry"].stamp == 3 * SECOND
    assert kept.take_motion(3 * SECOND, wait=0.01) is None


def test_a_silent_camera_delays_the_others_only_for_a_while():
    kept, _ = inputs(["a", "b"], patience=0.2)
    moved(kept, 99 * SECOND)
    began, taken = time.monotonic(), None
    for i in range(20):
        kept.add_sensor("a", (1 + i) * SECOND, i)
        taken = kept.take(odometry_timeout=1.0, wait=0.03)
        if taken:
            break
    assert set(taken) == {"a"} and 0.15 < time.monotonic() - began < 0.5
    kept.add_sensor("b", int(1.01 * SECOND) + taken["a"].stamp, "late start")
    kept.add_sensor("a", int(1.02 * SECOND) + taken["a"].stamp, "again")
    assert set(kept.take(odometry_timeout=1.0, wait=0.03)) == {"a", "b"}


def test_a_backward_time_jump_discards_everything_and_is_reported():
    kept, jumps = inputs(["a"])
    moved(kept, 100 * SECOND)
    kept.add_command(100 * SECOND, np.ones(2))
    moved(kept, 50 * SECOND)
    assert jumps == [("odometry", 50.0)]
    assert len(kept.motion()) == 1 and len(kept.commands()) == 0
    moved(kept, int(49.9 * SECOND))  # a little out of order: dropped, no jump
    assert len(kept.motion()) == 1 and len(jumps) == 1


def test_the_clock_of_commands_says_nothing_of_the_sensors():
    """Two computers that command by turns, their clocks 100 s apart, must not stop the predictions."""
    kept, jumps = inputs(["a"])
    moved(kept, 100 * SECOND)
    kept.add_command(200 * SECOND, np.ones(2))
    kept.add_command(100 * SECOND, np.zeros(2))
    assert not jumps and len(kept.motion()) == 1
    assert kept.commands().stamps.tolist() == [100 * SECOND]


def test_commands_of_the_new_time_survive_a_jump():
    kept, _ = inputs(["a"])
    moved(kept, 100 * SECOND)
    kept.add_command(100 * SECOND, np.ones(2))
    kept.add_command(50 * SECOND, np.ones(2))
    moved(kept, 50 * SECOND)
    assert kept.commands().stamps.tolist() == [50 * SECOND]


def test_commands_without_a_stamp_are_dated_by_odometry():
    kept, _ = inputs(["a"])
    kept.add_command(0, np.ones(2))
    assert len(kept.commands()) == 0
    moved(kept, 7 * SECOND)
    kept.add_command(0, np.ones(2))
    assert kept.commands().stamps.tolist() == [7 * SECOND]


def test_another_frame_of_the_odometry_is_another_motion():
    kept, _ = inputs(["lidar"])
    for stamp in range(1, 5):
        moved(kept, stamp * 100_000_000)
    state = MotionState(500_000_000, np.array([100.0, 0.0, 0.0]), np.eye(3), np.zeros(3), np.zeros(3))
    kept.add_motion("odometry", state, "map", "base_link")
    assert kept.frame_id == "map" and len(kept.motion()) == 1


def test_what_came_before_a_pause_is_forgotten():
    kept, _ = inputs(["lidar"])
    moved(kept, 100_000_000)
    kept.forget()
    assert kept.motion_stamp == 0
    moved(kept, 50_000_000)
    assert kept.motion_stamp == 50_000_000


def _two_tracks(rates, apart, noise=0.0, seconds=2.0):
    """What is found at each pose [m] of a robot on a circle at 1 m/s, from two estimators at two rates [Hz]."""
    generator, found, alternating = np.random.default_rng(0), [], AlternatingPoses()
    poses = sorted((n / rate, index) for index, rate in enumerate(rates) if rate for n in range(int(seconds * rate)))
    for now, index in poses:
        place = np.array([np.sin(now), 1.0 - np.cos(now) + index * apart, 0.0]) + noise * generator.normal(size=3)
        rotation = Rotation.from_euler("z", now).as_matrix()
        found.append(alternating.add(MotionState(round(1e9 * (now + 1)), place, rotation, np.zeros(3), np.zeros(3))))
    return np.array(found)


@pytest.mark.parametrize("rates", [(50, 50), (50, 10), (30, 47)])
def test_two_estimators_on_one_topic_are_found(rates):
    found = _two_tracks(rates, 0.4)
    assert found[-1] == pytest.approx(0.4, abs=0.05) and (found > 0.0).mean() > 0.6


def test_one_estimator_is_not_taken_for_two():
    assert not _two_tracks((50, 0), 0.0, noise=0.05).any(), "noise"
    assert not _two_tracks((50, 50), 0.02).any(), "two that agree"
    alternating = AlternatingPoses()
    jumps = [MotionState(10**9 + n * 20_000_000, np.array([float(n > 40), 0, 0]), np.eye(3), np.zeros(3), np.zeros(3))
             for n in range(100)]  # fmt: skip
    assert not any(alternating.add(state) for state in jumps), "a jump"


def test_an_estimator_is_used_again_once_the_other_one_is_silent():
    alternating = AlternatingPoses()
    found = []
    for n in range(200):
        place = np.array([0.0, 0.4 * (n % 2) * (n < 100), 0.0])
        state = MotionState(10**9 + n * 20_000_000, place, np.eye(3), np.zeros(3), np.zeros(3))
        found.append(alternating.add(state) > 0.0)
    assert all(found[20:100]) and not any(found[155:])
