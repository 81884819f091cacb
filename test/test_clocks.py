"""Clocks: delays of the poses and biases of the gyro count beyond what sensors cannot do better."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, MotionTrack
from monoforce_ros.discrepancy.clocks import compare_with_gyro, heading_disagreement
from monoforce_ros.discrepancy.comparison import Comparison, gap_table
from monoforce_ros.discrepancy.evidence import EvidenceWindows


def yaw_rate(times):
    return 0.6 * np.sin(0.9 * times) + 0.4 * np.sin(2.3 * times + 1.0)


def heading(times):
    return -0.6 / 0.9 * np.cos(0.9 * times) - 0.4 / 2.3 * np.cos(2.3 * times + 1.0)


def turning(rate, seconds=60.0):
    """Poses at ``rate`` [Hz] and a gyro at 100 Hz of a robot that turns both ways."""
    random = np.random.default_rng(0)
    times, fast = np.arange(0.0, seconds, 1.0 / rate), np.arange(0.0, seconds, 0.01)
    zeros = np.zeros((len(times), 3))
    turns = zeros + yaw_rate(times)[:, None] * [0, 0, 1] + 0.01 * random.standard_normal((len(times), 3))
    quaternions = Rotation.from_rotvec(heading(times)[:, None] * [0, 0, 1]).as_quat()
    motion = MotionTrack((times * 1e9).astype(np.int64), zeros, quaternions, zeros, turns)
    rates = np.column_stack([np.zeros((len(fast), 2)), yaw_rate(fast)]) + 0.01 * random.standard_normal((len(fast), 3))
    return motion, AngularVelocityTrack((fast * 1e9).astype(np.int64), rates)


@pytest.mark.parametrize(("rate", "delay", "late"), [(50.0, 0.03, True), (5.0, 0.08, False), (5.0, 0.2, True)])
def test_a_delay_within_half_the_time_between_poses_is_none_of_a_clock(rate, delay, late):
    motion, gyro = turning(rate)
    motion = replace(motion, stamps=motion.stamps + round(delay * 1e9))
    found = compare_with_gyro(SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), gyro)
    assert found.offset == pytest.approx(delay, abs=0.012)
    assert found.resolution == pytest.approx(0.5 / rate + 0.005)
    assert found.poses_late == late


@pytest.mark.parametrize(("bias", "biased"), [(0.005, False), (0.02, True), (-0.012, True)])
def test_a_gyro_is_biased_beyond_what_a_healthy_one_is(bias, biased):
    motion, gyro = turning(20.0)
    gyro = replace(gyro, rates=gyro.rates + np.array([0.0, 0.0, bias]))
    found = compare_with_gyro(SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), gyro)
    assert found.bias == pytest.approx(bias, abs=0.003)
    assert abs(found.bias - bias) < max(found.bias_half_width, 0.002)
    assert found.biased() == biased


@pytest.mark.parametrize(("tilt", "bias", "biased"), [(20.0, 0.0, False), (20.0, 0.06, True), (0.0, -0.02, True)])
def test_an_imu_that_leans_is_not_biased_in_laps_one_way_round(tilt, bias, biased):
    """It measures a share of each turn, always of the same sign."""
    motion, gyro = turning(20.0)
    seconds = (motion.stamps - motion.stamps[0]) * 1e-9
    lap = Rotation.from_rotvec(0.5 * seconds[:, None] * [0, 0, 1]) * Rotation.from_quat(motion.quaternions)
    turns = motion.angular_velocities + np.array([0.0, 0.0, 0.5])
    motion = replace(motion, quaternions=lap.as_quat(), angular_velocities=turns)
    up = np.array([0.0, 0.0, 1.0])
    rates = (gyro.rates + 0.5 * up) * np.cos(np.radians(tilt)) + bias * up
    found = compare_with_gyro(
        SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), replace(gyro, rates=rates)
    )
    assert found.bias == pytest.approx(bias, abs=0.004)
    assert found.biased() == biased


@pytest.mark.parametrize("smoothed_over", [0.0, 0.3, 0.5])
def test_a_localisation_that_smooths_quick_turns_is_no_bias_of_the_gyro(smoothed_over):
    """In laps, whose mean it follows: the factor between both rates is that of the quick turns."""
    motion, gyro = turning(20.0)
    rates = motion.angular_velocities[:, 2].copy()
    for i in range(1, len(rates) if smoothed_over else 0):
        rates[i] = rates[i - 1] + (rates[i] - rates[i - 1]) * 0.05 / smoothed_over
    up = np.array([0.0, 0.0, 1.0])
    motion = replace(motion, angular_velocities=(rates[:, None] + 0.5) * up)
    found = compare_with_gyro(
        SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), replace(gyro, rates=gyro.rates + 0.5 * up)
    )
    assert not found.biased()


def test_a_gyro_that_is_too_slow_to_compare_says_nothing():
    motion, gyro = turning(20.0)
    slow = AngularVelocityTrack(gyro.stamps[::50], gyro.rates[::50])
    assert compare_with_gyro(SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), slow) is None


def disagreement(motion, gyro, seconds=2.0):
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    return np.degrees(heading_disagreement(smoothed, gyro, compare_with_gyro(smoothed, gyro), seconds))


def test_poses_that_follow_the_gyro_with_a_constant_delay_err_by_nothing():
    motion, gyro = turning(20.0)
    late = replace(motion, stamps=motion.stamps + 250_000_000)
    # Neither a delay nor a bias nor a calibration of the gyro is an error of the localisation.
    changed = replace(gyro, rates=1.1 * gyro.rates + np.array([0.0, 0.0, 0.02]))
    assert disagreement(late, changed) < 0.6


def test_a_localisation_whose_delay_varies_errs_by_what_the_gyro_shows():
    motion, gyro = turning(20.0)
    seconds = (motion.stamps - motion.stamps[0]) * 1e-9
    delay = np.where((seconds // 5.0).astype(int) % 2, 0.5, 0.0)
    late = Rotation.from_rotvec(heading(seconds - delay)[:, None] * [0, 0, 1]).as_quat()
    random = np.random.default_rng(1)
    turns = yaw_rate(seconds - delay)[:, None] * [0, 0, 1] + 0.01 * random.standard_normal((len(seconds), 3))
    motion = replace(motion, quaternions=late, angular_velocities=turns)
    starts = np.arange(0.0, 57.0, 0.05)
    at = [np.interp(starts + shift, seconds, heading(seconds - delay)) for shift in (0.0, 2.0)]
    apart = (at[1] - at[0]) - (heading(starts + 2.0 - 0.25) - heading(starts - 0.25))
    expected = np.degrees(np.median(np.abs(apart)))
    assert expected > 4.0
    assert disagreement(motion, gyro) == pytest.approx(expected, rel=0.35)


def test_a_gyro_that_paused_says_nothing_of_that_time():
    motion, gyro = turning(20.0)
    times = (gyro.stamps - gyro.stamps[0]) * 1e-9
    kept = (times < 20.0) | (times > 40.0)
    paused = replace(gyro, stamps=gyro.stamps[kept], rates=gyro.rates[kept])
    assert disagreement(motion, paused) < 0.6
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    found, kept = compare_with_gyro(smoothed, gyro), times < 8.0
    short = replace(gyro, stamps=gyro.stamps[kept], rates=gyro.rates[kept])
    assert heading_disagreement(smoothed, short, found, 2.0) is None


def test_a_heading_error_is_reducible_down_to_what_the_gyro_shows_of_the_localisation():
    motion, _ = turning(20.0)
    commands = CommandTrack(motion.stamps, np.zeros((len(motion), 2)))
    starts = motion.stamps[:800:40]
    data = EvidenceWindows(motion, commands, starts, 2.0, np.array([2.0]))
    before, after, floor = (np.tile([0.3, 0.0, np.radians(error)], (len(starts), 1)) for error in (20.0, 8.0, 1.0))
    rows = [gap_table([Comparison(2.0, starts, before, after, floor, data)], heading_noise=n) for n in (None, {2.0: 5})]
    assert [row["heading_2s"].noise for row in rows] == pytest.approx([1.0, 5.0])
    assert [row["heading_2s"].closed for row in rows] == pytest.approx([12 / 19, 12 / 15])
    assert rows[0]["position_2s"] == rows[1]["position_2s"]
