"""Measured flipper angles beside the commanded ones: which flipper does not follow, and how much it loses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.bags import JointRecord
from monoforce_ros.core import NANOSECOND, JointTrack
from monoforce_ros.discrepancy.flippers import compare_with_commands
from monoforce_ros.robots import load_robot, servo_response

SECONDS, STEP = 40.0, 0.05


@pytest.fixture(scope="module")
def marv():
    return load_robot("marv")


def recorded(robot, *, shares=(0.0, 0.0, 0.0, 0.0), lag=0.0, noise=0.01, seed=0, moves=0.6):
    """Joints whose flippers are moved at random every 3 s, lose ``shares`` and lag by more than their file says."""
    generator = np.random.default_rng(seed)
    steps = round(SECONDS / STEP)
    stamps = (np.arange(steps) * STEP / NANOSECOND).astype(np.int64)
    wanted = np.repeat(moves * generator.uniform(-1.0, 1.0, (steps // 60 + 1, 4)), 60, axis=0)[:steps]
    joints = robot.joints[-4:]
    lags = torch.tensor([joint.time_constant + lag for joint in joints]).double()
    rates = torch.tensor([joint.maximum_rate for joint in joints]).double()
    start = robot.flipper_angles.double()[None]
    targets = start[:, None] + (1.0 - torch.tensor(shares)) * (torch.as_tensor(wanted)[None] - start[:, None])
    angles = servo_response(targets, start, lags, rates, STEP)[0][0].numpy()
    names = tuple(joint.name for joint in robot.joints)
    measured = JointTrack(stamps, names, angles + noise * generator.standard_normal(angles.shape))
    return JointRecord(measured, JointTrack(stamps, names, wanted), 4), stamps


@pytest.mark.parametrize("lag", [0.0, 0.3])
@pytest.mark.parametrize("moves", [0.6, 0.02])
def test_flippers_that_follow_are_not_blocked(marv, lag, moves):
    for seed in range(5):
        joints, stamps = recorded(marv, lag=lag, seed=seed, moves=moves)
        assert compare_with_commands(joints, marv, stamps[[[0, -1]]]) is None


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_lost_share_of_a_flipper_is_measured(marv, share):
    joints, stamps = recorded(marv, shares=(0.0, share, 0.0, 0.0))
    found = compare_with_commands(joints, marv, stamps[[[0, -1]]])
    index = [flipper.name for flipper in marv.flippers].index("front_right")
    assert index == 1
    name, values = found.effect
    assert name == "blocked_flipper"
    assert values.pop("front_right") == pytest.approx(share, abs=0.05)
    assert set(values.values()) == {0.0}
    estimate = found.estimate.parameters["front_right"]
    assert estimate.low <= share <= estimate.high + 1e-9
    # Half a share holds only from where a piece of the recording begins.
    assert found.after < (0.3 if share == 1.0 else 0.7) * found.before
    # A file that says so already is not told again.
    known = replace(marv, effects=(("blocked_flipper", {"front_right": share}),))
    assert compare_with_commands(joints, known, stamps[[[0, -1]]]) is None


def test_without_commands_or_measurements_nothing_is_said(marv):
    joints, stamps = recorded(marv, shares=(1.0, 0.0, 0.0, 0.0))
    assert compare_with_commands(replace(joints, commanded=None), marv, stamps[[[0, -1]]]) is None
    assert compare_with_commands(replace(joints, measured=None), marv, stamps[[[0, -1]]]) is None
    assert compare_with_commands(None, marv, stamps[[[0, -1]]]) is None
    gone = replace(joints.measured, angles=np.full_like(joints.measured.angles, np.nan))
    assert compare_with_commands(replace(joints, measured=gone), marv, stamps[[[0, -1]]]) is None
