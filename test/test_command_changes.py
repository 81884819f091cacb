"""Where commands change harder than in the commissioning drive, a healthy robot may respond faster or slower."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_diagnose import simulated_recording

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy import Evidence
from monoforce_ros.discrepancy.command_changes import (
    RESPONSE_TIME,
    covered_changes,
    largest_changes,
    uncovered_doubt,
    uncovered_residual,
)
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.robots import RobotFileError, load_robot, robot_file

TIMES = (0.5, 1.0, 1.5, 2.0)
SAMPLES = np.array(TIMES)
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def evidence():
    motion, commands = simulated_recording(load_robot("husky"), (), seconds=21.0)
    return Evidence(SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),)), commands)


def commanded(twists, rate: float = 50.0) -> CommandTrack:
    return CommandTrack(np.rint(np.arange(len(twists)) / rate * 1e9).astype(np.int64), np.asarray(twists, float))


def ramped(slope: float, seconds: float = 20.0, rate: float = 50.0) -> CommandTrack:
    """Speed 0 to 1 m/s and back, every four seconds, and as much yaw rate."""
    times = np.arange(0.0, seconds, 1.0 / rate)
    phase = times % 4.0
    speed = np.clip(slope * np.minimum(phase, 4.0 - phase), 0.0, 1.0)
    return commanded(np.stack([speed, speed], axis=1), rate)


def test_changes_are_those_since_shortly_before_the_window(evidence):
    times = np.arange(0.0, 10.0, 0.02)
    commands = commanded(np.stack([np.where(times < 3.0, 0.2, 1.0), np.where(times < 5.0, 0.5, -0.7)], axis=1))
    data = replace(evidence, commands=commands).cut(np.array([2.2, 3.3, 3.6, 4.0]) * SECOND, SAMPLES)
    changes = largest_changes(data)
    np.testing.assert_allclose(changes[0], [[0, 0], [0.8, 0], [0.8, 0], [0.8, 0]], atol=1e-9)
    # A step 0.3 s before a window still moves the robot in it, one 0.6 s before does not.
    np.testing.assert_allclose(changes[1, :, 0], 0.8, atol=1e-9)
    np.testing.assert_allclose(changes[2, :, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(changes[3, :, 1], [0.0, 1.2, 1.2, 1.2], atol=1e-9)


def test_a_healthy_robot_is_uncertain_only_where_commands_change_harder(evidence):
    starts = np.arange(1, 18) * SECOND
    gentle, hard = (replace(evidence, commands=ramped(slope)).cut(starts, SAMPLES) for slope in (0.5, 50.0))
    covered = covered_changes([gentle])
    np.testing.assert_allclose(covered, 0.1, atol=0.011)
    assert not uncovered_residual(gentle, covered).max() > 0.002
    residual = uncovered_residual(hard, covered)
    changes = largest_changes(hard)
    np.testing.assert_allclose(residual[..., 0], RESPONSE_TIME * (changes[..., 0] - covered[0]).clip(0.0))
    assert residual[:, -1, 2].max() > RESPONSE_TIME * 0.8
    # Nothing is uncertain to a robot that was commissioned with hard changes, however it is driven.
    for data in (gentle, hard):
        assert uncovered_residual(data, covered_changes([hard])).max() == pytest.approx(0.0, abs=1e-9)
    # Turning robots lose heading in a change of speed, others do not.
    straight = replace(evidence, commands=replace(ramped(50.0), twists=ramped(50.0).twists * [1.0, 0.0]))
    assert not uncovered_residual(straight.cut(starts, SAMPLES), covered)[..., 1:].any()


def test_the_nominal_model_knows_what_it_does_not_cover(evidence, tmp_path):
    starts = np.arange(1, 18) * SECOND
    hard = replace(evidence, commands=ramped(50.0)).cut(starts, SAMPLES)
    before = NominalModel(np.full((4, 3), 0.01))
    nominal = replace(before, changes=np.array([0.1, 0.1]))
    assert nominal.residual_in(hard).max() > 3 * before.residual_in(hard).max()
    content = yaml.safe_load(robot_file("husky").read_text()) | {"commissioning": nominal.entry(TIMES)}
    file = tmp_path / "husky.yaml"
    file.write_text(yaml.safe_dump(content))
    np.testing.assert_allclose(NominalModel.read(file, TIMES).changes, (0.1, 0.1))
    for wrong in ({"speed_m_s": 0.1}, {"speed_m_s": -1.0, "yaw_rate_rad_s": 0.1}, [1.0, 2.0], "fast"):
        content["commissioning"]["command_changes"] = wrong
        file.write_text(yaml.safe_dump(content))
        with pytest.raises(RobotFileError, match="commissioning"):
            NominalModel.read(file, TIMES)


def test_the_doubt_says_what_to_record(evidence):
    covered = np.array([0.1, 0.1])
    assert not uncovered_doubt(replace(evidence, commands=ramped(0.5)), 2.0, covered)
    assert not uncovered_doubt(replace(evidence, commands=ramped(50.0)), 2.0, None)
    text = uncovered_doubt(replace(evidence, commands=ramped(50.0)), 2.0, covered)
    assert "1.0 m/s and 1.0 rad/s in 0.2 s" in text and "0.1 m/s and 0.1 rad/s" in text and "--commission" in text
