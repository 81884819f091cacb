"""Tables of benchmarks/terrain_fit.py."""

import numpy as np
import pytest
import terrain_fit

from monoforce_ros.core import MotionState
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults


def rows(world, position, friction, softness):
    return [
        terrain_fit.Row(world, "mud", odometry, method, 0.01, 0.5, friction, friction, softness, position * factor, 2.0)
        for odometry in terrain_fit.ODOMETRY
        for method, factor in zip(terrain_fit.METHODS, (1.0, 0.9, 0.8, 0.7, 0.6), strict=True)
    ]


def test_ratios_to_tracing_are_given_for_each_kind_of_ground():
    listed = [*rows(1, 0.1, 0.9, 0.0), *rows(2, 0.5, 0.3, 0.0), *rows(3, 0.2, 0.8, 0.05), *rows(4, 0.3, 0.7, 0.0)]
    text = terrain_fit.table(listed)
    assert text.startswith("4 worlds") and "| perfect | traced, friction fitted | 10.0" in text
    found = {line.split(" | ")[0].strip("| "): line for line in terrain_fit.by_ground(listed).splitlines()[2:]}
    assert found.keys() == {"all", "slippery", "soft", "neither"}
    assert found["slippery"].startswith("| slippery | 1 | 0.500 | 0.90 (0.90") and "| 0.60 (0.60" in found["soft"]
    assert found["neither"].startswith("| neither | 2 | 0.200 |")


def test_the_true_ground_needs_no_sensor():
    heights = np.zeros((81, 81), np.float32)
    labels = {"support_height": heights, "visible_height": heights, "origin": np.array([-4.0, -4.0]),
              "resolution": np.array(0.1)}  # fmt: skip
    source = terrain_fit.TrueGround(load_robot("husky"), labels, Grid.square(6.4, 0.1), TerrainDefaults())
    motion = MotionState(0, np.array([0.0, 0.0, 0.13]), np.eye(3), np.zeros(3), np.zeros(3))
    assert source.sensors == () and float(source.terrain(None, motion).height.max()) == pytest.approx(-0.13, abs=0.02)
