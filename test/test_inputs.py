"""What the node keeps of its inputs."""

import time

import numpy as np

from monoforce_ros.motion import MotionState
from monoforce_ros.nodes.inputs import Inputs

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


def test_a_camera_that_never_starts_or_dies_holds_up_the_others_for_a_while_only():
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


def test_time_that_goes_back_forgets_everything_and_says_so():
    kept, jumps = inputs(["a"])
    moved(kept, 100 * SECOND)
    kept.add_command("commands", 100 * SECOND, np.ones(2))
    moved(kept, 50 * SECOND)
    assert jumps == [("odometry", 50.0)]
    assert len(kept.motion()) == 1 and len(kept.commands()) == 0
    moved(kept, int(49.9 * SECOND))  # a little out of order: dropped, no jump
    assert len(kept.motion()) == 1 and len(jumps) == 1


def test_commands_without_a_stamp_are_dated_by_odometry():
    kept, _ = inputs(["a"])
    kept.add_command("commands", 0, np.ones(2))
    assert len(kept.commands()) == 0
    moved(kept, 7 * SECOND)
    kept.add_command("commands", 0, np.ones(2))
    assert kept.commands().stamps.tolist() == [7 * SECOND]
