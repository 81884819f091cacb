"""Steady turns: the law of friction that made a motion predicts it best, from measured wheel speeds alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT
from scipy.spatial.transform import Rotation

from monoforce_ros.datasets import DriveRecording
from monoforce_ros.datasets.drive import WHEEL_RADIUS, DriveRun
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap


@pytest.fixture
def steady_turns(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import steady_turns as module

    return module


def turning(robot, count):
    """Runs of 6 s, each with wheel speeds that are held, as the dataset has them."""
    random = np.random.default_rng(5)
    held = np.stack([random.uniform(0.5, 3.0, count), random.uniform(-1.5, 1.5, count)], axis=1)
    wheels = np.stack([held[:, 0] - held[:, 1], held[:, 0] + held[:, 1]], axis=1)
    speeds = torch.as_tensor(wheels, dtype=torch.float32)[:, None].expand(count, 600, 2)
    ground = TerrainMap.flat(Grid.square(4.0, 1.0))
    result = rollout(ground, robot, speeds, State.at_rest(robot.ground_clearance, batch=count), with_forces=False)
    every = slice(0, 600, 5)
    return tuple(
        DriveRun(
            stamps=np.arange(120) * 50_000_000,
            twists=np.zeros((120, 2)),
            wheels=np.tile(wheels[number] / WHEEL_RADIUS, (120, 1)),
            positions=result.position[number, every].double().numpy(),
            quaternions=Rotation.from_matrix(result.rotation[number, every].double().numpy()).as_quat(),
            gyro=np.zeros(120),
        )
        for number in range(count)
    )


def test_turns_of_tyres_that_slip_are_predicted_with_their_slip(steady_turns):
    warthog = load_robot("warthog")
    made_with = replace(warthog, effects=(("tyre_slip", {"ratio": 0.4}),))
    rows = steady_turns.compared(DriveRecording(Path("turns"), turning(made_with, 30)), warthog)
    errors = {(row["friction"], row["tyre_slip"]): row for row in rows}
    assert set(errors) == {(f, k) for f in steady_turns.FRICTIONS for k in steady_turns.RATIOS}
    best = min(rows, key=lambda row: row["yaw_rate"])
    assert (best["friction"], best["tyre_slip"]) == (0.8, 0.4)
    assert best["yaw_rate"] < 0.01 < 0.05 < errors[0.8, 0.0]["yaw_rate"]
    assert "turns (" in steady_turns.section(rows)


def test_few_turns_say_nothing(steady_turns):
    warthog = load_robot("warthog")
    assert steady_turns.compared(DriveRecording(Path("turns"), turning(warthog, 4)), warthog) == []
