"""Figures and warnings of a diagnosis."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from monoforce_ros.bags import SmoothedMotion, smoothing
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.discrepancy.comparison import Comparison, measured_paths
from monoforce_ros.discrepancy.diagnosis import Details
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows
from monoforce_ros.discrepancy.figures import map_figure, timeline_figure, with_gaps
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.nominal_residual import residual_complaint
from monoforce_ros.robots import load_robot


def test_no_line_is_drawn_across_a_gap():
    times = np.r_[0:10, 40:50, 50.0:55.0]
    at, values = with_gaps(times, np.arange(25))
    (gap,) = np.flatnonzero(np.isnan(at))
    assert gap == 10 and np.isnan(values[10])
    assert at[gap - 1] == 9.0 and at[gap + 1] == 40.0
    np.testing.assert_array_equal(values[~np.isnan(values)], np.arange(25))
    # Whole recordings, single windows and none stay as they are.
    for count in (0, 1, 8):
        assert not np.isnan(with_gaps(np.arange(float(count)), np.ones(count))[0]).any()


def driving(speed, yaw_rate):
    """Twenty seconds on a circle."""
    stamps = 10**9 + np.arange(400) * 50_000_000
    heading = yaw_rate * 0.05 * np.arange(400)
    places = np.cumsum(speed * 0.05 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0)
    quaternions = np.stack([0 * heading, 0 * heading, np.sin(heading / 2), np.cos(heading / 2)], axis=1)
    zeros = np.zeros((400, 3))
    motion = MotionTrack(stamps, places, quaternions, zeros, zeros)
    smoothed = SmoothedMotion(motion, 0.001, 0.001, (slice(0, 400),))
    return smoothed, CommandTrack(stamps, np.tile([speed, yaw_rate], (400, 1)))


def test_times_are_those_of_the_recording_where_windows_begin_later():
    smoothed, commands = driving(0.5, 0.3)
    # An effect that begins after 8 s: earlier windows are no part of the diagnosis.
    first = int(smoothed.motion.stamps[0])
    starts = first + np.arange(8, 14) * 10**9
    data = EvidenceWindows(smoothed.motion, commands, starts, 2.0, np.array([2.0]))
    zeros = np.zeros((len(starts), 1, 3))
    figure = timeline_figure(Details(data, zeros, zeros[0], (), ()))
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xdata(), np.arange(8.0, 14.0))
    np.testing.assert_allclose(figure.axes[3].lines[0].get_xdata(), np.arange(8.0, 14.0))
    evidence, husky = Evidence(smoothed, commands), load_robot("husky")
    paths = measured_paths(husky, data, evidence, LeftOut.of(evidence, husky), None)
    assert min(path.start for path in paths) >= 8.0 and figure.axes[3].get_xlabel() == "time in the recording [s]"


def test_neither_the_map_nor_a_path_leads_across_a_gap():
    """Eight seconds and ten, ten metres and two minutes apart."""
    smoothed, commands = driving(0.5, 0.3)
    motion, late = smoothed.motion, np.arange(400) >= 160
    motion = replace(
        motion,
        stamps=motion.stamps + late * 120 * 10**9,
        positions=motion.positions + late[:, None] * np.array([10.0, 0.0, 0.0]),
    )
    stretches = (slice(0, 160), slice(160, 400))
    commands = replace(commands, stamps=motion.stamps)
    starts = np.r_[motion.stamps[0:120:20], motion.stamps[160:360:20]]
    data = EvidenceWindows(motion, commands, starts, 2.0, np.array([2.0]))
    zeros = np.zeros((len(starts), 3))
    compared = Comparison(2.0, starts, zeros, None, zeros, data)
    details = Details(data, zeros[:, None], zeros[:1], (compared,), (), stretches=stretches)
    lines = map_figure(details).axes[0].collections[0].get_segments()
    assert max(np.linalg.norm(np.diff(line, axis=0), axis=1).max() for line in lines) < 0.1
    assert sum(map(len, lines)) == 400
    evidence, husky = Evidence(replace(smoothed, motion=motion, stretches=stretches), commands), load_robot("husky")
    for path in measured_paths(husky, data, evidence, LeftOut.of(evidence, husky), None, count=20):
        assert not 8.0 - 5.0 < path.start < 8.0
        assert np.hypot(*path.measured[-1, :2]) < 3.0


def residual(position, degrees):
    return np.tile([position, 0.0, np.radians(degrees)], (4, 1))


def test_a_large_nominal_residual_is_said_with_what_to_do():
    smoothed, commands = driving(0.7, 0.5)
    assert residual_complaint(None, smoothed, commands) == ""
    assert residual_complaint(residual(0.02, 1.0), smoothed, commands) == ""
    text = residual_complaint(residual(0.19, 10.7), smoothed, commands)
    assert "19 cm (14 % of the way) and 10.7° (19 % of the turns)" in text and "commission again" in text
    # On a faster robot the same distance is less.
    faster = driving(3.0, 1.5)
    assert residual_complaint(residual(0.19, 10.7), *faster) == ""


@pytest.mark.parametrize("count", [900, 6000])
def test_long_stretches_are_smoothed_to_the_same_noise(count):
    random = np.random.default_rng(2)
    times = 0.05 * np.arange(count)
    values = np.sin(0.7 * times) + 0.3 * np.sin(1.9 * times)
    noisy = values + 0.01 * random.standard_normal(count)
    curve = make_smoothing_spline(times, noisy, lam=smoothing._with_noise(times, noisy, 0.01))(times)
    assert np.std(noisy - curve) == pytest.approx(0.01, rel=0.04)
    assert np.std(curve - values) < 0.005
