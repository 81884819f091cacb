"""Simulated robots of every drive type: they steer, crab, trail casters and move flippers, and record what they do."""

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from test_steering import rover

from monoforce_ros.messages import decoding
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import TIME_STEP, Simulation, TerrainSettings, Vehicle, build_model, build_scenery, cli
from monoforce_ros.synthetic.command_profile import CommandTable, make_profile
from monoforce_ros.synthetic.flipper_program import FlipperTable
from monoforce_ros.synthetic.recording import RecordingSettings, record, steering_angle

FLAT = TerrainSettings(flat=True)


@pytest.fixture(scope="module")
def level():
    return build_scenery(FLAT, 4)


def porter():
    """Two driven wheels and a caster behind them."""
    return {
        "name": "porter", "mass": 30.0, "centre_of_mass": [-0.1, 0.0, 0.05], "inertia_box": [0.6, 0.5, 0.3],
        "command": {"track_width": 0.5}, "drive": {"kind": "differential"},
        "wheels": [
            {"name": "left", "drive": "left", "centre": [0.0, 0.25, 0.0], "radius": 0.12, "width": 0.04},
            {"name": "right", "drive": "right", "centre": [0.0, -0.25, 0.0], "radius": 0.12, "width": 0.04},
            {"name": "rear", "drive": None, "centre": [-0.42, 0.0, -0.06], "radius": 0.06, "width": 0.03},
        ],
        "casters": [{"name": "caster", "wheel": "rear", "pivot": [-0.36, 0.0, 0.05]}],
    }  # fmt: skip


def vehicle(folder, content):
    path = folder / f"{content['name']}.yaml"
    path.write_text(yaml.safe_dump(content))
    return Vehicle.load(path)


def simulated(robot, scenery, command, seconds, *, flippers=None):
    """The simulation after a command that is ramped up within half a second, and its states at 100 Hz."""
    simulation = Simulation(build_model(scenery, robot, 0, {}), scenery, robot)
    if flippers is not None:
        simulation.move_flippers(np.array(flippers))
    states = []
    for step in range(round(seconds / TIME_STEP)):
        if step % 10 == 0:
            simulation.drive(*(min(1.0, step * TIME_STEP / 0.5) * value for value in command))
        simulation.step()
        if step % 5 == 0:
            states.append(simulation.state())
    assert simulation.mishap() is None
    return simulation, states


def joints(simulation):
    return dict(zip(simulation.joint_names, simulation.joint_states()[0], strict=True))


@pytest.mark.parametrize(("name", "speed", "curvature"), [("rally_car", 1.2, 0.4), ("offroad_car", 2.0, 0.12)])
def test_cars_turn_about_the_centre_that_their_steering_gives(level, name, speed, curvature):
    robot = Vehicle.load(name)
    simulation, states = simulated(robot, level, (speed, speed * curvature), 3.0)
    steady = states[-100:]
    turned = np.mean([state.angular_velocity[2] for state in steady])
    forward = np.mean([state.linear_velocity[0] for state in steady])
    assert forward == pytest.approx(speed, rel=0.05)
    assert turned / forward == pytest.approx(curvature, rel=0.1)
    # Steady: wheels that are out of balance or hop would shake the body.
    assert np.std([state.angular_velocity for state in steady], axis=0).max() < 0.05
    angles = joints(simulation)
    expected = load_robot(name).steered.wheelbase * curvature
    steering = [angles[pivot.name] for pivot in robot.steering]
    assert np.mean(np.tan(steering)) == pytest.approx(expected, rel=0.1)
    assert steering[0] > steering[1] > 0.0  # the inner wheel turns further


def test_steering_follows_at_its_rate_and_within_its_limit(level):
    robot = Vehicle.load("offroad_car")
    simulation = Simulation(build_model(level, robot, 0, {}), level, robot)
    simulation.drive(2.0, 2.0)
    angles = []
    for _ in range(round(1.5 / TIME_STEP)):
        simulation.step()
        angles.append(joints(simulation)["front_left_steering"])
    # 0.8 rad/s from 0 to the limit of 0.65 rad.
    assert angles[round(0.5 / TIME_STEP)] == pytest.approx(0.4, abs=0.06)
    assert angles[-1] == pytest.approx(0.65, abs=0.02) and max(angles) < 0.67


def test_four_steered_wheels_crab_and_turn_on_the_spot(level, tmp_path):
    robot = vehicle(tmp_path, rover())
    simulation, states = simulated(robot, level, (0.3, 0.0, 0.3), 3.0)
    assert states[-1].linear_velocity[:2] == pytest.approx([0.3, 0.3], abs=0.02)
    assert abs(states[-1].heading) < 0.03 and states[-1].position[1] > 0.6
    assert [joints(simulation)[pivot.name] for pivot in robot.steering] == pytest.approx([np.pi / 4] * 4, abs=0.03)
    _, states = simulated(robot, level, (0.0, 0.6, 0.0), 3.0)
    assert np.mean([s.angular_velocity[2] for s in states[-100:]]) == pytest.approx(0.6, rel=0.05)
    assert np.linalg.norm(states[-1].position[:2]) < 0.05


def test_casters_trail(level, tmp_path):
    robot = vehicle(tmp_path, porter())
    simulation, states = simulated(robot, level, (0.5, 0.0), 2.0)
    assert states[-1].linear_velocity[0] == pytest.approx(0.5, abs=0.03)
    assert abs(joints(simulation)["caster"]) < 0.05
    # Backwards it swings round.
    simulation, _ = simulated(robot, level, (-0.5, 0.05), 4.0)
    assert abs(abs(joints(simulation)["caster"]) - np.pi) < 0.3


def test_flippers_move_at_their_rate_and_lift_the_robot(level):
    robot = Vehicle.load("marv")
    low, high = simulated(robot, level, (0.0, 0.0), 2.5), simulated(robot, level, (0.0, 0.0), 2.5, flippers=[-0.6] * 4)
    assert [joints(high[0])[arm.name] for arm in robot.flippers] == pytest.approx([-0.6] * 4, abs=0.05)
    raised = high[1][-1].position[2] - low[1][-1].position[2]
    # The tips carry the robot: 0.36 m from the axle, 0.055 m of radius.
    expected = 0.36 * (np.sin(0.6) - np.sin(0.14))
    assert raised == pytest.approx(expected, abs=0.02)
    half = high[1][round(0.2 / (5 * TIME_STEP))].position[2] - low[1][-1].position[2]
    assert 0.0 < half < 0.75 * raised  # 1 rad/s


def read(bag, topic):
    with AnyReader([bag]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == topic]
        if not wanted:
            return []
        return [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(wanted)]


def test_a_recorded_car_has_steering_angles_and_steering_commands(tmp_path):
    out = tmp_path / "bag"
    options = ["--robot", "rally_car", "--flat", "--commands", "steps", "--command-type", "ackermann"]
    assert cli.main([str(out), *options, "--camera", "none", "--lidar", "none", "--duration", "8", "--quiet"]) == 0
    states = read(out, "/joint_states")
    names = ("left_steering_joint", "right_steering_joint")
    angles = np.array([decoding.decode_joints(message, names)[0] for message in states])
    assert np.isfinite(angles).all() and np.ptp(angles[:, 0]) > 0.1
    commands = read(out, "/ackermann_cmd")
    assert len(commands) == 161 and not read(out, "/cmd_vel")
    commanded = np.array([message.drive.steering_angle for message in commands])
    assert np.abs(commanded).max() > 0.1
    # The bicycle's angle lies between those of both wheels; the servo is fast.
    middle = np.arctan(np.tan(angles).mean(axis=1))
    after = np.interp(2.5 * np.arange(len(commanded)) + 2.0, np.arange(len(middle)), middle)
    assert np.corrcoef(after, commanded)[0, 1] > 0.95
    assert steering_angle(1.0, 0.5, 0.57, 9.0) == pytest.approx(np.arctan(0.57 * 0.5))
    assert steering_angle(0.0, 0.5, 0.57, 9.0) == 0.0


def test_a_flipper_program_is_recorded_as_commanded_and_as_measured(tmp_path):
    (tmp_path / "program.csv").write_text("t,front_left,front_right\n0.5,-0.14,-0.14\n2.0,0.6,0.6\n")
    settings = RecordingSettings(
        duration=4.0, robot="marv", commands="straight", flippers=str(tmp_path / "program.csv"), terrain=FLAT,
        camera=None, lidar=None,
    )  # fmt: skip
    summary = record(tmp_path / "bag", settings)
    assert summary.mishap is None and summary.distance > 1.5
    names = ["front_left", "front_right", "rear_left", "rear_right"]
    commanded = np.array([decoding.decode_joints(m, names)[0] for m in read(tmp_path / "bag", "/flipper_commands")])
    measured = np.array([decoding.decode_joints(m, names)[0] for m in read(tmp_path / "bag", "/joint_states")])
    assert commanded[0] == pytest.approx([-0.14] * 4) and commanded[-1] == pytest.approx([0.6, 0.6, -0.14, -0.14])
    assert measured[-1] == pytest.approx(commanded[-1], abs=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--flippers", "steps"], "robot without flippers"),
        (["--robot", "marv", "--flippers", "nowhere.csv"], "t,front_left,front_right"),
        (["--commands", "crab"], "cannot move sideways"),
        (["--command-type", "ackermann"], "husky, which is no car"),
    ],
)
def test_what_a_robot_cannot_do_is_said(tmp_path, capsys, options, message):
    bare = ["--camera", "none", "--lidar", "none", "--quiet"]
    assert cli.main([str(tmp_path / "bag"), *bare, *options]) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_tables_of_flippers_and_of_lateral_speeds_are_checked(tmp_path):
    arms = Vehicle.load("marv").flippers
    file = tmp_path / "program.csv"
    for text, problem in (
        ("t,tail\n0,1\n", "got the header"),
        ("t,front_left\n0,x\n", "row 2"),
        ("t,front_left\n1,0\n0,0\n", "ascending"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=problem):
            FlipperTable.read(file, arms)
    file.write_text("t,v,w,y\n0.0,0.5,0.0,0.2\n")
    assert make_profile(str(file), None, None).command(0.5, np.zeros(2), 0.0) == (0.5, 0.0, 0.2)
    file.write_text("0.0,0.5,0.0,0.2\n1.0,0.5,0.0\n")
    with pytest.raises(ValueError, match="line 2"):
        CommandTable.read(file)


def test_steps_for_a_car_are_turns_that_it_can_drive():
    robot = Vehicle.load("rally_car")
    profile = make_profile("steps", None, np.random.default_rng(0), robot.maximum_speed, robot.maximum_curvature)
    commands = np.array([profile.command(0.05 * k, np.zeros(2), 0.0) for k in range(4000)])
    turning = np.abs(commands[:, 1]) > 1e-3
    settled = turning & (np.r_[0.0, np.abs(np.diff(commands, axis=0)).max(axis=1)] < 1e-9)
    curvature = np.abs(commands[settled, 1] / commands[settled, 0])
    assert curvature.max() <= robot.maximum_curvature * 1.001
    assert np.quantile(curvature, 0.25) < 0.5 * robot.maximum_curvature < np.quantile(curvature, 0.9)
