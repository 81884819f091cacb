"""Recordings that are localised anew after each gap: ground, sensors, and what a diagnosis may say of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import MotionTrack
from monoforce_ros.datasets import DriveRecording, drive_to_bag
from monoforce_ros.datasets.drive import DriveRun
from monoforce_ros.discrepancy import diagnose_bag
from monoforce_ros.discrepancy.bag_diagnosis import read_with_ground
from monoforce_ros.discrepancy.diagnosis import DiagnosisSettings, diagnose
from monoforce_ros.discrepancy.evidence import window_starts
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.separate_stretches import height_agreement, laid_apart, starts_anew
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import State, rest_depth, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

STEP = 0.01
DELAY = ("command_delay", {"delay": 0.4})
SLIPPING = ("tyre_slip", {"ratio": 0.3})
PULLED = ("constant_force", {"x": -300.0, "y": 0.0})


def hilly():
    grid = Grid.square(80.0, 0.2)
    x, y = np.meshgrid(grid.x, grid.y)
    return TerrainMap.from_height(torch.as_tensor(1.2 * np.sin(0.35 * x) * np.cos(0.3 * y), dtype=torch.float32), grid)


def runs_on_hills(robot, count):
    """Runs of 7 s that begin and end at rest, each in the frame of its own first pose; places are drawn."""
    random, terrain, found = np.random.default_rng(3), hilly(), []
    twists = np.zeros((count, 700, 2))
    twists[:, 50:600] = np.stack([random.uniform(-2.5, 2.5, count), random.uniform(-1.2, 1.2, count)], axis=1)[:, None]
    speeds = drive_speeds(robot, torch.as_tensor(twists, dtype=torch.float32), STEP)
    places = torch.as_tensor(random.uniform(-20.0, 20.0, (count, 2)), dtype=torch.float32)
    rows, columns, _ = terrain.grid.cells(places.numpy())
    depth = rest_depth(robot, float(terrain.stiffness.median()))
    height = terrain.height[rows, columns] - robot.underside[:, 2].min() - depth + 0.1
    headings = random.uniform(-np.pi, np.pi, count)
    start = State(
        torch.cat([places, height[:, None]], dim=1),
        torch.as_tensor(Rotation.from_euler("z", headings[:, None]).as_matrix(), dtype=torch.float32),
        torch.zeros(count, 3),
        torch.zeros(count, 3),
    )
    # It settles on the slope before the run.
    still = rollout(terrain, robot, torch.zeros(count, 200, speeds.shape[2]), start, with_forces=False)
    ended = State(*(value[:, -1] for value in (still.position, still.rotation, still.velocity, still.angular_velocity)))
    result = rollout(terrain, robot, speeds, ended, with_forces=False)
    every = slice(0, 700, 5)
    for number in range(count):
        rotations = Rotation.from_matrix(result.rotation[number, every].double().numpy())
        positions = result.position[number, every].double().numpy()
        # Yaw and place start at zero; roll and pitch are known from gravity.
        yaw = Rotation.from_euler("z", -rotations[0].as_euler("ZYX")[0])
        found.append(
            DriveRun(
                stamps=1_700_000_000 * 10**9 + np.arange(140) * 50_000_000 + number * 11 * 10**9,
                twists=twists[number, every],
                wheels=speeds[number, every].double().numpy() / 0.3,
                positions=yaw.apply(positions - positions[0]),
                quaternions=(yaw * rotations).as_quat(),
                gyro=result.angular_velocity[number, every, 2].double().numpy(),
            )
        )
    return tuple(found)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Recordings with a dead time, without and with a force that no sensor measures, and with tyres that slip."""
    folder, warthog, made = tmp_path_factory.mktemp("runs"), load_robot("warthog"), []
    recorded = (("late", (DELAY,), 14), ("pulled", (DELAY, PULLED), 7), ("slipping", (DELAY, SLIPPING), 12))
    for name, effects, count in recorded:
        runs = runs_on_hills(replace(warthog, effects=effects), count)
        drive_to_bag(DriveRecording(Path(name), runs), folder / name)
        made.append(folder / name)
    return made


def test_runs_in_frames_of_their_own_get_ground_of_their_own(bags):
    warthog = load_robot("warthog")
    evidence, _, ground = read_with_ground(bags[0], warthog, "auto")
    assert ground.source == "traced" and ground.apart and "each stretch for itself" in ground.description
    smoothed = evidence.smoothed
    starts = window_starts(smoothed.motion, smoothed.stretches, 2.0, 1.0)
    assert len(starts) > 25
    data = evidence.cut(starts, np.array([1.0, 2.0]))

    def error(windows):
        return float(np.median(np.abs(Predictions(warthog, windows).residuals([(DELAY,)])[0][:, -1, 0])))

    level = replace(data, terrain=None, odometry_from_terrain=None)
    # The slopes move the robot: on its own ground it is predicted better than on level ground.
    assert error(data) < 0.7 * error(level)


def test_a_frame_that_stays_keeps_its_ground():
    """Stretches of one drive over hills that come by the same places again."""
    time = np.arange(0.0, 240.0, 0.1)
    place = np.stack([10.0 * np.sin(0.09 * time), 8.0 * np.sin(0.13 * time)], axis=1)
    height = 0.8 * np.sin(0.5 * place[:, 0]) * np.cos(0.4 * place[:, 1])
    zeros = np.zeros((len(time), 3))
    motion = MotionTrack(
        (time * 1e9).astype(np.int64), np.c_[place, height], np.tile([0.0, 0, 0, 1], (len(time), 1)), zeros, zeros
    )
    stretches = tuple(slice(k, k + 280) for k in range(0, 2400, 300))
    kept = SmoothedMotion(motion, 0.01, 0.002, stretches)
    assert height_agreement(kept) > 0.8 and not starts_anew(kept)
    # The same heights, in frames that start at the first pose of each stretch.
    positions = motion.positions.copy()
    for stretch in stretches:
        positions[stretch] -= positions[stretch.start]
    anew = replace(kept, motion=replace(motion, positions=positions))
    assert starts_anew(anew)
    # One stretch, or none, has nothing to be compared with.
    assert height_agreement(replace(kept, stretches=stretches[:1])) is None
    assert height_agreement(replace(kept, stretches=())) is None
    apart = laid_apart(anew, 4.0)
    for first, stretch in enumerate(stretches):
        moved = apart.motion.positions[stretch] - positions[stretch]
        np.testing.assert_allclose(moved, moved[:1].repeat(len(moved), axis=0), atol=1e-9)
        assert (moved[:, 2] == 0.0).all()
        low, high = (getattr(apart.motion.positions[stretch, :2], side)(axis=0) for side in ("min", "max"))
        for other in stretches[first + 1 :]:
            points = apart.motion.positions[other, :2]
            assert ((points > high + 7.99) | (points < low - 7.99)).any(axis=1).all()
    assert laid_apart(replace(anew, stretches=stretches[:1]), 4.0).motion is anew.motion


def test_what_wheels_measure_stays_where_the_ground_may_be_the_cause_of_the_rest(bags, tmp_path):
    """No map shows the hills: the force may be a slope's, the dead time is the drives'."""
    found = diagnose_bag(bags[1], "warthog", tmp_path, terrain="flat", settings=DiagnosisSettings(max_effects=1))
    diagnosis = found.diagnosis
    assert diagnosis.verdict is Verdict.EFFECT_FOUND, diagnosis.remarks
    assert [effect.name for effect in diagnosis.effects] == ["command_delay"]
    assert diagnosis.effects[0].parameters["delay"].value == pytest.approx(0.4, abs=0.03)
    row = diagnosis.gap["position_2s"]
    assert row.after < row.before
    assert any("the ground is not level" in doubt for doubt in found.doubts)
    # It goes into the robot's file; nothing of the force does.
    assert found.robot_file is not None
    assert [name for name, _ in load_robot(found.robot_file).effects] == ["command_delay"]


def test_what_only_changes_how_the_robot_turns_is_not_blamed_on_slopes(bags, tmp_path):
    """A slope pulls whichever way the robot turns."""
    found = diagnose_bag(bags[2], "warthog", tmp_path, settings=DiagnosisSettings(max_effects=1))
    diagnosis = found.diagnosis
    assert found.ground.source == "traced" and found.ground.uneven
    assert diagnosis.verdict is Verdict.EFFECT_FOUND, diagnosis.remarks
    assert {effect.name for effect in diagnosis.effects} == {"command_delay", "tyre_slip"}
    slip = next(effect for effect in diagnosis.effects if effect.name == "tyre_slip")
    assert slip.parameters["ratio"].value == pytest.approx(0.3, abs=0.06)


def test_only_sensors_says_nothing_where_they_measure_nothing(bags):
    warthog = load_robot("warthog")
    evidence, _, _ = read_with_ground(bags[1], warthog, "auto")
    blind = replace(evidence, wheels=None, gyro=None)
    settings = DiagnosisSettings(sensors_only=True)
    assert diagnose(blind, warthog, settings=settings).verdict is Verdict.NO_DISCREPANCY
