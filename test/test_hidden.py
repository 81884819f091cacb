"""Injected faults: each changes the simulation as its name says, and the ground truth never gets into the bag."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from monoforce_ros.effects import catalogue, controls
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import cli
from monoforce_ros.synthetic.hidden import FAULTS, draw_hidden, parse_hidden, truth_file
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP, build_model
from monoforce_ros.terrain import Grid, TerrainMap

FLAT = TerrainSettings(flat=True)
RECORDED_ONLY = {"pose_clock_offset", "command_clock_offset", "sensor_yaw_offset", "sensor_lever_arm", "gyro_bias"}


@pytest.fixture(scope="module")
def husky():
    return Vehicle.load("husky")


@pytest.fixture(scope="module")
def level():
    return build_scenery(FLAT, 5)


def speeds(robot, scenery, command, *hidden, seconds=4.0):
    """Forward speed, speed to the left and yaw rate over time after a step command."""
    faults = tuple(parse_hidden(text) for text in hidden)
    simulation = Simulation(build_model(scenery, robot, 0, {}, faults), scenery, robot, faults)
    simulation.drive(*command)
    measured = []
    for _ in range(round(seconds / TIME_STEP)):
        simulation.step()
        state = simulation.state()
        measured.append([*state.linear_velocity[:2], state.angular_velocity[2]])
    return np.array(measured)


def steady(*arguments, **named):
    return speeds(*arguments, **named)[-500:].mean(axis=0)


def rise_time(measured):
    """Time at which the forward speed reaches half of its final value [s]."""
    forward = measured[:, 0]
    return float(np.argmax(forward > 0.5 * forward[-200:].mean())) * TIME_STEP


def test_every_fault_in_the_catalogue_has_the_name_of_its_effect():
    hidden = {name for name, fault in FAULTS.items() if fault.in_catalogue}
    assert hidden <= set(catalogue.CATALOGUE)
    assert len(hidden) >= 19
    assert not {name for name in FAULTS if name not in hidden} & set(catalogue.CATALOGUE)


def test_delay_and_lag_postpone_the_motion_by_their_time(husky, level):
    plain = rise_time(speeds(husky, level, (0.6, 0.0), seconds=2.5))
    assert rise_time(speeds(husky, level, (0.6, 0.0), "command_delay:0.3", seconds=2.5)) == pytest.approx(
        plain + 0.3, abs=0.02
    )
    lagging = rise_time(speeds(husky, level, (0.6, 0.0), "actuator_lag:0.5", seconds=4.0))
    assert lagging == pytest.approx(plain + 0.5 * np.log(2.0), abs=0.1)


@pytest.mark.parametrize(
    ("hidden", "command", "expected"),
    [
        ("actuator_saturation:0.5", (0.9, 0.0), 0.5),
        ("actuator_deadband:0.1", (0.6, 0.0), 0.5),
        ("drive_gain:0.8", (0.6, 0.0), 0.48),
    ],
)
def test_actuator_faults_change_the_speed_reached(husky, level, hidden, command, expected):
    assert steady(husky, level, command, hidden)[0] == pytest.approx(expected, abs=0.035)


def test_a_deadband_holds_small_commands(husky, level):
    assert abs(steady(husky, level, (0.08, 0.0), "actuator_deadband:0.1")[0]) < 0.005


def test_unequal_sides_pull_to_the_slower_one(husky, level):
    assert abs(steady(husky, level, (0.7, 0.0))[2]) < 0.01
    assert steady(husky, level, (0.7, 0.0), "drive_asymmetry:0.15")[2] > 0.02
    assert steady(husky, level, (0.7, 0.0), "drive_asymmetry:-0.15")[2] < -0.02


def test_scrub_slows_turns_alone(husky, level):
    plain, scrubbing = (steady(husky, level, (0.6, 0.6), *h) for h in ((), ("turning_scrub:1.6",)))
    assert scrubbing[2] < 0.75 * plain[2]
    assert scrubbing[0] == pytest.approx(plain[0], rel=0.03)


def test_slippery_tyres_accelerate_slowly(husky, level):
    quick, slow = (rise_time(speeds(husky, level, (0.9, 0.0), *h)) for h in ((), ("friction_scale:0.1",)))
    # A tenth of the friction accelerates by 0.1 g.
    assert quick < 0.15
    assert slow == pytest.approx(0.45 / 0.981, abs=0.12)


@pytest.mark.parametrize("hidden", ["viscous_drag:400", "quadratic_drag:600", "rolling_resistance:0.5"])
def test_drag_slows_the_robot_as_far_as_stiff_servos_let_it(husky, level, hidden):
    assert steady(husky, level, (0.8, 0.0), hidden)[0] < steady(husky, level, (0.8, 0.0))[0] - 0.008


def predicted(command, **effects):
    """The same as ``steady`` by the rollout with effects of the catalogue."""
    robot = replace(load_robot("husky"), effects=tuple(effects.items()))
    twists = torch.tensor(command).expand(1, 400, 2)
    terrain = TerrainMap.flat(Grid.square(20.0, 1.0))
    moved = rollout(terrain, robot, controls(robot, twists, 0.01), State.at_rest(robot.ground_clearance))
    ahead = (moved.rotation.transpose(-1, -2) @ moved.velocity[..., None])[0, -100:, :2, 0].mean(0)
    return np.array([*ahead.numpy(), float(moved.angular_velocity[0, -100:, 2].mean())])


@pytest.mark.parametrize(
    ("command", "axis", "drag"), [((0.8, 0.0), 0, 400.0), ((0.5, 0.5), 2, 0.0), ((0.0, 0.8), 2, 0.0)]
)
def test_soft_drives_lose_the_speed_that_their_effect_says(husky, level, command, axis, drag):
    """Ahead against a drag, and in turns, in which tyres scrub."""
    pulled = (f"viscous_drag:{drag}",) if drag else ()
    there = [steady(husky, level, command, *pulled, *soft)[axis] for soft in ((), ("drive_compliance:0.2",))]
    held = {"viscous_drag": {"coefficient": drag}}
    here = [predicted(command, **held, **soft)[axis] for soft in ({}, {"drive_compliance": {"speed_loss": 0.2}})]
    assert here[0] - here[1] == pytest.approx(there[0] - there[1], rel=0.2)


def test_a_force_and_a_tilted_gravity_push_in_their_direction(husky, level):
    plain = steady(husky, level, (0.5, 0.0))[0]
    assert steady(husky, level, (0.5, 0.0), "constant_force:-300")[0] < plain - 0.01
    assert steady(husky, level, (0.5, 0.0), "constant_force:300")[0] > plain + 0.01
    assert steady(husky, level, (0.5, 0.0), "gravity_tilt:-0.3")[0] > plain + 0.004


def test_a_payload_far_back_turns_more_easily(husky, level):
    assert steady(husky, level, (0.5, 0.5), "payload:15")[2] > 1.1 * steady(husky, level, (0.5, 0.5))[2]


def test_soft_contacts_let_the_robot_sink(husky, level):
    sunk = []
    for hidden in ((), (parse_hidden("terrain_softness:20"),)):
        simulation = Simulation(build_model(level, husky, 0, {}, hidden), level, husky, hidden)
        for _ in range(500):
            simulation.step()
        sunk.append(-float(simulation.state().position[2]))
    assert sunk[1] > sunk[0] + 0.001


def test_out_of_catalogue_faults_behave_like_no_effect_of_the_catalogue(husky, level):
    fading = speeds(husky, level, (0.8, 0.0), "fading_drive:10", seconds=8.0)[:, 0]
    assert fading[-1] < 0.85 * fading[1000]
    wind = speeds(husky, level, (0.5, 0.0), "gusting_wind:force=700,period=4", seconds=6.0)[1000:, 0]
    assert np.ptp(wind) > 0.05
    assert steady(husky, level, (0.8, 0.0), "speed_pull:300")[2] > 0.08
    wobbling = speeds(husky, level, (0.8, 0.0), "eccentric_wheel:0.05")[1000:, 2]
    assert wobbling.std() > 5 * speeds(husky, level, (0.8, 0.0))[1000:, 2].std()
    assert steady(husky, level, (0.5, 0.3), "sticky_turn:0.4")[2] < 0.6 * steady(husky, level, (0.5, 0.3))[2]


def test_grass_holds_harder(husky):
    scenery = build_scenery(TerrainSettings(), 12)
    place = scenery.grass.canopy.heights.argmax()
    row, column = divmod(place, scenery.ground.heights.shape[1])
    pushes = []
    for hidden in ((), (parse_hidden("vegetation_drag:3"),)):
        simulation = Simulation(build_model(scenery, husky, 0, {}, hidden), scenery, husky, hidden)
        x, y = scenery.ground.grid()
        simulation.data.qpos[:2] = x[row, column], y[row, column]
        simulation.data.qpos[2] += scenery.ground.heights[row, column] - simulation.data.qpos[2] + 0.15
        simulation.data.qvel[0] = 0.5
        simulation.update_kinematics()
        simulation.step()
        pushes.append(simulation.data.xfrc_applied[simulation.wheel_bodies, 0].sum())
    assert pushes[0] < -20.0
    assert pushes[1] == pytest.approx(3.0 * pushes[0], rel=1e-6)


def read(bag):
    messages = {}
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            messages.setdefault(connection.topic, []).append((stamp, reader.deserialize(data, connection.msgtype)))
    return messages


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The same short recording with each fault of the recorded data, and without a fault."""
    folder = tmp_path_factory.mktemp("hidden")
    bags = {}
    for name in [None, *sorted(RECORDED_ONLY)]:
        hidden = (parse_hidden(name),) if name else ()
        out = folder / (name or "nothing")
        record(out, RecordingSettings(duration=1.5, terrain=FLAT, camera=None, lidar=None, hidden=hidden, seed=3))
        bags[name] = read(out)
    return folder, bags


def stamp(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def test_clocks_are_off_by_their_offset(recorded):
    bags = recorded[1]
    for name, topic in (("pose_clock_offset", "/odom"), ("command_clock_offset", "/cmd_vel")):
        shifted, plain = (stamp(bags[which][topic][20][1]) for which in (name, None))
        assert shifted - plain == pytest.approx(0.2, abs=1e-6)
        assert bags[name][topic][20][0] == bags[None][topic][20][0]  # received at the same time


def test_sensors_are_off_by_their_mounting(recorded):
    bags = recorded[1]
    poses = {name: bags[name]["/odom"][60][1].pose.pose for name in bags}
    plain = poses[None]
    heading = 2 * np.arctan2(plain.orientation.z, plain.orientation.w)
    turned = poses["sensor_yaw_offset"].orientation
    assert 2 * np.arctan2(turned.z, turned.w) - heading == pytest.approx(0.15, abs=1e-6)
    moved = poses["sensor_lever_arm"].position
    assert moved.x - plain.position.x == pytest.approx(0.4 * np.cos(heading), abs=1e-3)
    rates = [bags[name]["/odom"][60][1].twist.twist.angular.z for name in ("gyro_bias", None)]
    assert rates[0] - rates[1] == pytest.approx(0.05, abs=1e-9)


def test_the_ground_truth_lies_next_to_the_bag_and_not_in_it(recorded):
    folder, bags = recorded
    for name in sorted(RECORDED_ONLY):
        truth = json.loads(truth_file(folder / name).read_text())
        assert truth["hidden"][0]["name"] == name
        assert truth["hidden"][0]["in_catalogue"]
        assert {t: len(m) for t, m in bags[name].items()} == {t: len(m) for t, m in bags[None].items()}
        # Without the names of files, which contain the name of the folder.
        metadata = (
            (folder / name / "metadata.yaml").read_text().replace(f"{name}.mcap", "").replace(f"{name}_0.mcap", "")
        )
        assert name not in metadata
    assert json.loads(truth_file(folder / "nothing").read_text())["hidden"] == []


def test_random_faults_cover_all_kinds_and_are_reproducible():
    drawn = [draw_hidden(seed) for seed in range(400)]
    counts = [len(faults) for faults in drawn]
    assert 0.12 < counts.count(0) / 400 < 0.28
    assert 0.12 < counts.count(2) / 400 < 0.28
    # Those of joints are not drawn: most robots have none.
    assert {type(fault) for faults in drawn for fault in faults} == {
        fault for fault in FAULTS.values() if not fault.needs
    }
    out_of_catalogue = [faults for faults in drawn if any(not fault.in_catalogue for fault in faults)]
    assert out_of_catalogue and all(len(faults) == 1 for faults in out_of_catalogue)
    first, again = draw_hidden(7), draw_hidden(7)
    assert [fault.values for fault in first] == [fault.values for fault in again]
    level = [draw_hidden(seed, ("vegetation_drag",)) for seed in range(200)]
    assert not any(isinstance(fault, FAULTS["vegetation_drag"]) for faults in level for fault in faults)


@given(
    st.text(max_size=30)
    | st.sampled_from(sorted(FAULTS)).flatmap(lambda n: st.text(max_size=20).map(f"{n}:{{}}".format))
)
@settings(max_examples=150, deadline=None)
def test_any_text_is_a_fault_or_a_clear_error(text):
    try:
        fault = parse_hidden(text)
    except ValueError as error:
        assert "--hide" in str(error)  # noqa: PT017
    else:
        assert type(fault) in FAULTS.values()


def test_naming_one_flipper_leaves_the_others_healthy():
    assert parse_hidden("blocked_flipper").values["front_left"] == 1.0
    values = parse_hidden("blocked_flipper:rear_left=1").values
    assert {place for place, share in values.items() if share} == {"rear_left"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--hide", "gremlins"], "expected one of"),
        (["--hide", "payload:heavy"], "expected a number"),
        (["--hide", "payload:9000"], "expected 1 to 300"),
        (["--hide", "payload:weight=3"], "expected one of mass, x, y, z"),
        (["--hide", "vegetation_drag", "--flat"], "without vegetation"),
        (["--odometry", "perfect"], "expected truth, slam"),
        (["--odometry", "slam:1"], "expected 2 comma-separated numbers"),
        (["--distortion", "1,2"], "expected 5 comma-separated numbers"),
        (["--distortion=-0.9,0,0,0,0"], "folds the image"),
        (["--cameras", "5"], "expected 1 to 4"),
        (["--count", "0"], "expected 1 to 10000"),
    ],
)
def test_wrong_options_are_explained(tmp_path, capsys, arguments, message):
    assert cli.main([str(tmp_path / "drive"), "--quiet", *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_parameters_are_declared_once_and_typed():
    delay = FAULTS["command_delay"]
    assert (delay.parameters["delay"].low, delay.parameters["delay"].high) == (0.05, 1.0)
    assert delay().delay == 0.25
    assert delay(delay=0.5).delay == 0.5
    with pytest.raises(TypeError, match="got lag, expected delay"):
        delay(lag=0.5)
    for fault in FAULTS.values():
        assert fault.parameters
        for entry in fault.parameters.values():
            assert entry.low <= entry.default <= entry.high


def test_faults_are_listed_with_their_ranges(tmp_path, capsys):
    assert cli.main([str(tmp_path / "drive"), "--hide", "list"]) == 0
    assert "payload: mass = 20 (1 to 300)" in capsys.readouterr().out


@pytest.mark.parametrize("y", [0.0, 0.2])
def test_soft_drives_lose_more_speed_under_a_load_and_on_its_side(husky, level, y):
    """A motor loses speed by its torque: of two sides that scrub alike the heavier one turns slower."""
    soft, loads = "drive_compliance:0.2", (f"payload:mass=25,x=0.0,y={y},z=0.2",)
    there = [steady(husky, level, (0.0, 0.8), soft, *load) for load in ((), loads)]
    load = {"payload": {"mass": 25.0, "x": 0.0, "y": y, "z": 0.2}}
    here = [predicted((0.0, 0.8), drive_compliance={"speed_loss": 0.2}, **effects) for effects in ({}, load)]
    assert here[0][2] - here[1][2] == pytest.approx(there[0][2] - there[1][2], rel=0.25)
