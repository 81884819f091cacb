"""One run of each kind of drive against MuJoCo's model of the same robot; all runs: benchmarks/mujoco_drives.py."""

import dataclasses

import numpy as np
import pytest


@pytest.fixture(scope="module")
def check():
    import mujoco_drives

    return mujoco_drives


@pytest.mark.parametrize(
    ("name", "number"),
    [("ackermann", 1), ("four_wheel_steering", 0), ("independent", 0), ("differential", 2)],
)
def test_the_rollout_follows_an_independent_engine(check, name, number):
    case = check.cases()[name]
    row = check.compare(case, case.twists[number])
    assert row["distance_m"] > 1.0
    assert row["position_error_m"] < 0.25
    assert row["rotation_error_deg"] < 8.0


def test_flippers_climb_a_step_of_0_3_m_in_both_engines(check):
    case = check.cases()["flippers"]
    row = check.compare(case, case.twists[0])
    assert row["height_m"] == pytest.approx([0.3, 0.3], abs=0.02)
    assert row["position_error_m"] < 0.25
    assert row["rotation_error_deg"] < 8.0


def test_without_its_flippers_the_robot_does_not_climb_the_step(check):
    case = check.cases()["flippers"]
    held = dataclasses.replace(case, flippers=lambda times: np.full((len(times), 4), -0.14))
    row = check.compare(held, case.twists[0])
    # It leans on the edge.
    assert max(row["height_m"]) < 0.25
