"""Pairing: two effects that cancel on average are found together."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded

from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.evidence import EvidenceWindows, window_starts
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.pairing import promising_pairs
from monoforce_ros.discrepancy.score_test import Direction
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.effects import drive_speeds, identifiable_effects, recorded_motion
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")
SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
SCALE = np.tile([0.01, 0.01, 0.005], (4, 1))


def _directions(random, *columns):
    shaped = [np.atleast_2d(column).reshape(-1, 30, 4, 3) for column in columns]
    return [Direction(str(number), column) for number, column in enumerate(shaped)]


def test_what_two_directions_explain_together_is_promised_whatever_their_units():
    random = np.random.default_rng(3)
    first, other, third = random.standard_normal((3, 360))
    second = first + 0.1 * other
    residual = 0.6 * (second - first)
    directions = _directions(random, first, 100.0 * second, np.stack([third, random.standard_normal(360)]))
    pair = promising_pairs(residual.reshape(30, 4, 3), directions, 1)[0]
    assert (pair.first, pair.second) == (0, 1)
    np.testing.assert_allclose(np.concatenate(pair.coefficients), [0.6, -0.006], rtol=1e-3)
    assert pair.gain == pytest.approx(0.5 * float((residual**2).mean()), rel=1e-3) and pair.beyond > 0.9 * pair.gain


def test_of_indistinguishable_directions_and_of_one_alone_no_pair_is_promised():
    random = np.random.default_rng(3)
    column, residual = random.standard_normal((2, 360))
    residual = residual.reshape(30, 4, 3)
    for directions in (_directions(random, column, 2.0 * column), _directions(random, column), []):
        assert all(pair.beyond < 1e-6 for pair in promising_pairs(residual, directions, 3))


@pytest.fixture
def one_way():
    """A drive of left turns by a robot that is slowed, seen by a sensor on its right side."""
    random = np.random.default_rng(4)
    hidden = (("viscous_drag", {"coefficient": 150.0}), ("sensor_lever_arm", {"x": 0.0, "y": -0.1}))
    robot = replace(load_robot("husky"), effects=hidden)
    commanded = np.repeat(random.uniform([0.3, 0.0], [1.0, 0.8], (24, 2)), 150, axis=0)
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    level = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(level, robot, speeds, State.at_rest(0.14), with_forces=False)
    motion = recorded_motion(recorded(result, 10**9), robot)
    commands = CommandTrack(10**9 + np.arange(len(commanded)) * 10_000_000, commanded)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    return EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)


def test_a_drag_beside_a_sensor_off_the_centre_is_found_where_the_robot_turns_one_way(one_way):
    """In left turns a sensor on the right is faster, by about as much as the drag slows the robot."""
    husky = load_robot("husky")
    names = [effect.name for effect in identifiable_effects(husky)]
    healthy = NominalModel(SCALE, dict.fromkeys(names, 0.25), segments=5, loss=0.4, loss_spread=0.2)
    search = Search(husky, one_way, SCALE, nominal=healthy)
    found = search._together(search.measured().best)
    assert found is not None and set(found.names) == {"viscous_drag", "sensor_lever_arm"}
    values = dict(found.effects)
    assert values["sensor_lever_arm"]["y"] == pytest.approx(-0.1, abs=0.01)
    assert values["viscous_drag"]["coefficient"] == pytest.approx(150.0, rel=0.05)
    # Beside an explanation that is as good it is none.
    assert search._together(found) is None
