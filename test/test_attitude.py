"""Attitude, height and their rates are residuals, too, where ground and healthy robot are known."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy import DiagnosisSettings, commission, diagnose
from monoforce_ros.discrepancy.attitude import Lean, changed_lean, lean_of, vertical
from monoforce_ros.discrepancy.evidence import ATTITUDE, COMPONENTS, MOTION, Evidence, window_starts
from monoforce_ros.discrepancy.fit import fit_effects, robust
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.nominal import NominalModel, smallest_of, with_known_components
from monoforce_ros.discrepancy.report import effect_entry
from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot, write_robot
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.terrain import Grid, TerrainMap, save_terrain

pytestmark = pytest.mark.usefixtures("one_thread")
SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
ROLL, PITCH, HEIGHT = (COMPONENTS.index(name) for name in ("roll", "pitch", "height"))
RATES = [COMPONENTS.index(name) for name in ("roll rate", "pitch rate", "climb rate")]


def drive(robot, *, seed=4, turned=None, tilted=None, count=20):
    """Evidence of a drive over level ground by our own physics.

    Args:
        robot: with the effects that it has in truth.
        seed: of the commands.
        turned: rotation of the odometry frame, whose z axis is then not against gravity.
        tilted: rotation of the sensor on the robot.
        count: of the stretches of 1.5 s at one command each.
    """
    random = np.random.default_rng(seed)
    commanded = np.repeat(random.uniform([-0.3, -1.2], [1.0, 1.2], (count, 2)), 150, axis=0)
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    result = rollout(TerrainMap.flat(Grid.square(2.0, 1.0)), robot, speeds, State.at_rest(0.14), with_forces=False)
    motion = recorded(result, 10**9)
    rotations = Rotation.from_quat(motion.quaternions)
    if turned is not None:
        rotations = turned * rotations
        motion = replace(motion, positions=turned.apply(motion.positions), quaternions=rotations.as_quat())
    if tilted is not None:
        motion = replace(
            motion,
            quaternions=(rotations * tilted).as_quat(),
            linear_velocities=tilted.inv().apply(motion.linear_velocities),
            angular_velocities=tilted.inv().apply(motion.angular_velocities),
        )
    commands = CommandTrack(10**9 + np.arange(len(commanded)) * 10_000_000, commanded)
    smoothed = SmoothedMotion(motion, 0.001, 0.0005, (slice(0, len(motion)),))
    return Evidence(smoothed, commands, components=COMPONENTS)


def over_bumps(robot):
    """Evidence of a drive straight over waves of 5 cm and 1.5 m."""
    grid = Grid(40, 400, 0.1, (-2.0, -2.0))
    along = grid.origin[0] + (torch.arange(grid.columns) + 0.5) * grid.resolution
    terrain = TerrainMap.from_height((0.05 * torch.sin(2.0 * np.pi * along / 1.5)).expand(grid.rows, -1).clone(), grid)
    commanded = np.tile([0.8, 0.0], (3000, 1))
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    motion = recorded(rollout(terrain, robot, speeds, State.at_rest(0.2), with_forces=False), 10**9)
    commands = CommandTrack(10**9 + np.arange(len(commanded)) * 10_000_000, commanded)
    smoothed = SmoothedMotion(motion, 0.001, 0.0005, (slice(0, len(motion)),))
    return Evidence(smoothed, commands, terrain, np.eye(4), components=COMPONENTS)


def windows(evidence):
    smoothed = evidence.smoothed
    return evidence.cut(window_starts(smoothed.motion, smoothed.stretches, 2.0, 1.0), SAMPLES)


def residuals(robot, evidence, effects=()):
    return Predictions(robot, windows(evidence)).residuals([effects])[0]


def test_what_keeps_to_the_robot_and_what_keeps_to_the_ground_are_told_apart():
    random = np.random.default_rng(0)
    headings = Rotation.from_euler("z", random.uniform(-3.0, 3.0, (500, 1)))
    plane, mount = Rotation.from_rotvec([0.03, -0.02, 0.0]), Rotation.from_rotvec([-0.015, 0.025, 0.0])
    lean = Lean.of((plane * headings * mount).as_matrix())
    np.testing.assert_allclose(lean.plane, vertical(plane.as_matrix()), atol=1e-3)
    np.testing.assert_allclose(lean.own, vertical(mount.as_matrix()), rtol=0.005)


def test_a_perfect_model_leaves_no_attitude_and_a_tilted_localisation_neither():
    husky = load_robot("husky")
    straight = residuals(husky, drive(husky))
    assert straight.shape[-1] == len(COMPONENTS)
    assert np.abs(straight[..., [ROLL, PITCH]]).max() < np.radians(0.05)
    assert np.abs(straight[..., HEIGHT]).max() < 0.001
    assert np.abs(straight[..., RATES]).max() < 0.02
    # As seen from a frame that leans by 2°: the ground carries the robot as before.
    leaning = residuals(husky, drive(husky, turned=Rotation.from_euler("xy", [2.0, -1.0], degrees=True)))
    assert np.abs(leaning[..., [ROLL, PITCH]]).max() < np.radians(0.1)
    assert np.abs(leaning[..., HEIGHT]).max() < 0.002
    assert np.abs(leaning[..., RATES]).max() < 0.02


def test_what_a_robot_always_leans_is_no_residual():
    """It may be the mounting of the sensor, or the bias of its accelerometer."""
    husky = load_robot("husky")
    leaning = residuals(husky, drive(husky, tilted=Rotation.from_euler("xy", [1.0, 2.0], degrees=True)))
    assert np.abs(leaning[..., [ROLL, PITCH]]).max() < np.radians(0.2)
    # A sensor that leans by 2° takes 0.04 rad/s of a turn at 1 rad/s for pitching: on level ground its lean is known.
    assert np.abs(leaning[..., RATES]).max() < 0.02


@pytest.mark.parametrize("how", ["tilted", "turned"])
def test_a_tilted_sensor_or_localisation_moves_no_prediction_on_level_ground(how):
    """Windows that start at a tilted sensor's attitude fall by centimetres and turn by a degree."""
    husky = load_robot("husky")
    straight = residuals(husky, drive(husky))
    leaning = residuals(husky, drive(husky, **{how: Rotation.from_euler("xy", [3.0, 4.0], degrees=True)}))
    assert np.abs(leaning - straight)[..., [0, 1]].max() < 0.002
    assert np.abs(leaning - straight)[..., 2].max() < np.radians(0.1)


def test_a_tall_load_shows_in_how_the_robot_pitches_when_its_speed_changes():
    husky = load_robot("husky")
    soft = replace(husky, effects=(("terrain_softness", {"factor": 20.0}),))
    high, low = (
        residuals(soft, drive(replace(soft, effects=(*soft.effects, ("payload", {"mass": 15.0, "z": height})))))
        for height in (0.6, 0.0)
    )
    assert high[..., PITCH].std() > 2.0 * low[..., PITCH].std()


def test_soft_ground_shows_in_pitch_where_the_path_hardly_shows_it():
    husky = load_robot("husky")
    soft = replace(husky, effects=(("terrain_softness", {"factor": 15.0}),))
    data = windows(drive(soft))
    scale = np.tile(smallest_of(np.zeros(len(COMPONENTS))), (len(SAMPLES), 1))
    start = [(("terrain_softness", {"factor": 4.0}),)]
    found = {}
    for components in (MOTION, ATTITUDE, COMPONENTS):
        part = replace(data, components=components)
        found[components] = fit_effects(Predictions(husky, part), start, scale[:, : len(components)])
    assert dict(found[COMPONENTS].effects)["terrain_softness"]["factor"] == pytest.approx(15.0, rel=0.15)
    # The interval is a small part of the one from the path alone.
    assert found[ATTITUDE].covariance[0, 0] < 0.25 * found[MOTION].covariance[0, 0]


def test_softness_over_bumps_shows_in_the_rates_more_than_in_the_attitude():
    husky = load_robot("husky")
    data = windows(over_bumps(husky))
    predictions = Predictions(husky, data)
    change = predictions.residuals([(("terrain_softness", {"factor": 4.0}),)])[0] - predictions.residuals([()])[0]
    information = ((change / smallest_of(change)) ** 2).sum(axis=(0, 1))
    assert information[RATES].sum() > information[[ROLL, PITCH, HEIGHT]].sum()


def test_attitude_adds_to_the_loss_of_the_motion_and_does_not_dilute_it():
    motion = np.random.default_rng(1).standard_normal((5, 4, 3))
    still = np.concatenate([motion, np.zeros((5, 4, 3))], axis=-1)
    np.testing.assert_allclose(robust(still), robust(motion))


def test_commissioning_learns_the_attitude_of_the_healthy_robot_and_soft_ground_is_found(tmp_path):
    husky = load_robot("husky")
    mounted = Rotation.from_rotvec([0.03, -0.02, 0.0])
    effects, nominal = commission([drive(husky, seed=1, tilted=mounted, count=30)], husky)
    np.testing.assert_allclose(nominal.lean, [0.02, 0.03], atol=0.0005)
    assert nominal.with_attitude and nominal.residual.shape[1] == len(COMPONENTS)
    settings = DiagnosisSettings(max_effects=1)
    entries = [effect_entry(effect) for effect in effects]
    file = write_robot("husky", tmp_path / "husky.yaml", entries, [], "", nominal.entry(settings.samples))
    read = NominalModel.read(file, settings.samples)
    np.testing.assert_allclose(read.residual, nominal.residual, rtol=1e-3)
    assert read.motion_loss == pytest.approx(nominal.motion_loss, rel=1e-3)
    assert all(part in nominal.summary(2.0) for part in ("after 2 s", "cm across", "° in roll", "cm in height"))
    assert nominal.of_motion().summary(2.0).endswith("° in heading")
    robot = load_robot(file)
    same = diagnose(drive(husky, seed=7, tilted=mounted), robot, nominal=read, settings=settings)
    assert not same.effects
    assert "lean_2s" in same.gap and not any("leans" in remark for remark in same.remarks)
    soft = replace(husky, effects=(("terrain_softness", {"factor": 15.0}),))
    found = diagnose(drive(soft, seed=7, tilted=mounted), robot, nominal=read, settings=settings)
    assert [effect.name for effect in found.effects] == ["terrain_softness"]
    assert found.gap["lean_2s"].after < 0.5 * found.gap["lean_2s"].before
    bumped = lean_of(drive(husky, tilted=mounted * Rotation.from_rotvec([0.0, 0.05, 0.0])).smoothed.motion)
    assert "the robot leans 2.9° nose down:" in changed_lean(bumped, read.lean)


def test_the_installed_tool_commissions_on_ground_that_a_map_shows(tmp_path, executables, ros_environment):
    bag, ground = tmp_path / "drive", tmp_path / "ground.npz"
    settings = RecordingSettings(
        duration=30.0, seed=5, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(),
    )  # fmt: skip
    record(bag, settings)
    save_terrain(ground, TerrainMap.flat(Grid.square(40.0, 0.2)))
    command = [executables / "diagnose", "--commission", bag, "--terrain", ground, "--out", tmp_path / "out", "--quiet"]
    done = subprocess.run(command, env=ros_environment, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr
    assert "cm in height" in done.stdout
    assert NominalModel.read(tmp_path / "out" / "husky.yaml", DiagnosisSettings().samples).with_attitude


def test_a_change_of_the_lean_is_said_where_it_is_certain():
    lean = Lean(np.array([0.05, 0.002]), np.zeros(2), np.array([0.001, 0.001]))
    assert "leans 2.9° nose up:" in changed_lean(lean, np.zeros(2))
    assert "leans 2.3° to the left:" in changed_lean(replace(lean, own=np.array([0.0, -0.04])), np.zeros(2))
    # Within what an accelerometer repeats, on rough ground, and without commissioning.
    assert changed_lean(replace(lean, own=np.array([0.015, 0.0])), np.zeros(2)) == ""
    assert changed_lean(replace(lean, error=np.array([0.02, 0.02])), np.zeros(2)) == ""
    assert changed_lean(lean, None) == ""


def test_without_commissioning_or_on_unknown_ground_the_motion_counts_alone():
    husky = load_robot("husky")
    evidence = drive(husky)
    known, nominal = with_known_components(evidence, None)
    assert windows(known).components == MOTION and nominal is None
    terms = np.arange(54.0).reshape(9, 6)
    of_all = NominalModel(np.ones((4, 9)), loss=0.8, motion_loss=0.5, terms=terms)
    known, nominal = with_known_components(replace(evidence, components=MOTION), of_all)
    assert windows(known).components == MOTION
    assert nominal.residual.shape == (4, 3) and nominal.loss == 0.5 and nominal.terms.shape == (3, 6)
    known, nominal = with_known_components(evidence, of_all)
    assert windows(known).components == COMPONENTS and nominal is of_all
    # Files of earlier releases.
    of_six = NominalModel(np.ones((4, 6)), loss=0.8, motion_loss=0.5, terms=terms[:6])
    known, nominal = with_known_components(evidence, of_six)
    assert windows(known).components == COMPONENTS[:6] and nominal is of_six
    of_three = NominalModel(np.ones((4, 3)), loss=0.5)
    known, nominal = with_known_components(evidence, of_three)
    assert windows(known).components == MOTION and nominal is of_three
