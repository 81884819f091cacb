"""`diagnose`: what is hidden in a drive is named, sized, added to the robot's file, and makes predictions better."""

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording, SmoothedMotion, builders, smooth
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy.bag_diagnosis import diagnose_bag
from monoforce_ros.discrepancy.clocks import compare_with_gyro
from monoforce_ros.discrepancy.commissioning import commission
from monoforce_ros.discrepancy.diagnosis import Settings, _same, diagnose
from monoforce_ros.discrepancy.fit import first_values, fit_effects
from monoforce_ros.discrepancy.gap import map_floor, noise_floor, noisy_motions
from monoforce_ros.discrepancy.hypothesis import (
    Evidence,
    EvidenceWindows,
    Predictions,
    correct_measurements,
    subsampled,
    window_starts,
)
from monoforce_ros.discrepancy.selection import Search, Trial
from monoforce_ros.discrepancy.wheels import compare_with_wheels
from monoforce_ros.effects.catalogue import drive_speeds, recorded_commands, recorded_motion
from monoforce_ros.evaluation.recording_evaluation import PHYSICS, evaluate_recording
from monoforce_ros.messages import decoding
from monoforce_ros.perception import FlatTerrain
from monoforce_ros.physics import State, rollout
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import RobotFileError, load_robot
from monoforce_ros.robots.robot_copy import read_nominal_residual, write_robot
from monoforce_ros.synthetic.hidden import parse_hidden
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def own_drive(husky, effects, seconds=24.0):
    """A drive in our own physics with effects injected, as it would be recorded."""
    random = np.random.default_rng(4)
    robot = replace(husky, effects=effects)
    steps = round(seconds / 0.01)
    told = np.repeat(random.uniform([-0.2, -0.9], [0.9, 0.9], (round(seconds / 1.5), 2)), 150, axis=0)[:steps]
    speeds = drive_speeds(robot, torch.as_tensor(told[None], dtype=torch.float32), 0.01)
    terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(terrain, robot, speeds, State.at_rest(0.13), with_forces=False)
    rotations = Rotation.from_matrix(result.rotation[0, ::5].double().numpy())
    stamps = (10**9 + np.arange(len(rotations)) * 50_000_000).astype(np.int64)
    motion = MotionTrack(
        stamps=stamps,
        positions=result.position[0, ::5].double().numpy(),
        quaternions=rotations.as_quat(),
        linear_velocities=rotations.inv().apply(result.velocity[0, ::5].double().numpy()),
        angular_velocities=rotations.inv().apply(result.angular_velocity[0, ::5].double().numpy()),
    )
    commands = CommandTrack(10**9 + np.arange(steps) * 10_000_000, told)
    return recorded_motion(motion, robot), recorded_commands(commands, robot)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("command_delay", {"delay": 0.23}),
        ("drive_gain", {"gain": 0.87}),
        ("drive_asymmetry", {"difference": -0.12}),
        ("turning_scrub", {"track_width_factor": 1.3}),
        ("sensor_lever_arm", {"x": 0.35, "y": -0.1}),
        ("pose_clock_offset", {"offset": 0.17}),
    ],
)
def test_planted_parameters_are_recovered_by_the_fit(husky, name, parameters):
    motion, commands = own_drive(husky, ((name, parameters),))
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    predictions = Predictions(husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES))
    scale = np.tile([0.01, 0.01, 0.005], (4, 1))
    before = np.abs(predictions.residuals([()])[0]).mean()
    fit = fit_effects(predictions, first_values(name, list(parameters)), scale)
    for key, value in parameters.items():
        assert dict(fit.effects)[name][key] == pytest.approx(value, rel=0.05, abs=0.012)
    after = np.abs(predictions.residuals([fit.effects])[0]).mean()
    assert after < 0.2 * before


def test_what_matters_most_is_named_first(husky):
    injected = (("drive_asymmetry", {"difference": 0.01}), ("drive_gain", {"gain": 0.8}))
    motion, commands = own_drive(husky, injected)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    search = Search(
        husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES), np.tile([0.01, 0.01, 0.005], (4, 1))
    )
    fit = search.refit(injected)
    assert search.ranked(fit) == [1, 0]
    alone = replace(fit, effects=fit.effects[:1])
    assert search.ranked(alone) == [0]


def test_a_formula_that_is_an_effect_and_a_small_rest_keeps_the_effects_name():
    def trial(effects, loss):
        return Trial(effects, (effects, effects), np.full(4, loss))

    nominal, drag = trial((), 4.0), (("viscous_drag", {"coefficient": 150.0}),)
    as_formula = (("learned_term", {"force_x:vx": -170.0, "torque_z:vx": 20.0}),)
    assert _same(trial(drag, 1.2), trial(as_formula, 0.6), nominal)
    # The formula explains far more, is of something else, or its largest term is.
    assert not _same(trial(drag, 3.0), trial(as_formula, 0.6), nominal)
    assert not _same(trial((("payload", {"mass": 9.0}),), 1.2), trial(as_formula, 0.6), nominal)
    turned = (("learned_term", {"force_x:vx": -20.0, "torque_z:vx": 170.0}),)
    assert not _same(trial(drag, 1.2), trial(turned, 0.6), nominal)
    push = (("constant_force", {"x": 0.0, "y": 150.0}),)
    constant = (("learned_term", {"force_y:1": 147.0, "torque_z:wz": 10.8, "force_x:wz": 55.9}),)
    assert _same(trial(push, 1.5), trial(constant, 0.6), nominal)


def test_hypotheses_of_a_batch_are_those_of_single_calls(husky):
    motion, commands = own_drive(husky, ())
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 2.0)
    predictions = Predictions(husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES))
    tried = [
        (),
        *(((("drive_gain", {"gain": gain}),)) for gain in (0.8, 1.1)),
        (("pose_clock_offset", {"offset": 0.1}),),
    ]
    together = predictions.residuals(tried)
    for effects, expected in zip(tried, together, strict=True):
        np.testing.assert_allclose(predictions.residuals([effects])[0], expected, atol=1e-5)
    # Nothing is injected and nothing disagrees.
    assert np.abs(together[0]).max() < 0.02


def test_measurement_effects_are_undone(husky):
    effects = (("sensor_yaw_offset", {"angle": 0.2}), ("pose_clock_offset", {"offset": 0.3}))
    clean, commands = own_drive(husky, (), seconds=6.0)
    recorded = recorded_motion(clean, replace(husky, effects=effects))
    back, _ = correct_measurements(recorded, commands, effects)
    np.testing.assert_allclose(back.stamps, clean.stamps, rtol=0, atol=100)
    np.testing.assert_allclose(back.positions, clean.positions)
    turned = Rotation.from_quat(back.quaternions).inv() * Rotation.from_quat(clean.quaternions)
    assert turned.magnitude().max() < 1e-7


def test_the_noise_floor_is_the_error_of_a_perfect_model(husky):
    motion, commands = own_drive(husky, (), seconds=40.0)
    random = np.random.default_rng(1)
    noise = Rotation.from_rotvec(np.radians(0.5) * random.standard_normal((len(motion), 3)))
    noisy = replace(
        motion,
        positions=motion.positions + 0.01 * random.standard_normal(motion.positions.shape),
        quaternions=(Rotation.from_quat(motion.quaternions) * noise).as_quat(),
    )
    smoothed = smooth(noisy)
    starts = window_starts(motion, smoothed.stretches, 2.0, 0.5)
    data = EvidenceWindows(smoothed.motion, commands, starts, 2.0, SAMPLES)
    floor = noise_floor(smoothed.motion, noisy_motions(smoothed), data)
    shown = np.sqrt((Predictions(husky, data).residuals([()])[0] ** 2).mean(axis=0))
    assert (floor[-1] < 1.5 * shown[-1]).all()
    assert (shown[-1] < 2.5 * floor[-1]).all()


@pytest.mark.parametrize("still", [True, False])
def test_drives_that_cannot_tell_are_said_to_be(husky, still):
    times = np.arange(0.0, 40.0, 0.05)
    stamps = (10**9 + np.rint(times * 1e9)).astype(np.int64)
    positions = np.zeros((len(times), 3))
    positions[:, 0] = 0.0 if still else 0.5 * times
    zeros = np.zeros_like(positions)
    motion = MotionTrack(stamps, positions, Rotation.identity(len(times)).as_quat(), zeros, zeros)
    commands = CommandTrack(stamps, np.tile([0.0 if still else 0.5, 0.0], (len(times), 1)))
    diagnosis = diagnose(Evidence(smooth(motion), commands), husky)
    assert diagnosis.verdict == "not_identifiable"
    assert diagnosis.effects == ()
    assert "drive" in diagnosis.advice[0] or "step the speed" in diagnosis.advice[0]


@pytest.fixture(scope="module")
def late_robot(tmp_path_factory):
    """A MuJoCo drive of a robot that waits 0.3 s before it obeys, localised by something like SLAM."""
    out = tmp_path_factory.mktemp("hidden") / "drive"
    flat = TerrainSettings(flat=True)
    hidden = (parse_hidden("command_delay:0.3"),)
    settings = RecordingSettings(
        duration=45.0, seed=3, terrain=flat, camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=hidden,
    )  # fmt: skip
    record(out, settings)
    return out


def test_a_hidden_delay_is_named_added_and_closes_the_gap(late_robot, tmp_path, executables, ros_environment):
    out = tmp_path / "report"
    done = subprocess.run(
        [executables / "diagnose", late_robot, "--out", out, "--effects", "1", "--quiet", "--held-out", late_robot],
        env=ros_environment, capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "effect_found"
    (effect,) = report["effects"]
    # To commands and poses a late base and a late clock look the same; the gyro in the bag tells them apart.
    assert effect["name"] == "command_delay"
    assert "pose_clock_offset" not in effect["rivals"]
    (value,) = effect["parameters"].values()
    assert value["value"] == pytest.approx(0.3, abs=0.05)
    gap = report["gap"]["position_2s"]
    assert gap["after"] < 0.5 * gap["before"]
    assert gap["low"] > 0
    assert gap["closed"] > 0.5
    held_out = report["held_out"]["drive"]["position_2s"]
    assert held_out["after"] < 0.5 * held_out["before"]
    page = (out / "report.html").read_text()
    assert page.count("<img") >= 6 and "On drives that no fit saw" in page
    assert "What is missing" in page and "data:image/png;base64" in page and "src='http" not in page
    # The robot file it wrote is loaded as it is, and predicts the same drive better.
    found = load_robot(report["robot_file"])
    assert dict(found.effects)[effect["name"]]
    recording = Recording.open(late_robot)
    errors = []
    for robot in (load_robot("husky"), found):
        predictor = Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()), horizon=2.0)
        evaluation = evaluate_recording(recording, predictor, horizons=(1.0, 2.0), stride=1.0, quiet=True)
        errors.append(evaluation.summary(PHYSICS)[2.0][0].median)
    assert errors[1] < 0.5 * errors[0]


def test_without_a_disagreement_nothing_is_added(husky):
    motion, commands = own_drive(husky, (), seconds=30.0)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    diagnosis = diagnose(Evidence(smoothed, commands), husky, settings=Settings(most_effects=1))
    assert diagnosis.verdict == "no_discrepancy"
    assert diagnosis.effects == () and diagnosis.fitted == ()


def test_a_healthy_robot_is_commissioned_and_then_nothing_is_missing(husky, tmp_path):
    injected = (
        ("friction_scale", {"factor": 0.7}),
        ("turning_scrub", {"track_width_factor": 1.2}),
        ("actuator_lag", {"time_constant": 0.15}),
    )
    motion, commands = own_drive(husky, injected)
    smoothed = SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),))
    effects, nominal_residual = commission([Evidence(smoothed, commands)], husky)
    found = {effect["name"]: effect["parameters"] for effect in effects}
    assert found["turning_scrub"]["track_width_factor"]["value"] == pytest.approx(1.2, rel=0.05)
    assert found["actuator_lag"]["time_constant"]["value"] == pytest.approx(0.15, abs=0.03)
    assert nominal_residual.shape == (4, 3)
    kept = {"samples_s": [0.5, 1.0, 1.5, 2.0], "residual_rms": nominal_residual.tolist()}
    file = write_robot("husky", tmp_path / "husky.yaml", effects, [tmp_path], "0", kept)
    np.testing.assert_allclose(read_nominal_residual(file, (0.5, 1.0, 1.5, 2.0)), nominal_residual)
    assert read_nominal_residual("husky", (0.5, 1.0)) is None
    nominal = load_robot(file)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    before, after = (
        np.abs(Predictions(robot, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)).residuals([()])[0]).mean()
        for robot in (husky, nominal)
    )
    assert after < 0.2 * before
    with pytest.raises(RobotFileError, match="commission the robot again"):
        read_nominal_residual(file, (1.0, 2.0))


def test_a_gyro_tells_a_late_clock_from_a_late_robot(husky):
    def turning(motion, bias=0.0, sign=1.0, axis=2):
        rates = np.zeros((len(motion), 3))
        rates[:, axis] = sign * motion.angular_velocities[:, 2] + bias
        return AngularVelocityTrack(motion.stamps, rates)

    clean, commands = own_drive(husky, (), seconds=40.0)
    late = replace(clean, stamps=clean.stamps + 230_000_000)
    smoothed = SmoothedMotion(late, 0.003, 0.002, (slice(0, len(late)),))
    found = compare_with_gyro(smoothed, turning(clean))
    assert found.poses_late and found.offset == pytest.approx(0.23, abs=0.01)
    assert not found.biased
    # However the IMU is mounted.
    tilted = compare_with_gyro(smoothed, turning(clean, sign=-1.0, axis=1))
    assert (tilted.axis, tilted.sign) == (1, -1) and tilted.offset == pytest.approx(0.23, abs=0.01)
    in_time = SmoothedMotion(clean, 0.003, 0.002, (slice(0, len(clean)),))
    biased = compare_with_gyro(in_time, turning(clean, bias=0.04))
    assert not biased.poses_late
    assert biased.biased and biased.bias == pytest.approx(0.04, abs=0.005)
    assert compare_with_gyro(in_time, None) is None
    noise = np.random.default_rng(0).standard_normal((len(clean), 3))
    assert compare_with_gyro(in_time, AngularVelocityTrack(clean.stamps, noise)) is None
    diagnosis = diagnose(Evidence(smoothed, commands, turning=turning(clean)), husky, settings=Settings(most_effects=1))
    assert diagnosis.verdict == "effect_found"
    assert [effect["name"] for effect in diagnosis.effects] == ["pose_clock_offset"]


def wheels_of(commands, husky, effects, seconds=60.0):
    """Wheel speeds of drives that follow commands under effects, as joint states would show them."""
    steps = round(seconds / 0.01)
    stamps = commands.stamps[0] + np.arange(steps) * 10_000_000
    told = torch.as_tensor(commands.sample(stamps)[None], dtype=torch.float32)
    speeds = drive_speeds(replace(husky, effects=effects), told, 0.01)[0, ::5].double().numpy()
    noise = np.random.default_rng(2).standard_normal(speeds.shape)
    return WheelTrack(stamps[::5], speeds / husky.wheel_radius + 0.05 * noise)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (("command_delay", {"delay": 0.35}),),
        (("actuator_deadband", {"width": 0.1}),),
        (("command_delay", {"delay": 0.3}), ("actuator_saturation", {"limit": 0.6}),
         ("actuator_lag", {"time_constant": 0.25})),
    ],
)  # fmt: skip
def test_wheel_speeds_tell_how_the_drives_follow_commands(husky, effects):
    random = np.random.default_rng(3)
    twists = np.repeat(random.uniform([-0.3, -1.0], [1.0, 1.0], (30, 2)), 40, axis=0)
    commands = CommandTrack(10**9 + np.arange(len(twists)) * 50_000_000, twists)
    found = compare_with_wheels(commands, wheels_of(commands, husky, effects), husky)
    assert [name for name, _ in found.effects] == [name for name, _ in effects]
    for (_, values), (_, injected) in zip(found.effects, effects, strict=True):
        for key, value in injected.items():
            assert values[key] == pytest.approx(value, rel=0.08, abs=0.02)
    assert ("late" in found.told()) == any(name == "command_delay" for name, _ in effects)
    assert compare_with_wheels(commands, None, husky) is None
    strange = WheelTrack(commands.stamps, random.standard_normal((len(twists), 2)))
    assert compare_with_wheels(commands, strange, husky) is None


def test_wheels_are_found_among_the_joints():
    def joints(names, speeds):
        return decoding.decode_wheels(builders.joint_state(1, names, [0.0] * len(names), np.array(speeds, float)))

    names = ["front_left_wheel", "rear_left_wheel_joint", "front_right_wheel", "arm_left"]
    np.testing.assert_allclose(joints(names, [1.0, 3.0, 5.0, 99.0]), [2.0, 5.0])
    assert joints(["front_left_wheel"], [1.0]) is None
    assert joints(["left_track", "right_track"], [np.nan, 1.0]) is None
    assert joints([], []) is None


def test_long_drives_are_thinned_over_all_of_their_length():
    starts = np.arange(0, 3600, dtype=np.int64) * 10**9
    kept = subsampled(starts, 8.0, 120)
    assert 60 <= len(kept) <= 130
    assert kept[0] == starts[0] and kept[-1] > starts[-1] - 600 * 10**9
    # Whole pairs of blocks, so that each fold keeps its share.
    assert set(np.unique((kept // (8 * 10**9)) % 2)) == {0, 1}
    assert len(subsampled(starts[:100], 8.0, 120)) == 100


def test_level_ground_excuses_nothing_and_an_unsure_map_does(husky):
    motion, commands = own_drive(husky, (), seconds=12.0)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    level = EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)
    assert (map_floor(husky, level, None) == 0).all()
    grid = Grid.square(24.0, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    hills = 0.06 * np.sin(1.5 * x) * np.cos(1.2 * y)
    maps = [
        TerrainMap.from_height(torch.as_tensor(height, dtype=torch.float32), grid)
        for height in (hills, hills + 0.02 * np.sin(5 * x), hills - 0.02 * np.sin(5 * x))
    ]
    on_map = replace(level, terrain=maps[0], odometry_from_terrain=np.eye(4))
    shape = map_floor(husky, on_map, None)
    unsure = map_floor(husky, on_map, (maps[1], maps[2]))
    assert (shape[-1] > 0).all() and (unsure[-1] > shape[-1]).all()


@pytest.fixture(scope="module")
def pulled_robot(tmp_path_factory):
    """A MuJoCo drive of a robot that is turned by a torque which grows with the square of its speed."""
    out = tmp_path_factory.mktemp("hidden") / "drive"
    settings = RecordingSettings(
        duration=45.0, seed=5, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=(parse_hidden("speed_pull:400"),),
    )  # fmt: skip
    record(out, settings)
    return out


def test_what_the_catalogue_does_not_hold_is_said_to_be_unknown(pulled_robot, late_robot, tmp_path, executables,
                                                                 ros_environment):  # fmt: skip
    out = tmp_path / "reports"
    # Two bags at once, and a third that is not there: it does not stop the others.
    done = subprocess.run(
        [executables / "diagnose", pulled_robot, late_robot, tmp_path / "none", "--out", out, "--effects", "1",
         "--quiet"],
        env=ros_environment, capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 1 and "1 of 3 bags failed" in done.stderr
    report = json.loads((out / "00_drive" / "report.json").read_text())
    assert report["verdict"] == "unknown_effect", done.stdout
    (effect,) = report["effects"]
    assert effect["name"] == "learned_term"
    # A torque to the left that comes with speed; which power of it is told less surely on 45 s.
    assert any(key.startswith("torque_z:") and entry["value"] > 50.0 for key, entry in effect["parameters"].items())
    assert report["gap"]["heading_2s"]["after"] < 0.5 * report["gap"]["heading_2s"]["before"]
    assert json.loads((out / "01_drive" / "report.json").read_text())["verdict"] == "effect_found"


@pytest.mark.unhurried
def test_the_node_predicts_better_with_the_written_file(tmp_path, start, peer):
    """A robot with small wheels is diagnosed; the file that comes of it in a running node, against the nominal one."""
    bag = tmp_path / "drive"
    settings = RecordingSettings(
        duration=40.0, seed=8, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=(parse_hidden("drive_gain:0.7"),),
    )  # fmt: skip
    record(bag, settings)
    found = diagnose_bag(bag, "husky", tmp_path / "report", settings=Settings(most_effects=1))
    assert [effect["name"] for effect in found.diagnosis.effects] == ["drive_gain"]
    recording = Recording.open(bag)
    errors = []
    for robot in ("husky", found.robot_file):
        peer.clear()
        node = start("predictor", "--ros-args", "-p", f"robot:={robot}", "-p", "terrain_source:=flat")
        node.wait_for("predicting 5 s ahead for husky")
        player = start("bag_player", bag, "--duration", "12")
        assert peer.until(lambda player=player: not player.running, 90.0)
        peer.spin(1.0)
        node.stop()
        own = []
        for path in peer.received["/predicted/path"]:
            stamp = path.header.stamp.sec * 10**9 + path.header.stamp.nanosec
            # Where the robot was one second later; the path has a pose every tenth of a second.
            there = recording.motion.at(stamp + 10**9).position
            pose = path.poses[10].pose.position
            own.append(np.hypot(pose.x - there[0], pose.y - there[1]))
        assert len(own) > 10, node.output[-2000:]
        errors.append(np.median(own))
    assert errors[1] < 0.75 * errors[0], errors


def test_errors_are_one_line(tmp_path, executables, ros_environment):
    done = subprocess.run(
        [executables / "diagnose", tmp_path / "none", "--out", tmp_path / "out"],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("diagnose: ")
