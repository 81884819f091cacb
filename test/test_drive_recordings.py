"""Bags of robots that steer, crab or move flippers: read, evaluated and checked with what they did."""

import dataclasses

import numpy as np
import pytest
import yaml
from test_steering import rover

from monoforce_ros.bags import BagError, BagWriter, ReadOptions, Recording, builders, cut_windows
from monoforce_ros.core import JointTrack
from monoforce_ros.discrepancy.wheel_motion import side_speeds, undriven_stretches
from monoforce_ros.evaluation.check import check_bag
from monoforce_ros.evaluation.recording_evaluation import PHYSICS, evaluate_recording
from monoforce_ros.perception import FlatTerrain
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.terrain import Grid, TerrainDefaults

pytestmark = pytest.mark.usefixtures("one_thread")
SECOND = 10**9


def recorded(folder, robot, commands, **settings):
    """A bag of 12 s on level ground."""
    terrain = TerrainSettings(flat=True)
    record(folder, RecordingSettings(
        robot=str(robot), commands=str(commands), duration=12.0, terrain=terrain, camera=None, lidar=None, **settings
    ))  # fmt: skip
    return folder


def errors(recording, robot, seconds=3.0):
    """Median errors of position [m] and rotation [deg] after some seconds."""
    source = FlatTerrain(robot, Grid.square(16.0, 0.5), TerrainDefaults())
    predictor = Predictor(robot, source, horizon=seconds)
    found = evaluate_recording(recording, predictor, horizons=(seconds,), stride=1.0, quiet=True)
    position, rotation = found.summary(PHYSICS)[seconds]
    return position.median, rotation.median


@pytest.fixture(scope="module")
def rally(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rally")
    (folder / "turns.csv").write_text("0,1.2,0\n2,1.2,0.6\n5,1.2,-0.5\n8,0.8,0.3\n10,-0.8,0.3\n")
    return recorded(folder / "bag", "rally_car", folder / "turns.csv", command_type="ackermann")


@pytest.fixture(scope="module")
def crab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("crab")
    (folder / "rover.yaml").write_text(yaml.safe_dump(rover()))
    (folder / "sideways.csv").write_text("0,0.4,0,0\n2,0.3,0,0.3\n5,0,0,0.4\n7,0.3,0.4,-0.2\n10,-0.3,0,0.2\n")
    return recorded(folder / "bag", folder / "rover.yaml", folder / "sideways.csv"), folder / "rover.yaml"


def test_a_car_is_predicted_well_and_far_worse_without_its_steering(rally):
    robot = load_robot("rally_car")
    recording = ReadOptions().open(rally, robot)
    assert recording.topics["commands"] == "/ackermann_cmd" and recording.commands.twists.shape[1] == 2
    assert np.abs(recording.commands.twists[:, 1]).max() == pytest.approx(0.6, rel=1e-5)
    position, rotation = errors(recording, robot)
    assert position < 0.15 and rotation < 3.0
    straight = recording.commands.twists * [1.0, 0.0]
    without = dataclasses.replace(recording, commands=dataclasses.replace(recording.commands, twists=straight))
    worse = errors(without, robot)
    assert worse[0] > 4.0 * position and worse[1] > 10.0


def test_a_robot_that_crabs_is_predicted_well_and_far_worse_without_lateral_speeds(crab):
    bag, file = crab
    robot = load_robot(file)
    recording = ReadOptions().open(bag, robot)
    assert recording.commands.twists.shape[1] == 3
    position, rotation = errors(recording, robot)
    assert position < 0.12 and rotation < 4.0
    forward = recording.commands.twists * [1.0, 1.0, 0.0]
    without = dataclasses.replace(recording, commands=dataclasses.replace(recording.commands, twists=forward))
    assert errors(without, robot)[0] > 4.0 * position


def test_measured_steering_is_where_a_window_starts(rally):
    robot = load_robot("rally_car")
    recording = ReadOptions().open(rally, robot)
    joints = list(robot.steered.joints)
    stamps = recording.motion.stamps[[150, 300]]
    start = recording.joints.start(stamps)
    assert np.isfinite(start[:, joints]).all() and start[0, joints[0]] > 0.1 and start[1, joints[0]] < -0.1
    windows = cut_windows(recording.motion, recording.commands, length=1.0, joints=recording.joints)
    assert windows.joint_start.shape == (len(windows), len(robot.joints)) and windows.flippers is None


def test_a_check_finds_nothing_wrong_with_these_bags(rally, crab):
    for bag, robot in ((rally, "rally_car"), crab):
        check = check_bag(bag, load_robot(robot), ReadOptions())
        texts = [finding.text for finding in check.findings if finding.level.name in ("MISSING", "WARNING")]
        assert check.usable and not texts, texts
    assert any("m/s sideways" in finding.text for finding in check.findings)


def test_wheels_of_a_robot_that_steers_are_expected_to_turn_as_its_kinematics_say(crab):
    bag, file = crab
    robot = load_robot(file)
    recording = ReadOptions().open(bag, robot)
    assert not len(undriven_stretches(recording.commands, recording.wheels, recording.motion, robot))
    np.testing.assert_allclose(side_speeds(robot, np.array([[0.3, 0.0, 0.4]])), [[0.5, 0.5]], atol=1e-6)
    husky = load_robot("husky")
    np.testing.assert_allclose(
        side_speeds(husky, np.array([0.3, 0.5])), 0.3 + 0.5 * float(husky.drive_offsets.max()) * np.array([-1.0, 1.0])
    )


def test_flippers_that_move_are_predicted_from_their_program(tmp_path):
    header = "t,front_left,front_right,rear_left,rear_right\n1,-0.14,-0.14,-0.14,-0.14\n"
    moving = "2,0.5,0.5,-0.4,-0.4\n7,0.5,0.5,-0.4,-0.4\n8,-0.3,-0.3,0.3,0.3\n"
    (tmp_path / "program.csv").write_text(header + moving)
    (tmp_path / "drive.csv").write_text("0,0.3,0\n3,0.3,0.3\n6,0.3,0\n9,-0.2,0\n")
    bag = recorded(tmp_path / "bag", "marv", tmp_path / "drive.csv", flippers=str(tmp_path / "program.csv"))
    robot = load_robot("marv")
    recording = ReadOptions().open(bag, robot)
    assert recording.topics["flipper_commands"] == "/flipper_commands" and recording.topics["joints"] == "/joint_states"
    program = recording.joints.flipper_angles(recording.motion.stamps[[100, 300]])
    np.testing.assert_allclose(program[1], [0.5, 0.5, -0.4, -0.4], atol=0.02)
    source = FlatTerrain(robot, Grid.square(12.0, 0.5), TerrainDefaults())

    def pitch(recording):
        found = evaluate_recording(
            recording, Predictor(robot, source, horizon=1.5), horizons=(1.5,), stride=1.0, quiet=True
        )
        predicted, measured = (np.arcsin(-p.rotations[:, -1, 2, 0]) for p in (found.predicted[PHYSICS], found.measured))
        return np.nanmedian(np.abs(predicted - measured)), np.nanmax(np.abs(measured))

    error, largest = pitch(recording)
    assert largest > 0.1 and error < 0.04
    held, _ = pitch(dataclasses.replace(recording, joints=None))
    assert held > 2.0 * error


def motion_messages(count=60):
    for index in range(count):
        stamp = (index + 1) * SECOND // 20
        yield (
            "/odom",
            stamp,
            builders.odometry(stamp, "odom", "base_link", [0.05 * index, 0, 0.16], [0, 0, 0, 1], [1, 0, 0], [0] * 3),
        )


def written(folder, messages):
    with BagWriter(folder) as bag:
        for topic, stamp, message in sorted(messages, key=lambda entry: entry[1]):
            bag.write(topic, message, stamp)
    return folder


def test_joint_states_of_other_names_are_said_once_and_not_used(tmp_path):
    states = [("/joint_states", k * SECOND // 20, builders.joint_state(k * SECOND // 20, ["arm"], [0.1], [0.0]))
              for k in range(1, 40)]  # fmt: skip
    bag = written(tmp_path / "bag", [*motion_messages(), *states])
    recording = ReadOptions().open(bag, load_robot("rally_car"))
    assert recording.joints is None
    (warning,) = recording.warnings
    assert "got the joints ['arm'], expected some of" in warning and "left_steering_joint" in warning
    assert ReadOptions().open(bag, load_robot("husky")).warnings == ()


def test_steering_commands_need_a_robot_that_steers(tmp_path):
    drives = [("/drive", k * SECOND // 20, builders.ackermann_drive(k * SECOND // 20, "base_link", 1.0, 0.2))
              for k in range(1, 40)]  # fmt: skip
    bag = written(tmp_path / "bag", [*motion_messages(), *drives])
    car = load_robot("rally_car")
    twists = ReadOptions().open(bag, car).commands.twists
    np.testing.assert_allclose(twists[0], [1.0, np.tan(0.2) / car.steered.wheelbase], rtol=1e-5)
    assert not len(Recording.open(bag).commands) and not len(ReadOptions().open(bag, load_robot("husky")).commands)
    with pytest.raises(BagError, match="/drive is ackermann_msgs/msg/AckermannDriveStamped, expected"):
        ReadOptions(commands="/drive").open(bag, load_robot("husky"))


def test_joint_tracks_interpolate_hold_and_do_not_bridge_gaps():
    stamps = np.array([0, 1, 2, 10]) * SECOND
    track = JointTrack(stamps, ("a", "b"), np.array([[0.0, np.nan], [1.0, 5.0], [np.nan, np.nan], [4.0, np.nan]]))
    at = track.at(np.array([SECOND // 2, 6 * SECOND, 10 * SECOND + SECOND // 4]), maximum_gap=0.5)
    np.testing.assert_allclose(at[:, 0], [0.5, np.nan, 4.0])
    np.testing.assert_allclose(at[:, 1], [5.0, np.nan, np.nan])
    held = track.held(np.array([-1, SECOND // 2, 9 * SECOND]))
    np.testing.assert_allclose(held, [[np.nan, np.nan], [0.0, np.nan], [1.0, 5.0]])
