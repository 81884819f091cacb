"""Clocks: delays of the poses and biases of the gyro count beyond what sensors cannot do better."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, MotionTrack
from monoforce_ros.discrepancy.clocks import compare_with_gyro


def turning(rate, seconds=60.0):
    """Poses at ``rate`` [Hz] and a gyro at 100 Hz of a robot that turns both ways."""

    def yaw_rate(times):
        return 0.6 * np.sin(0.9 * times) + 0.4 * np.sin(2.3 * times + 1.0)

    def heading(times):
        return -0.6 / 0.9 * np.cos(0.9 * times) - 0.4 / 2.3 * np.cos(2.3 * times + 1.0)

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
    assert found.biased == biased
