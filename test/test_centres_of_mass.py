"""Simulated bodies have their centres of mass where they belong: wheels on their axles, payloads where mounted."""

import mujoco
import numpy as np
import pytest
import yaml
from drawn_platform import draw_platform
from drive_commands import ReplayedCommands
from drive_session import DriveJob
from ground_shape import Ground
from mujoco_engine import simulate

from monoforce_ros.robots import load_robot, shipped_robots
from monoforce_ros.synthetic import TerrainSettings, Vehicle, build_model, build_scenery
from monoforce_ros.synthetic.faults import Payload


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


def test_the_wheels_of_the_outside_check_are_balanced(tmp_path):
    import mujoco_drives

    for name, case in mujoco_drives.cases().items():
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump(dict(case.content)))
        robot = load_robot(path)
        model = mujoco_drives.Engine(case.content, robot, case.heights).model
        axles = [wheel["name"] for wheel in case.content.get("wheels", [])]
        assert gravity_on_axles(model, axles) == pytest.approx(0.0, abs=1e-6), name


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
