"""Effects on steering and flippers: nothing at neutral values, the closed form at others, alike in both backends."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from robots_in_motion import car, level, written
from test_steering import rover

from monoforce_ros.effects import CATALOGUE, controls, identifiable_effects
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot

STEP = 0.01
STRONG = {
    "steering_lag": {"time_constant": 0.31},
    "steering_deadband": {"width": 0.25, "alignment": 0.8},
    "steering_gain": {"gain": 0.8},
    "steering_offset": {"offset": -0.04},
    "blocked_flipper": {"front_left": 0.7, "front_right": 0.2, "rear_left": 0.4, "rear_right": 0.3},
}
STEERING = [name for name in STRONG if name != "blocked_flipper"]

# The adjoint in double precision takes a minute to compile on an idle core, once.
pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """A robot that steers, and one with flippers."""
    small = rover("ackermann", limit=0.5)
    small["steering"] = small["steering"][:2]
    for entry in small["steering"]:
        entry["maximum_rate"] = 3.0
    steering = written(tmp_path_factory.mktemp("robots"), small)
    return {"steering": steering, "flippers": load_robot("marv").to(torch.float64)}


def having(robot, **effects):
    return dataclasses.replace(robot, effects=tuple(effects.items()))


def given(robot, name, batch=1, seconds=0.6):
    """Controls with steps of the steering, or flippers that move."""
    steps = round(seconds / STEP)
    time = torch.linspace(0.0, seconds, steps + 20, dtype=torch.float64)
    twists = torch.stack([0.8 + 0.0 * time, 0.2 + 0.5 * torch.sign(torch.sin(9.0 * time))], dim=-1)
    flippers = None
    if CATALOGUE[name].needs == "flippers":
        start = robot.flipper_angles
        flippers = (start + 0.5 * time[20:, None] * torch.tensor([1.0, 0.7, -0.5, -0.6]).double()).expand(batch, -1, -1)
    return controls(robot, twists.expand(batch, -1, -1), STEP, history=20, flippers=flippers)


def moved(robot, name, backend="warp", batch=1):
    state = State.at_rest(robot.ground_clearance, batch=batch, dtype=torch.float64)
    return rollout(level(), robot, given(robot, name, batch), state, backend=backend)


def test_every_effect_on_joints_has_strong_values_to_be_tested_with():
    assert {name for name, effect in CATALOGUE.items() if effect.needs} == set(STRONG)


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("name", STRONG)
def test_neutral_values_change_nothing_bit_for_bit(robots, name, backend):
    robot = robots[CATALOGUE[name].needs]
    neutral = {parameter.name: parameter.neutral for parameter in CATALOGUE[name].parameters}
    plain, same = moved(robot, name, backend), moved(having(robot, **{name: neutral}), name, backend)
    for field in ("position", "rotation", "velocity", "angular_velocity", "forces"):
        assert torch.equal(getattr(plain, field), getattr(same, field)), field


@pytest.mark.parametrize("name", STRONG)
def test_robots_without_such_joints_are_left_alone(name):
    husky = load_robot("husky").to(torch.float64)
    twists = torch.tensor([0.6, 0.4], dtype=torch.float64).expand(1, 50, 2)
    plain, same = (
        controls(robot, twists, STEP, history=20) for robot in (husky, having(husky, **{name: STRONG[name]}))
    )
    assert torch.equal(plain.drive_speeds, same.drive_speeds) and same.joint_angles is None
    assert name not in {effect.name for effect in identifiable_effects(husky)}


def test_candidates_are_the_effects_on_joints_that_a_robot_has(robots):
    found = {kind: {effect.name for effect in identifiable_effects(robot)} for kind, robot in robots.items()}
    assert found["steering"] - found["flippers"] == set(STEERING)
    # Steered wheels roll through turns: there is no scrub under which drives could droop, or that brakes motors.
    assert found["flippers"] - found["steering"] == {"blocked_flipper", "drive_droop", "drive_torque_limit"}


@pytest.mark.parametrize("name", STRONG)
def test_gradients_match_finite_differences_and_between_backends(robots, name):
    robot = robots[CATALOGUE[name].needs]
    weights = torch.linspace(0.5, 2.0, 3, dtype=torch.float64)

    def loss(values, backend="warp"):
        result = moved(having(robot, **{name: values}), name, backend)
        return (result.position[0, -1] * weights).sum() + result.rotation[0, -1, 0].sum()

    leaves = {key: torch.tensor(v, dtype=torch.float64, requires_grad=True) for key, v in STRONG[name].items()}
    gradients = [torch.autograd.grad(loss(leaves, backend), list(leaves.values())) for backend in ("torch", "warp")]
    np.testing.assert_allclose(*([float(g) for g in each] for each in gradients), rtol=1e-7, atol=1e-12)
    for key, gradient in zip(leaves, gradients[1], strict=True):
        step = 1e-5
        with torch.no_grad():
            f = [float(loss({**STRONG[name], key: STRONG[name][key] + k * step})) for k in (-2, -1, 1, 2)]
        numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step)
        assert float(gradient) == pytest.approx(numeric, rel=1e-4, abs=1e-8), key
        assert gradient != 0.0


@pytest.mark.parametrize("name", STRONG)
def test_a_value_for_each_trajectory_gives_what_each_value_gives_alone(robots, name):
    robot = robots[CATALOGUE[name].needs]
    milder = {p.name: 0.5 * (p.neutral + STRONG[name][p.name]) for p in CATALOGUE[name].parameters}
    both = {key: torch.tensor([STRONG[name][key], milder[key]], dtype=torch.float64) for key in milder}
    together = given(having(robot, **{name: both}), name, 2).joint_angles
    alone = [given(having(robot, **{name: values}), name).joint_angles[0] for values in (STRONG[name], milder)]
    torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-12)
    assert float((alone[0] - alone[1]).abs().max()) > 1e-3


def steered(tmp_path, angles, **effects):
    """Angles of the left wheel of a car whose servo follows at once, commanded ``angles`` of its bicycle [rad]."""
    robot = written(tmp_path, car())
    curvature = torch.tan(torch.as_tensor(angles).double()) / robot.steered.wheelbase
    twists = torch.stack([torch.full_like(curvature, 2.0), 2.0 * curvature], dim=-1)[None]
    plain, changed = (controls(r, twists, STEP).joint_angles[0, :, robot.steered.joints[0]] for r in (
        robot, having(robot, **effects)))  # fmt: skip
    return plain.numpy(), changed.numpy()


def test_steering_effects_have_their_closed_forms(tmp_path):
    angles = np.r_[np.zeros(5), np.full(100, 0.2), np.full(60, -0.01), np.full(40, -0.3)]
    plain, changed = steered(tmp_path, angles, steering_gain={"gain": 0.7})
    np.testing.assert_allclose(changed, 0.7 * plain, atol=1e-9)
    plain, changed = steered(tmp_path, angles, steering_offset={"offset": 0.05})
    np.testing.assert_allclose(changed[1:], plain[1:] + 0.05, atol=1e-9)
    # Play holds the angle without alignment; with it the angle decays over the way.
    plain, changed = steered(tmp_path, angles, steering_deadband={"width": 0.03, "alignment": 0.0})
    np.testing.assert_allclose(changed[6:105], plain[50] - 0.03, atol=1e-9)
    np.testing.assert_allclose(changed[106:165], plain[130] + 0.03, atol=1e-9)
    straight = np.r_[np.full(50, 0.2), np.zeros(150)]
    plain, changed = steered(tmp_path, straight, steering_deadband={"width": 0.03, "alignment": 0.8})
    way = 2.0 * STEP * np.arange(1, 149)
    np.testing.assert_allclose(changed[52:], 0.03 * np.exp(-0.8 * way), atol=2e-4)
    plain, changed = steered(tmp_path, angles, steering_lag={"time_constant": 0.25})
    rise = np.arange(1, 100) * STEP
    np.testing.assert_allclose(changed[6:105], plain[50] * (1.0 - np.exp(-rise / 0.25)), atol=1e-9)
    # Without the limits of the joint.
    plain, changed = steered(tmp_path, np.full(10, 0.58), steering_gain={"gain": 1.5})
    assert changed[-1] == pytest.approx(0.6)


@pytest.mark.parametrize("offset", [0.03, -0.06, 0.1])
@pytest.mark.parametrize("has_differential", [True, False])
def test_the_wheels_of_a_bent_rod_drive_a_circle(tmp_path, offset, has_differential):
    """On level ground at low speed the radius is that of the bicycle, if the driven wheels do not resist it."""
    content, resistance = car(), 0.0
    if not has_differential:
        for wheel in content["wheels"]:
            wheel["drive"] = wheel["drive"] and wheel["name"]
        # The driven wheels hold one speed. While all wheels slip less than the regularisation friction is proportional
        # to slip: the moment of w ω / 2 along at either rear wheel balances that of half the lateral slip v δ - ω L at
        # the front, the rear axle taking the other half.
        resistance = 1.5**2 / (2.0 * 2.8**2)
    robot = having(written(tmp_path, content), steering_offset={"offset": offset})
    twists = torch.tensor([1.5, 0.0], dtype=torch.float64).expand(1, 300, 2)
    state = State.at_rest(robot.ground_clearance, dtype=torch.float64)
    result = rollout(level(), robot, controls(robot, twists, STEP), state, with_forces=False)
    turned = float(result.angular_velocity[0, -1, 2] / result.velocity[0, -1, :2].norm())
    assert turned == pytest.approx(math.tan(offset) / robot.steered.wheelbase / (1.0 + resistance), rel=0.03)


def test_a_blocked_flipper_stays_and_the_others_move(robots):
    robot = robots["flippers"]
    angles = given(having(robot, blocked_flipper={"rear_left": 1.0}), "blocked_flipper").joint_angles[0]
    index = [joint.name for joint in robot.joints].index("rear_left")
    change = (angles[-1] - angles[0]).abs()
    assert float(change[index]) == 0.0
    assert float(change.sum()) > 0.5 and int((change == 0.0).sum()) == 1


def test_steering_that_was_not_measured_follows_from_the_commands_before(robots):
    robot = robots["steering"]
    twists = torch.tensor([1.0, 0.4], dtype=torch.float64).expand(1, 80, 2)
    start = torch.full((1, len(robot.joints)), torch.nan, dtype=torch.float64)
    from_commands = controls(robot, twists, STEP, history=40)
    unknown = controls(robot, twists, STEP, history=40, joint_start=start)
    torch.testing.assert_close(unknown.joint_angles, from_commands.joint_angles, rtol=0, atol=1e-12)
    start[:, robot.steered.joints[0]] = 0.0
    measured = controls(robot, twists, STEP, history=40, joint_start=start).joint_angles[0, 0]
    assert float(measured[robot.steered.joints[0]]) == 0.0
    assert float(measured[robot.steered.joints[1]]) == pytest.approx(float(from_commands.joint_angles[0, 0, 1]))


def test_flippers_without_a_command_hold_their_measured_angle(robots):
    robot = robots["flippers"]
    start = torch.tensor([[0.3, torch.nan, 0.1, 0.0]], dtype=torch.float64)
    program = torch.full((1, 50, 4), torch.nan, dtype=torch.float64)
    program[..., 2] = 0.2
    twists = torch.zeros(1, 50, 2, dtype=torch.float64)
    angles = controls(robot, twists, STEP, joint_start=start, flippers=program).joint_angles[0, -1]
    assert angles.tolist() == pytest.approx([0.3, float(robot.flipper_angles[1]), 0.2, 0.0], abs=1e-3)
