"""Simulated bodies have their centres of mass where they belong: wheels on their axles, payloads where mounted."""

import numpy as np
import pytest
from drawn_platform import draw_platform
from drive_commands import ReplayedCommands
from drive_session import DriveJob
from ground_shape import Ground
from mujoco_engine import simulate

from monoforce_ros.robots import shipped_robots
from monoforce_ros.synthetic import TerrainSettings, Vehicle, build_model, build_scenery
from monoforce_ros.synthetic.faults import Payload
from monoforce_ros.synthetic.graphics import mujoco


@pytest.fixture(scope="module")
def level():
    return build_scenery(TerrainSettings(flat=True), 4)


def gravity_on_axles(model, axles):
    """Torques of gravity about axles that are turned by an angle each [N m]."""
    data = mujoco.MjData(model)
    for number, name in enumerate(axles):
        data.qpos[model.joint(name).qposadr[0]] = 0.7 + number
    mujoco.mj_forward(model, data)
    return np.array([data.qfrc_bias[model.joint(name).dofadr[0]] for name in axles])


@pytest.mark.parametrize("name", shipped_robots())
def test_the_wheels_of_simulated_robots_are_balanced(level, name):
    vehicle = Vehicle.load(name)
    model = build_model(level, vehicle, 0, {})
    weight = 9.81 * float(model.body_mass.sum())
    assert gravity_on_axles(model, [wheel.joint for wheel in vehicle.wheels]) == pytest.approx(0.0, abs=1e-6 * weight)


def test_the_wheels_of_the_outside_check_are_balanced():
    import mujoco_drives

    for name, case in mujoco_drives.cases().items():
        engine = mujoco_drives.Engine(case.content, case.robot(), case.heights)
        axles = [wheel["name"] for wheel in engine.wheels]
        assert gravity_on_axles(engine.model, axles) == pytest.approx(0.0, abs=1e-6), name


def test_flippers_have_the_mass_of_the_file_with_their_belts():
    import mujoco_drives

    case = mujoco_drives.cases()["flippers"]
    robot = case.robot()
    model = mujoco_drives.Engine(case.content, robot, case.heights).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    base = model.body("base").id
    assert model.body_subtreemass[base] == pytest.approx(float(robot.mass))
    centre = data.subtree_com[base] - data.xpos[base]
    assert centre == pytest.approx(robot.centre_of_mass.double().numpy(), abs=1e-6)


def test_a_drawn_platform_rolls_ahead_without_ripple():
    # Soft servos show what turns with the wheels.
    platform = draw_platform(1054)
    commands = np.tile([0.8 * platform.maximum_speed, 0.0], (200, 1))
    trace = simulate(DriveJob(platform, Ground(), ReplayedCommands(commands), (), 8.0))
    steady = trace.velocities[400:, 0]
    assert np.ptp(steady) < 0.005 * steady.mean()


def test_a_payload_is_where_it_is_mounted(level):
    vehicle = Vehicle.load("husky")
    payload = Payload(mass=20.0, x=-0.25, y=0.1, z=0.35)
    centres = []
    for hidden in ((), (payload,)):
        model = build_model(level, vehicle, 0, {}, hidden)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        base = model.body("base").id
        centres.append((model.body_subtreemass[base], data.subtree_com[base] - data.xpos[base]))
    (mass, centre), (total, moved) = centres
    assert total == pytest.approx(mass + 20.0)
    assert moved == pytest.approx((mass * centre + 20.0 * np.array([-0.25, 0.1, 0.35])) / total, abs=1e-6)
