"""Effects: nothing at neutral values, the closed form at others, the same in both backends."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import yaml
from conftest import ROOT
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.effects import drive_torque_limit
from monoforce_ros.effects.catalogue import (
    CATALOGUE,
    EffectError,
    drive_speeds,
    effect_values,
    only_effect,
    recorded_commands,
    recorded_motion,
    turned_effects,
)
from monoforce_ros.effects.page import catalogue_page
from monoforce_ros.effects.timing import contains, values_from, values_growing
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.physics.contact import held_slip
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.robots import RobotFileError, load_robot, robot_file
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

GRID = Grid.square(20.0, 0.2)
BACKENDS = ["torch", "warp"]


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky").to(torch.float64)


def having(robot, **effects):
    return dataclasses.replace(robot, effects=tuple((name, values) for name, values in effects.items()))


def run(robot, twist, seconds, *, terrain=None, state=None, backend="warp", options=PhysicsOptions()):
    twists = torch.tensor(twist, dtype=torch.float64).expand(1, round(seconds / 0.01) + 200, 2)
    speeds = drive_speeds(robot, twists, 0.01, history=200)
    state = state or State.at_rest(robot.ground_clearance, dtype=torch.float64)
    terrain = terrain or TerrainMap.flat(GRID, dtype=torch.float64)
    return rollout(terrain, robot, speeds, state, backend=backend, options=options)


def neutral(name):
    return {p.name: p.neutral for p in CATALOGUE[name].parameters}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", CATALOGUE)
def test_neutral_values_change_nothing_bit_for_bit(husky, name, backend):
    plain = run(husky, (0.6, 0.4), 0.8, backend=backend)
    with_effect = run(having(husky, **{name: neutral(name)}), (0.6, 0.4), 0.8, backend=backend)
    for field in ("position", "rotation", "velocity", "angular_velocity", "forces"):
        assert torch.equal(getattr(plain, field), getattr(with_effect, field)), field


STRONG = {
    "rolling_resistance": {"coefficient": 0.1},
    "drive_compliance": {"speed_loss": 0.2},
    "tyre_slip": {"ratio": 0.3},
    "friction_creep": {"factor": 0.4},
    "vegetation_drag": {"coefficient": 3e4, "yield_speed": 0.4},
    "viscous_drag": {"coefficient": 40.0},
    "quadratic_drag": {"coefficient": 30.0},
    "gravity_tilt": {"about_x": 0.1, "about_y": -0.07},
    "constant_force": {"x": 30.0, "y": -20.0},
    "payload": {"mass": 15.0, "x": 0.2, "y": -0.1, "z": 0.3},
    "friction_scale": {"factor": 0.5},
    "friction_anisotropy": {"factor": 0.6},
    "terrain_softness": {"factor": 4.0},
    "rotation_centre": {"x": 0.07},
    "learned_term": {"force_x:vx": -20.0, "torque_z:vx wz": 8.0, "force_y:roll": 30.0},
}


def grassy():
    x, y = (torch.from_numpy(v) for v in np.meshgrid(GRID.x, GRID.y))
    ground = 0.05 * torch.sin(1.1 * x) * torch.cos(0.8 * y)
    return TerrainMap.from_height(ground, GRID, geometric_height=ground + 0.3 * torch.sigmoid(x))


@pytest.mark.parametrize("name", [*STRONG, "all"])
def test_both_backends_agree_on_effects_and_their_gradients(husky, name):
    effects = STRONG if name == "all" else {name: STRONG[name]}
    outcomes = []
    for backend in BACKENDS:
        values = {
            effect: {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in given.items()}
            for effect, given in effects.items()
        }
        result = run(having(husky, **values), (0.7, 0.5), 0.6, terrain=grassy(), backend=backend)
        loss = result.position.sum() + result.rotation[0, -1, 0].sum() + 1e-3 * result.forces[0, -1].sum()
        leaves = [v for given in values.values() for v in given.values()]
        outcomes.append((float(loss.detach()), [float(g) for g in torch.autograd.grad(loss, leaves)]))
    assert outcomes[0][0] == pytest.approx(outcomes[1][0], rel=1e-12)
    np.testing.assert_allclose(outcomes[0][1], outcomes[1][1], rtol=1e-9, atol=1e-12)
    assert all(g != 0.0 for g in outcomes[0][1])


ALL_STAGES = {
    **STRONG,
    "command_delay": {"delay": 0.123},
    "actuator_lag": {"time_constant": 0.21, "second_time_constant": 0.08},
    "actuator_saturation": {"limit": 0.63},
    "actuator_deadband": {"width": 0.04},
    "drive_gain": {"gain": 0.93},
    "drive_asymmetry": {"difference": 0.07},
    "turning_scrub": {"track_width_factor": 1.4},
    "yaw_rate_limit": {"limit": 0.11},
    "drive_loss": {"loss": -0.3},
    "supply_sag": {"sag": 0.25},
    "supply_drain": {"drain": 0.3, "time": 40.0},
    "drive_droop": {"loss": 0.06, "recovery": 0.8},
    "drive_torque_limit": {"acceleration": 0.19, "scrub": 0.35},
    "acceleration_limit": {"limit": 0.13},
    "yaw_acceleration_limit": {"limit": 0.21},
}


@pytest.mark.parametrize("name", ALL_STAGES)
def test_gradients_of_parameters_match_finite_differences(husky, name):
    for key, value in ALL_STAGES[name].items():

        def loss(at, key=key):
            robot = having(husky, **{name: {**ALL_STAGES[name], key: at}})
            time = torch.linspace(0, 1, 260, dtype=torch.float64)
            twists = torch.stack([0.3 + 0.5 * time, 0.8 - time], dim=-1)[None]
            speeds = drive_speeds(robot, twists, 0.01, history=200)
            state = State.at_rest(0.14, dtype=torch.float64)
            result = rollout(grassy(), robot, speeds, state, with_forces=False)
            return (result.position * torch.tensor([1.0, 2.0, 0.5])).sum() + result.rotation[0, -1, 0].sum()

        at = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(loss(at), at)
        step = 1e-5 * max(abs(value), 1e-2)
        with torch.no_grad():
            f = [float(loss(at + k * step)) for k in (-2, -1, 1, 2)]
        numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step)
        assert float(gradient) == pytest.approx(numeric, rel=1e-6, abs=1e-9), key


def steps(robot, commands):
    """Left-drive speeds for forward commands [m/s] at 100 Hz."""
    twists = torch.stack([torch.as_tensor(commands), torch.zeros(len(commands))], dim=-1)[None].double()
    return drive_speeds(robot, twists, 0.01)[0, :, 0].numpy()


def test_command_effects_have_their_closed_forms(husky):
    jump = np.r_[np.zeros(50), np.full(100, 0.8)]
    time = np.arange(150) * 0.01
    np.testing.assert_allclose(steps(having(husky, command_delay={"delay": 0.2}), jump)[70:], 0.8)
    np.testing.assert_allclose(steps(having(husky, command_delay={"delay": 0.2}), jump)[:70], 0.0)
    ramp = np.linspace(0, 0.9, 150)
    delayed = steps(having(husky, command_delay={"delay": 0.137}), ramp)
    np.testing.assert_allclose(delayed[20:], np.interp(time[20:] - 0.137, time, ramp), atol=1e-9)
    lagging = steps(having(husky, actuator_lag={"time_constant": 0.3}), jump)
    expected = 0.8 * (1 - np.exp(-(time[50:] - time[50] + 0.01) / 0.3))
    np.testing.assert_allclose(lagging[50:], expected, atol=1e-9)
    steady = steps(having(husky, actuator_lag={"time_constant": 0.3}), np.full(80, 0.5))
    np.testing.assert_allclose(steady, 0.5, atol=1e-9)
    np.testing.assert_allclose(steps(having(husky, actuator_saturation={"limit": 0.5}), ramp), np.minimum(ramp, 0.5))
    band = steps(having(husky, actuator_deadband={"width": 0.1}), [-0.5, -0.05, 0.0, 0.08, 0.5])
    np.testing.assert_allclose(band, [-0.4, 0, 0, 0, 0.4])
    np.testing.assert_allclose(steps(having(husky, drive_gain={"gain": 0.9}), [0.5]), [0.45])


def test_drives_droop_under_the_scrub_of_a_turn_until_integral_action_restores_them(husky):
    fast = dataclasses.replace(husky, maximum_speed=9.0, maximum_yaw_rate=9.0)
    robot = having(fast, drive_droop={"loss": 0.2, "recovery": 1.5})
    width = float(husky.drive_offsets.max() - husky.drive_offsets.min())
    time = np.arange(600) * 0.01
    step = np.where((time >= 1.0)[:, None], [0.5, 2.0 / width], [0.5, 0.0])
    step[time >= 4.0, 1] = 1.0 / width
    forward, yaw_rate = twist_of(robot, step).T
    np.testing.assert_allclose(forward, 0.5, atol=1e-12)
    # At first the whole loss, of which the integral part takes back what it can; a slower turn to the same side keeps
    # its load, and follows at once.
    lost = np.where(time < 1.0, 0.0, 2.0 * 0.2 * np.exp(-(time - 1.0) / 1.5)) / width
    np.testing.assert_allclose(yaw_rate, step[:, 1] - lost, atol=1e-9)
    # A turn that asks for less than the friction waits: the integral part grows by d / T until it overcomes it.
    slow = np.where(time[:, None] >= 1.0, [0.0, 2.0 * 0.1 / width], 0.0)
    yaw_rate = twist_of(robot, slow)[:, 1]
    begins = 1.0 + 1.5 * (0.2 / 0.1) * (1.0 - 0.1 / 0.2)
    assert np.abs(yaw_rate[time < begins - 0.05]).max() < 1e-9 < yaw_rate[time > begins + 0.05].min()
    assert yaw_rate[-1] == pytest.approx(2.0 * 0.1 / width * (1.0 - np.exp(-(5.99 - begins) / 1.5)), rel=0.02)
    # The wheels show the same.
    response = CATALOGUE["drive_droop"].wheel_response
    sides = np.stack([step[:, 0] - 0.5 * width * step[:, 1], step[:, 0] + 0.5 * width * step[:, 1]])
    shown = response.speeds(sides[None], 0.2, 1.5, 0.01)[0]
    np.testing.assert_allclose((shown[1] - shown[0]) / width, step[:, 1] - lost, atol=0.08 * 2.0 * 0.2 / width)
    # A robot with steered wheels has no scrub.
    droop = CATALOGUE["drive_droop"]
    assert droop.applies_to(husky) and not droop.applies_to(load_robot("rally_car"))


def twist_of(robot, commands):
    """Forward speed and yaw rate ``[T, 2]`` that the drives make of commands ``[T, 2]`` at 100 Hz."""
    left, right = drive_speeds(robot, torch.as_tensor(commands).double()[None], 0.01)[0].numpy().T
    width = float(robot.drive_offsets.max() - robot.drive_offsets.min())
    return np.stack([(left + right) / 2, (right - left) / width], axis=1)


def test_limits_of_the_twist_clamp_and_ramp_it(husky):
    fast = dataclasses.replace(husky, maximum_speed=9.0, maximum_yaw_rate=9.0)
    time = np.arange(400) * 0.01
    step = np.where((time >= 1.0)[:, None], [1.2, 3.0], 0.0)
    step[time >= 3.0] = [-0.4, 0.0]
    limited = having(
        fast, yaw_rate_limit={"limit": 1.0}, acceleration_limit={"limit": 2.0}, yaw_acceleration_limit={"limit": 1.6}
    )
    forward, yaw_rate = twist_of(limited, step).T
    rise = time - 1.0 + 0.01
    expected = np.clip(np.where(time < 3.0, 2.0 * rise, 1.2 - 2.0 * (time - 3.0 + 0.01)), -0.4, 1.2).clip(
        min=np.where(time < 3.0, 0.0, -0.4)
    )
    np.testing.assert_allclose(forward, expected, atol=1e-9)
    # The ramp starts from the clamped rate, not from the commanded one: it slows down at once.
    expected = np.where(time < 3.0, np.clip(1.6 * rise, 0.0, 1.0), np.clip(1.0 - 1.6 * (time - 3.0 + 0.01), 0.0, 1.0))
    np.testing.assert_allclose(yaw_rate, expected, atol=1e-9)
    # One limit leaves the other axis alone.
    forward, yaw_rate = twist_of(having(fast, yaw_rate_limit={"limit": 1.0}), step).T
    np.testing.assert_allclose(forward, step[:, 0], atol=1e-12)
    np.testing.assert_allclose(yaw_rate, np.clip(step[:, 1], -1.0, 1.0), atol=1e-12)


def test_commands_beyond_the_limits_of_the_robot_file_are_clamped(husky):
    assert (husky.maximum_speed, husky.maximum_yaw_rate) == (1.0, 2.0)
    np.testing.assert_allclose(twist_of(husky, [[4.0, -7.0]]), [[1.0, -2.0]])
    # The base clamps a command before it ramps to it: leaving the limit takes no time.
    commands = np.r_[np.full(150, 7.0), np.zeros(100)][:, None] * [0.0, 1.0]
    ramped = twist_of(having(husky, yaw_acceleration_limit={"limit": 4.0}), commands)[:, 1]
    np.testing.assert_allclose(ramped[150:], np.clip(2.0 - 0.04 * np.arange(1, 101), 0.0, None), atol=1e-9)
    # And in prediction: two commands beyond the limit move the robot alike.
    moved = [run(husky, (0.3, rate), 1.5) for rate in (2.0, 5.0)]
    assert torch.equal(moved[0].position, moved[1].position) and torch.equal(moved[0].rotation, moved[1].rotation)


def test_asymmetry_and_scrub_act_on_the_sides(husky):
    turn = torch.tensor([[[0.5, 0.4]]], dtype=torch.float64)
    left, right = drive_speeds(having(husky, drive_asymmetry={"difference": 0.2}), turn, 0.01)[0, 0].tolist()
    assert left == pytest.approx(0.9 * (0.5 - 0.4 * 0.2854)) and right == pytest.approx(1.1 * (0.5 + 0.4 * 0.2854))
    left, right = drive_speeds(having(husky, turning_scrub={"track_width_factor": 2.0}), turn, 0.01)[0, 0].tolist()
    assert (left + right) / 2 == pytest.approx(0.5) and right - left == pytest.approx(0.4 * 0.2854)
    veering = run(having(husky, drive_asymmetry={"difference": 0.1}), (0.6, 0.0), 3.0)
    assert float(veering.position[0, -1, 1]) > 0.05  # the right side is faster: it veers to the left


def test_history_decides_what_a_delayed_drive_does_first(husky):
    robot = having(husky, command_delay={"delay": 0.5})
    twists = torch.zeros(1, 200, 2, dtype=torch.float64)
    twists[:, :100, 0] = 0.7  # driving before the start, stopped at it
    speeds = drive_speeds(robot, twists, 0.01, history=100)
    assert speeds.shape[1] == 100
    assert float(speeds[0, 40, 0]) == pytest.approx(0.7) and float(speeds[0, 60, 0]) == 0.0


def sliding(speed):
    state = State.at_rest(0.12466, dtype=torch.float64)
    return dataclasses.replace(state, velocity=torch.tensor([[speed, 0.0, 0.0]], dtype=torch.float64))


FRICTIONLESS = PhysicsOptions(tangential_force="none")


def test_drags_slow_a_free_body_as_the_formulas_say(husky):
    free = {"state": sliding(1.0), "options": FRICTIONLESS}
    viscous = run(having(husky, viscous_drag={"coefficient": 25.0}), (0, 0), 2.0, **free).velocity[0, -1, 0]
    assert float(viscous) == pytest.approx(math.exp(-25.0 * 2.0 / 50.0), rel=0.01)
    quadratic = run(having(husky, quadratic_drag={"coefficient": 25.0}), (0, 0), 2.0, **free).velocity[0, -1, 0]
    assert float(quadratic) == pytest.approx(1 / (1 + 25.0 * 2.0 / 50.0), rel=0.01)
    rolling = run(having(husky, rolling_resistance={"coefficient": 0.02}), (0, 0), 1.0, **free).velocity[0, -1, 0]
    assert float(rolling) == pytest.approx(1.0 - 0.02 * 9.81, rel=0.01)


def test_forces_and_tilted_gravity_accelerate_as_newton_says(husky):
    free = {"state": sliding(0.0), "options": FRICTIONLESS}
    pushed = run(having(husky, constant_force={"x": 20.0, "y": -10.0}), (0, 0), 1.0, **free).velocity[0, -1]
    np.testing.assert_allclose(pushed[:2], [0.4, -0.2], rtol=0.03)
    tilted = run(having(husky, gravity_tilt={"about_y": 0.05}), (0, 0), 1.0, **free).velocity[0, -1]
    assert float(tilted[0]) == pytest.approx(-9.81 * math.sin(0.05), rel=0.03)
    tilted = run(having(husky, gravity_tilt={"about_x": 0.05}), (0, 0), 1.0, **free).velocity[0, -1]
    assert float(tilted[1]) == pytest.approx(9.81 * math.sin(0.05), rel=0.03)


def test_tilted_gravity_stays_with_the_ground_when_the_robot_turns(husky):
    """In the frame of each heading the tilt points another way; in the odometry frame it is one."""
    robot = having(husky, gravity_tilt={"about_x": 0.02, "about_y": 0.05})
    headings = torch.tensor([0.0, 0.5 * math.pi, 2.0], dtype=torch.float64)
    moved = []
    for heading in headings:
        turned = turned_effects(robot, heading[None])
        velocity = run(turned, (0, 0), 1.0, state=sliding(0.0), options=FRICTIONLESS).velocity[0, -1]
        cos, sin = math.cos(heading), math.sin(heading)
        moved.append([float(cos * velocity[0] - sin * velocity[1]), float(sin * velocity[0] + cos * velocity[1])])
    # Small angles: the order of the two turns does not matter.
    np.testing.assert_allclose(moved[1:], [moved[0]] * 2, atol=1e-3)
    assert turned_effects(husky, headings) is husky


def test_a_map_is_not_repeated_for_each_trajectory(husky):
    """A search rolls out a thousand trajectories on one map: a copy of the map for each would not fit in memory."""
    factors = torch.tensor([2.0, 5.0, 9.0], dtype=torch.float64)
    robot = having(husky, terrain_softness={"factor": factors}, vegetation_drag={"coefficient": 1e4 * factors})
    speeds = torch.zeros(3, 10, 2, dtype=torch.float64)
    posed, _ = Problem.pose(grassy(), robot, speeds, State.at_rest(0.13, batch=3, dtype=torch.float64))
    shape = (GRID.rows, GRID.columns)
    assert posed.terrain.stiffness.shape == posed.vegetation.shape == shape


def test_a_lag_of_its_own_for_each_trajectory_is_the_same_lag(husky):
    twists = torch.rand(3, 150, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    constants = [0.0, 0.2, 0.7]
    together = having(husky, actuator_lag={"time_constant": torch.tensor(constants, dtype=torch.float64)})
    batch = drive_speeds(together, twists, 0.01)
    for index, constant in enumerate(constants):
        alone = having(husky, actuator_lag={"time_constant": constant})
        torch.testing.assert_close(batch[index], drive_speeds(alone, twists[index : index + 1], 0.01)[0])


def test_a_learned_term_contains_the_effects_it_can_spell(husky):
    free = {"state": sliding(1.0), "options": FRICTIONLESS}
    spelled = run(having(husky, learned_term={"force_x:1": 5.0, "force_x:vx": -10.0}), (0, 0), 1.0, **free)
    known = run(having(husky, constant_force={"x": 5.0}, viscous_drag={"coefficient": 10.0}), (0, 0), 1.0, **free)
    assert float((spelled.velocity - known.velocity)[0, -1].norm()) < 0.005


def test_payload_follows_the_parallel_axis_theorem(husky):
    from monoforce_ros.effects.catalogue import applied_setup

    loaded = applied_setup(
        TerrainMap.flat(GRID, dtype=torch.float64), having(husky, payload={"mass": 10.0, "x": 0.3, "y": 0.1, "z": 0.4})
    ).robot
    place, old = np.array([0.3, 0.1, 0.4]), husky.centre_of_mass.numpy()
    centre = (50.0 * old + 10.0 * place) / 60.0

    def shifted(mass, arm):
        return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))

    inertia = husky.inertia.numpy() + shifted(50.0, old - centre) + shifted(10.0, place - centre)
    np.testing.assert_allclose(loaded.centre_of_mass.numpy(), centre, atol=1e-7)
    np.testing.assert_allclose(loaded.inertia.numpy(), inertia, atol=1e-6)
    result = run(having(husky, payload={"mass": 10.0, "x": 0.0, "y": 0.0, "z": 0.05}), (0, 0), 1.5)
    assert float(result.normal_forces[0, -1].sum()) == pytest.approx(60 * 9.81, rel=1e-4)


def test_soft_ground_and_grass_and_ice(husky):
    soft = run(having(husky, terrain_softness={"factor": 5.0}), (0, 0), 2.0)
    sunk = husky.ground_clearance - float(soft.position[0, -1, 2])
    assert sunk == pytest.approx(rest_depth(husky, TerrainDefaults.stiffness / 5.0), rel=0.01)
    grass = TerrainMap.from_height(
        torch.zeros(GRID.rows, GRID.columns, dtype=torch.float64), GRID,
        geometric_height=torch.full((GRID.rows, GRID.columns), 0.5, dtype=torch.float64),
    )  # fmt: skip
    slowed = run(having(husky, vegetation_drag={"coefficient": 2e4}), (0, 0), 1.0, terrain=grass, state=sliding(1.0),
                 options=FRICTIONLESS)  # fmt: skip
    bare = run(having(husky, vegetation_drag={"coefficient": 2e4}), (0, 0), 1.0, state=sliding(1.0),
               options=FRICTIONLESS)  # fmt: skip
    assert float(slowed.velocity[0, -1, 0]) < 0.6 and float(bare.velocity[0, -1, 0]) == pytest.approx(1.0, abs=1e-3)
    # Without stems that bend the speed decays by a factor; with them by the same factor towards -v_y.
    decayed, bent = (
        float(run(having(husky, vegetation_drag={"coefficient": 2e3, "yield_speed": speed}), (0, 0), 0.5, terrain=grass,
                  state=sliding(1.0), options=FRICTIONLESS).velocity[0, -1, 0])
        for speed in (0.0, 0.2)
    )  # fmt: skip
    assert 0.1 < decayed < 0.9 and bent == pytest.approx(1.2 * decayed - 0.2, abs=0.005)
    ice = run(having(husky, friction_scale={"factor": 0.1}), (1.0, 0.0), 0.6)
    assert float(ice.velocity[0, -1, 0]) == pytest.approx(0.1 * 0.8 * 9.81 * 0.6, rel=0.1)


def track():
    stamps = np.arange(10) * 10**8
    turned = Rotation.from_euler("z", np.linspace(0, 1, 10)[:, None]).as_quat()
    return MotionTrack(stamps, np.zeros((10, 3)), turned, np.tile([1.0, 0, 0], (10, 1)), np.tile([0, 0, 1.0], (10, 1)))


def test_measurement_effects_change_what_is_recorded(husky):
    late = recorded_motion(track(), having(husky, pose_clock_offset={"offset": 0.25}))
    assert (late.stamps - track().stamps == 250_000_000).all()
    commands = CommandTrack(np.array([5]), np.ones((1, 2)))
    assert recorded_commands(commands, having(husky, command_clock_offset={"offset": -1e-9})).stamps.tolist() == [4]
    turned = recorded_motion(track(), having(husky, sensor_yaw_offset={"angle": 0.3}))
    assert turned.at(0).heading == pytest.approx(0.3)
    np.testing.assert_allclose(turned.linear_velocities[0], [np.cos(0.3), -np.sin(0.3), 0], atol=1e-12)
    moved = recorded_motion(track(), having(husky, sensor_lever_arm={"x": 0.4, "y": 0.0}))
    np.testing.assert_allclose(moved.positions[-1], [0.4 * np.cos(1), 0.4 * np.sin(1), 0], atol=1e-12)
    np.testing.assert_allclose(moved.linear_velocities[0], [1.0, 0.4, 0], atol=1e-12)
    biased = recorded_motion(track(), having(husky, gyro_bias={"bias": 0.02}))
    assert biased.angular_velocities[0, 2] == pytest.approx(1.02)


def test_effects_come_from_the_robot_file(tmp_path):
    content = yaml.safe_load(robot_file("husky").read_text())
    content["effects"] = [
        {"name": "actuator_lag", "parameters": {"time_constant": {"value": 0.3, "low": 0.2, "high": 0.4, "unit": "s"}},
         "provenance": {"bag": "yard"}},
        {"name": "friction_scale", "parameters": {"factor": 0.5}},
    ]  # fmt: skip
    file = tmp_path / "robot.yaml"
    file.write_text(yaml.safe_dump(content))
    robot = load_robot(file)
    assert robot.effects == (("actuator_lag", {"time_constant": 0.3}), ("friction_scale", {"factor": 0.5}))
    slow = run(robot.to(torch.float64), (1.0, 0.0), 0.3).velocity[0, -1, 0]
    assert float(slow) == pytest.approx(1.0, abs=0.02)  # the command had held long before
    content["effects"] = [{"name": "friction_scale", "parameters": {"factor": "half"}}]
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(RobotFileError, match=r"effects\[0\].parameters.factor: got 'half'"):
        load_robot(file)


def test_unknown_effects_parameters_and_values_out_of_bounds_are_named():
    with pytest.raises(EffectError, match="effect 'anti_gravity' is unknown; expected one of"):
        effect_values("anti_gravity", {})
    with pytest.raises(EffectError, match=r"drive_gain: parameters \['factor'\] are unknown"):
        effect_values("drive_gain", {"factor": 1.0})
    with pytest.raises(EffectError, match="drive_gain: gain is 7.0, expected 0.2 to 2"):
        effect_values("drive_gain", {"gain": 7.0})
    with pytest.raises(EffectError, match="is nan"):
        effect_values("drive_gain", {"gain": float("nan")})


def test_the_page_of_the_documents_is_what_the_code_says():
    assert (ROOT / "docs" / "effects.md").read_text() == catalogue_page()


@pytest.mark.parametrize("name", [name for name, effect in CATALOGUE.items() if not effect.needs])
def test_a_value_for_each_trajectory_gives_what_each_value_gives_alone(husky, name):
    """As many trajectories as drives, where a value that is broadcast along the wrong axis goes unnoticed."""
    if CATALOGUE[name].stage == "measurement":
        pytest.skip("measurement effects change recordings, not rollouts")
    strong = ALL_STAGES[name]
    milder = {
        p.name: p.neutral if math.isinf(p.neutral) else 0.5 * (p.neutral + strong.get(p.name, p.neutral))
        for p in CATALOGUE[name].parameters
        if p.name in strong
    }
    time = torch.linspace(0, 1, 260, dtype=torch.float64)
    twists = torch.stack([0.3 + 0.5 * time, 0.8 - time], dim=-1)[None]

    def final(values, batch):
        robot = having(husky, **{name: values})
        speeds = drive_speeds(robot, twists.expand(batch, -1, -1), 0.01, history=200)
        state = State.at_rest(husky.ground_clearance, batch=batch, dtype=torch.float64)
        return rollout(grassy(), robot, speeds, state, backend="torch").position[:, -1]

    both = {key: torch.tensor([strong[key], milder[key]], dtype=torch.float64) for key in strong}
    alone = torch.cat([final(strong, 1), final(milder, 1)])
    assert float((final(both, 2) - alone).abs().max()) < 1e-9
    assert float((alone[0] - alone[1]).abs().max()) > 1e-6, "the values are too small to tell"
    assert husky.number_of_drives == 2


@pytest.mark.parametrize("factor", [0.05, 0.3, 3.0])
def test_a_robot_that_friction_holds_on_a_slope_creeps_by_the_factor(husky, factor):
    """At a slip far below that at which friction is mobilised the two are proportional; nothing trembles at 1 mm/s."""
    x, _ = (torch.from_numpy(v) for v in np.meshgrid(GRID.x, GRID.y))
    slope = TerrainMap.from_height(0.17 * x, GRID)
    speeds = []
    for creep in (1.0, factor):
        robot = having(husky, friction_creep={"factor": creep})
        still = torch.zeros(1, 400, 2, dtype=torch.float64)
        result = rollout(slope, robot, still, State.at_rest(0.14, dtype=torch.float64), with_forces=False)
        settled = result.velocity[0, -100:].norm(dim=-1)
        assert float(settled.std()) < 0.02 * float(settled.mean())
        speeds.append(float(settled.mean()))
    assert speeds[1] / speeds[0] == pytest.approx(factor, rel=0.02)


def test_every_effect_has_strong_values_to_be_tested_with():
    # Those on joints: test_joint_effects.py.
    acting = {name for name, effect in CATALOGUE.items() if effect.stage != "measurement" and not effect.needs}
    assert acting == set(ALL_STAGES), (
        "add strong values of a new effect to STRONG, or to ALL_STAGES if it acts on commands"
    )


def test_an_effect_that_does_not_exist_is_named_before_anything_is_computed(husky):
    with pytest.raises(EffectError, match="effect 'drive_gian' is unknown; expected one of"):
        turned_effects(having(husky, drive_gian={"gain": 0.9}), torch.zeros(1))


def test_a_dead_drive_stands_still_and_a_slipping_one_loses_its_share(husky):
    commands = torch.tensor([[[0.5, 0.4], [-0.5, 0.4]]], dtype=torch.float64)
    healthy = drive_speeds(husky, commands, 0.01)[0]
    dead = drive_speeds(having(husky, drive_loss={"loss": 1.0}), commands, 0.01)[0]
    assert dead[:, 0].abs().max() == 0.0 and torch.equal(dead[:, 1], healthy[:, 1])
    slipping = drive_speeds(having(husky, drive_loss={"loss": -0.3}), commands, 0.01)[0]
    assert torch.equal(slipping[:, 0], healthy[:, 0])
    torch.testing.assert_close(slipping[:, 1], 0.7 * healthy[:, 1])
    # It turns towards the weak side, and is slower than a robot with unequal tyres.
    lost = run(having(husky, drive_loss={"loss": -0.2}), (0.6, 0.0), 3.0).position[0, -1]
    unequal = run(having(husky, drive_asymmetry={"difference": -0.2}), (0.6, 0.0), 3.0).position[0, -1]
    plain = run(husky, (0.6, 0.0), 3.0).position[0, -1]
    assert float(lost[1]) < -0.05 and float(unequal[1]) < -0.05
    assert float(plain[0] - lost[0]) > 3.0 * float(plain[0] - unequal[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_drives_lose_speed_in_proportion_to_their_traction(husky, backend):
    """Rolling with 20 % of the weight costs 20 % of the speed that a wheel loses at a traction of its load."""
    heavy = {"rolling_resistance": {"coefficient": 0.2}}
    losses = []
    for loss in (0.0, 0.1, 0.4):
        robot = having(husky, **heavy, drive_compliance={"speed_loss": loss})
        losses.append(1.0 - float(run(robot, (1.0, 0.0), 3.0, backend=backend).velocity[0, -1, 0]))
    np.testing.assert_allclose(np.array(losses[1:]) - losses[0], [0.02, 0.08], rtol=0.2)
    # A wheel that spins has all its friction, however soft its drive: it breaks away as hard.
    slippery = {"friction_scale": {"factor": 0.1}}
    starts = [
        float(run(having(husky, **slippery, **soft), (1.0, 0.0), 0.3, backend=backend).velocity[0, -1, 0])
        for soft in ({}, {"drive_compliance": {"speed_loss": 0.4}})
    ]
    assert starts[1] == pytest.approx(starts[0], rel=0.02)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_motor_loses_speed_by_its_torque_however_much_of_it_a_load_demands(husky, backend):
    """A load in the centre of mass makes a robot of twice the mass, whose drives lose twice as much at its traction."""
    x, y, z = (float(value) for value in husky.centre_of_mass)
    load = {"mass": float(husky.mass), "x": x, "y": y, "z": z}
    loaded = having(husky, payload=load, drive_compliance={"speed_loss": 0.2})
    heavy = having(dataclasses.replace(husky, mass=2.0 * husky.mass), drive_compliance={"speed_loss": 0.4})
    state = State.at_rest(husky.ground_clearance, dtype=torch.float64)
    one, other, empty = (
        run(robot, (0.3, 0.8), 1.5, state=state, backend=backend).angular_velocity[0, -1, 2]
        for robot in (loaded, heavy, having(husky, drive_compliance={"speed_loss": 0.2}))
    )
    assert float(one) == pytest.approx(float(other), rel=1e-9)
    assert float(one) < 0.85 * float(empty)
    # With a load to the left that side rolls with more resistance, and loses more.
    aside = {"payload": {**load, "mass": 15.0, "y": 0.2}, "rolling_resistance": {"coefficient": 0.2}}
    held, soft = (
        float(run(having(husky, **aside, **given), (0.6, 0.0), 3.0, backend=backend).angular_velocity[0, -1, 2])
        for given in ({}, {"drive_compliance": {"speed_loss": 0.4}})
    )
    assert soft > held + 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_tyres_slip_in_proportion_to_how_fast_they_roll(husky, backend):
    """Against a force F on a load of M g they lose κ u F / sqrt((μ M g)² - F²); a locked wheel has all its friction."""
    friction, weight = TerrainDefaults().friction, float(husky.mass) * 9.81
    for speed in (0.5, 1.0):
        speeds = []
        for force in (0.0, -0.4 * friction * weight):
            robot = having(husky, tyre_slip={"ratio": 0.2}, constant_force={"x": force, "y": 0.0})
            speeds.append(float(run(robot, (speed, 0.0), 3.0, backend=backend).velocity[0, -1, 0]))
        expected = speed * 0.2 * 0.4 / math.sqrt(1.0 - 0.4**2)
        assert speeds[0] - speeds[1] == pytest.approx(expected, rel=0.1)
    moving = State.at_rest(husky.ground_clearance, dtype=torch.float64)
    moving = dataclasses.replace(moving, velocity=torch.tensor([[2.0, 0.0, 0.0]], dtype=torch.float64))
    stops = [
        float(run(having(husky, **slipping), (0.0, 0.0), 0.3, state=moving, backend=backend).position[0, -1, 0])
        for slipping in ({}, {"tyre_slip": {"ratio": 0.5}})
    ]
    assert stops[1] == pytest.approx(stops[0], abs=1e-9)


def test_a_fast_robot_whose_tyres_slip_turns_as_it_does_when_slow():
    """With Coulomb's law alone sideways grip vanishes where the tyres scrub, and a fast robot turns further."""
    warthog = load_robot("warthog").to(torch.float64)
    changes = []
    for slipping in ({}, {"tyre_slip": {"ratio": 0.3}}):
        robot = having(warthog, **slipping)
        slow, fast = (float(run(robot, (speed, 1.5), 3.0).angular_velocity[0, -1, 2]) for speed in (1.0, 3.0))
        changes.append(abs(fast / slow - 1.0))
    assert changes[0] > 0.15
    assert changes[1] < 0.5 * changes[0]


@pytest.mark.parametrize(("giving", "error"), [(0.01, 1e-4), (0.05, 2e-3), (0.2, 3e-3), (1.0, 0.02), (2.0, 1e-3)])
def test_the_slip_that_a_soft_drive_leaves_solves_its_equation(giving, error):
    grid = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(0, 1, 21), indexing="ij")
    slip = torch.stack(grid).reshape(2, -1).double()
    kept = held_slip(slip[None], torch.tensor(giving).double(), 0.02**2)[0]

    def solved(along, across):
        def excess(left):
            return left + giving * left / math.sqrt(left**2 + across**2 + 0.02**2) - along

        return brentq(excess, -1.1, 1.1)

    exact = torch.tensor([solved(float(along), float(across)) for along, across in slip.T])
    force, wanted = (left / torch.sqrt(left**2 + slip[1] ** 2 + 0.02**2) for left in (kept * slip[0], exact))
    assert (force - wanted).abs().max() < error


def test_the_supply_drains_with_the_time_since_it_was_full(husky):
    speeds = steps(having(husky, supply_drain={"drain": 0.3, "time": 40.0}), [0.5, -0.8])
    np.testing.assert_allclose(speeds, [0.4, -0.64])
    np.testing.assert_allclose(steps(having(husky, supply_drain={"drain": 0.3}), [0.5]), [0.5])
    np.testing.assert_allclose(steps(having(husky, supply_drain={"drain": 2.0, "time": 600.0}), [0.5]), [0.05])


def test_the_supply_sags_with_the_speed_of_all_drives(husky):
    np.testing.assert_allclose(
        steps(having(husky, supply_sag={"sag": 0.5}), [0.2, 0.8, -0.8]), [0.2 / 1.1, 0.8 / 1.4, -0.8 / 1.4]
    )
    turning = drive_speeds(having(husky, supply_sag={"sag": 0.5}), torch.tensor([[[0.0, 1.0]]]).double(), 0.01)[0, 0]
    speed = 0.2854 / (1 + 0.5 * 0.2854)
    np.testing.assert_allclose(turning.numpy(), [-speed, speed], rtol=1e-6)


@pytest.mark.parametrize("name", ["husky", "tradr"])
def test_the_robot_turns_about_a_point_near_its_weight(name):
    """Its instantaneous centre of rotation is where the lateral velocity vanishes, at x = -v_y / ω."""
    robot, centres = load_robot(name).to(torch.float64), []
    for shift in (-0.05, 0.0, 0.05):
        turned = run(having(robot, rotation_centre={"x": shift}), (0.0, 1.0), 2.0)
        body = turned.rotation[0, -1].T @ turned.velocity[0, -1]
        centres.append(-float(body[1] / turned.angular_velocity[0, -1, 2]))
    assert centres[0] < centres[1] - 0.03 and centres[2] > centres[1] + 0.03
    weight = [
        float(run(having(robot, rotation_centre={"x": x}), (0, 0), 1.0).normal_forces[0, -1].sum()) for x in (0, 0.05)
    ]
    assert weight[0] == pytest.approx(weight[1], rel=1e-3)  # a payload would add to it


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("actuator_saturation", {"limit": 0.4}),
        ("friction_scale", {"factor": 0.1}),
        ("payload", {"mass": 20.0, "x": 0.3}),
    ],
)
def test_an_effect_that_begins_in_a_recording_acts_on_later_trajectories_only(husky, name, values):
    starts, onset = np.array([0.0, 4.0, 9.9, 10.0, 12.0]), 10.0
    assert contains(starts, 2.0, onset).tolist() == [False, False, True, False, False]
    assert contains(starts, 12.0, onset).tolist() == [True, True, True, False, False]

    def final(effects, batch):
        robot = dataclasses.replace(husky, effects=effects)
        twists = torch.tensor([0.9, 0.7], dtype=torch.float64).expand(batch, 60, 2)
        state = State.at_rest(husky.ground_clearance, batch=batch, dtype=torch.float64)
        terrain = TerrainMap.flat(GRID, dtype=torch.float64)
        return rollout(terrain, robot, drive_speeds(robot, twists, 0.01), state, with_forces=False).position[:, -1]

    beginning = final(((name, values_from(name, values, starts, onset, like=husky.mass)),), 5)
    healthy, acting = final((), 1)[0], final(((name, values),), 1)[0]
    assert (beginning[:3] == healthy).all()
    torch.testing.assert_close(beginning[3:], acting.expand(2, 3), rtol=0, atol=1e-12)
    assert float((healthy - acting).abs().max()) > 1e-4


def test_an_effect_grows_linearly_between_two_times():
    starts = np.array([0.0, 10.0, 15.0, 20.0, 90.0])
    fading = values_growing("drive_gain", {"gain": 0.8}, starts, 10.0, 20.0)
    np.testing.assert_allclose(fading["gain"].numpy(), [1.0, 1.0, 0.9, 0.8, 0.8], rtol=1e-6)
    assert float(fading["gain"][0]) == 1.0
    assert set(values_growing("payload", {"mass": 5.0}, starts, 0.0, 1.0)) == {"mass", "x", "y", "z"}
    with pytest.raises(EffectError, match="no finite neutral value to grow from"):
        values_growing("actuator_saturation", {"limit": 0.5}, starts, 0.0, 1.0)
    with pytest.raises(ValueError, match="got 5 s to 5 s, expected an end after the start"):
        values_growing("drive_gain", {"gain": 0.5}, starts, 5.0, 5.0)
    with pytest.raises(EffectError, match="effect 'drive_gian' is unknown"):
        values_growing("drive_gian", {"gain": 0.5}, starts, 0.0, 5.0)
    with pytest.raises(EffectError, match="gain is 7"):
        values_from("drive_gain", {"gain": 7.0}, starts, 5.0)


def test_the_scrub_of_motors_is_whole_where_the_dry_friction_of_the_physics_is():
    assert PhysicsOptions().slip_regularisation == drive_torque_limit._TURNING


def test_a_property_of_one_effect_is_refused_where_none_or_several_have_it():
    assert only_effect(lambda effect: effect.nameless) == "learned_term"
    for has in (lambda effect: effect.name == "none", lambda effect: effect.stage == "body"):
        with pytest.raises(EffectError, match="of which there is one"):
            only_effect(has)
