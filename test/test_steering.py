"""Steered robots: inverse kinematics, servos, and the turns that come out of the contact forces."""

import dataclasses
import math

import pytest
import torch
from robots_in_motion import car, check_backends_agree, check_gradient, driven, level, standing, written

from monoforce_ros.effects import controls, drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import Controls, RobotFileError, load_robot, servo_response
from monoforce_ros.terrain import TerrainMap

STEP = 0.01

# The adjoint in double precision takes a minute to compile on an idle core, once.
pytestmark = pytest.mark.timeout(900)


def twists(robot, forward, yaw_rate=0.0, lateral=None, steps=400):
    listed = [forward, yaw_rate] + ([] if lateral is None else [lateral])
    return torch.tensor(listed, dtype=robot.points.dtype).expand(1, steps, len(listed))


def rover(kind="four_wheel_steering", limit=1.57, **changes):
    content = car(name="rover", mass=60.0, inertia_box=[0.9, 0.7, 0.4], centre_of_mass=[0.0, 0.0, 0.05], **changes)
    corners = [("fl", 0.35, 0.3), ("fr", 0.35, -0.3), ("rl", -0.35, 0.3), ("rr", -0.35, -0.3)]
    content["drive"] = {"kind": kind}
    content["wheels"] = [
        {"name": name, "drive": "all", "centre": [x, y, 0.0], "radius": 0.12, "width": 0.08} for name, x, y in corners
    ]
    content["steering"] = [{"name": f"{name}_joint", "wheel": name, "maximum_angle": limit} for name, _, _ in corners]
    content["hull"] = []
    return content


def test_ackermann_wheels_roll_about_one_centre(tmp_path):
    robot = written(tmp_path, car())
    speeds, angles = robot.command(torch.tensor([2.0, 0.3]).double())
    radius = 2.0 / 0.3
    left, right = math.atan(2.8 / (radius - 0.75)), math.atan(2.8 / (radius + 0.75))
    assert angles.tolist() == pytest.approx([left, right], rel=1e-6)
    # The bicycle between them: the cotangents' mean.
    assert 0.5 * (1 / math.tan(left) + 1 / math.tan(right)) == pytest.approx(radius / 2.8)
    expected = [0.3 * math.hypot(2.8, radius - y) for y in (0.75, -0.75)] + [0.3 * (radius - y) for y in (0.75, -0.75)]
    assert speeds.tolist() == pytest.approx(expected, rel=1e-6)
    # Backwards the yaw rate keeps its sign, and the wheels turn to the other side.
    assert robot.command(torch.tensor([-2.0, 0.3]).double())[1].tolist() == pytest.approx([-right, -left], rel=1e-6)


def test_at_standstill_the_steering_is_straight_and_gradients_are_finite(tmp_path):
    for content in (car(), rover(), rover("independent")):
        robot = written(tmp_path, content)
        command = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        speeds, angles = robot.command(command)
        assert speeds.abs().max() == 0.0 and angles.abs().max() == 0.0
        (gradient,) = torch.autograd.grad(speeds.sum() + angles.sum(), command)
        assert bool(torch.isfinite(gradient).all())


def test_a_turn_beyond_the_steering_limit_has_the_smallest_radius(tmp_path):
    robot = written(tmp_path, car())
    for yaw_rate in (5.0, -5.0):
        angles = robot.command(torch.tensor([1.0, yaw_rate]).double())[1]
        assert float(angles.abs().max()) == pytest.approx(0.6, rel=1e-6)
        assert torch.sign(angles).tolist() == [math.copysign(1.0, yaw_rate)] * 2


def tricycle(trail=0.0, scrub=0.0, limit=1.0, front=False, **changes):
    """Two wheels on one axle, driven, and one that is steered behind them or in front; its pivot is beside it."""
    x = 1.2 if front else -1.2
    content = car(
        name="tricycle", mass=300.0, inertia_box=[1.8, 1.0, 0.6], centre_of_mass=[x / 3, 0.0, 0.05], hull=[], **changes
    )
    content["wheels"] = [
        {"name": "left", "drive": "left", "centre": [0.0, 0.5, 0.0], "radius": 0.2, "width": 0.1},
        {"name": "right", "drive": "right", "centre": [0.0, -0.5, 0.0], "radius": 0.2, "width": 0.1},
        {"name": "third", "drive": None, "centre": [x + trail, scrub, 0.0], "radius": 0.2, "width": 0.1},
    ]
    content["steering"] = [{"name": "fork", "wheel": "third", "maximum_angle": limit, "pivot": [x, 0.0, 0.0]}]
    return content


@pytest.mark.parametrize("front", [True, False])
@pytest.mark.parametrize(("trail", "scrub"), [(0.15, 0.0), (-0.12, 0.0), (0.0, 0.15), (0.1, -0.1)])
def test_a_wheel_beside_its_pivot_rolls_about_the_commanded_centre(tmp_path, front, trail, scrub):
    robot = written(tmp_path, tricycle(trail, scrub, front=front))
    forward, yaw_rate = 0.5, 0.15
    speeds, (angle,) = robot.command(torch.tensor([forward, yaw_rate]).double())
    pivot, angle = (1.2 if front else -1.2), float(angle)
    centre = (
        pivot + trail * math.cos(angle) - scrub * math.sin(angle),
        trail * math.sin(angle) + scrub * math.cos(angle),
    )
    velocity = (forward - yaw_rate * centre[1], yaw_rate * centre[0])
    assert -math.sin(angle) * velocity[0] + math.cos(angle) * velocity[1] == pytest.approx(0.0, abs=1e-6)
    assert speeds.tolist()[:2] == pytest.approx([0.5 - 0.15 * 0.5, 0.5 + 0.15 * 0.5])
    steered = robot.steered
    assert steered is not None
    assert float(steered.curvature(torch.tensor([angle]).double())) == pytest.approx(yaw_rate / forward, rel=1e-5)
    # At the limit of the joint, too.
    limit = robot.command(torch.tensor([0.1, 5.0]).double())[1]
    assert float(limit.abs().max()) == pytest.approx(1.0, abs=1e-5)


def test_the_wheels_of_a_turn_may_roll_backwards_inside_it(tmp_path):
    """A forklift turns about a point between its front wheels."""
    robot = written(tmp_path, tricycle(limit=1.48))
    speeds, angles = robot.command(torch.tensor([0.2, 1.0]).double())
    assert float(angles[0]) == pytest.approx(-math.atan(1.2 / 0.2))
    assert speeds.tolist()[:2] == pytest.approx([-0.3, 0.7])
    terrain, start = level(size=8.0), standing(robot)
    result = driven(robot, controls(robot, twists(robot, 0.2, 1.0, steps=300), STEP), terrain, start)
    assert float(result.angular_velocity[0, 200:, 2].mean()) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("offset", [(0.12, 0.0), (0.0, 0.15), (-0.08, 0.1)])
@pytest.mark.parametrize("twist", [(0.0, 0.6, 0.0), (0.1, 0.5, -0.4), (-0.3, 0.4, 0.0), (0.3, 0.0, 0.3)])
def test_wheels_beside_their_pivots_roll_along_their_own_velocities(tmp_path, offset, twist):
    content = rover(limit=1.57)
    pivots = []
    for joint, wheel in zip(content["steering"], content["wheels"], strict=True):
        x, y, z = wheel["centre"]
        # Outward, as hubs are.
        wheel["centre"] = [x + offset[0], y + math.copysign(offset[1], y), z]
        joint["pivot"] = [x, y, 0.0]
        pivots.append((x, y, offset[0], math.copysign(offset[1], y)))
    robot = written(tmp_path, content)
    forward, yaw_rate, lateral = twist
    speeds, angles = robot.command(torch.tensor(twist).double())
    for speed, angle, (x, y, trail, scrub) in zip(speeds.tolist(), angles.tolist(), pivots, strict=True):
        cos, sin = math.cos(angle), math.sin(angle)
        place = (x + trail * cos - scrub * sin, y + trail * sin + scrub * cos)
        velocity = (forward - yaw_rate * place[1], lateral + yaw_rate * place[0])
        assert -sin * velocity[0] + cos * velocity[1] == pytest.approx(0.0, abs=1e-6)
        assert speed == pytest.approx(cos * velocity[0] + sin * velocity[1], abs=1e-6)


def test_a_car_at_its_largest_speed_keeps_the_commanded_curvature(tmp_path):
    robot = written(tmp_path, car(command={"track_width": 1.5, "maximum_speed": 4.0}))
    slow = robot.command(torch.tensor([4.0, 0.4]).double())
    fast = robot.command(torch.tensor([12.0, 1.2]).double())
    assert all(torch.allclose(first, second) for first, second in zip(slow, fast, strict=True))
    # A lateral speed keeps its direction as well.
    rolls = written(tmp_path, rover(command={"track_width": 0.6, "maximum_speed": 1.0}))
    assert torch.allclose(*(rolls.command(torch.tensor(t).double())[1] for t in ([1.0, 0.0, 0.5], [3.0, 0.0, 1.5])))


def test_four_steered_wheels_crab_and_turn_on_the_spot(tmp_path):
    robot = written(tmp_path, rover())
    speeds, angles = robot.command(torch.tensor([0.3, 0.0, 0.3]).double())
    assert angles.tolist() == pytest.approx([math.pi / 4] * 4)
    assert speeds.tolist() == pytest.approx([0.3 * math.sqrt(2)] * 4)
    speeds, angles = robot.command(torch.tensor([0.0, 1.0, 0.0]).double())
    assert angles.abs().tolist() == pytest.approx([math.atan2(0.35, 0.3)] * 4)
    assert speeds.abs().tolist() == pytest.approx([math.hypot(0.35, 0.3)] * 4)
    # Beyond its limit a wheel keeps to the limit and rolls at the speed along it.
    narrow = written(tmp_path, rover(limit=0.5))
    speeds, angles = narrow.command(torch.tensor([0.0, 0.0, 0.4]).double())
    assert angles.abs().max() <= 0.5
    assert speeds.abs().tolist() == pytest.approx([0.4 * math.sin(0.5)] * 4)


def test_a_servo_follows_with_lag_and_rate():
    targets = torch.ones(1, 300, 2).double()
    lags, rates = torch.tensor([0.1, 0.0]).double(), torch.tensor([math.inf, 0.5]).double()
    angles, speeds = servo_response(targets, torch.zeros(1, 2).double(), lags, rates, STEP)
    times = STEP * torch.arange(300).double()
    assert torch.allclose(angles[0, :, 0], 1.0 - torch.exp(-times / 0.1))
    assert torch.allclose(angles[0, :, 1], (0.5 * times).clamp(max=1.0))
    assert torch.allclose(angles[:, 1:], angles[:, :-1] + STEP * speeds[:, :-1])
    tracked = targets.clone().requires_grad_(True)
    again, _ = servo_response(tracked, torch.zeros(1, 2).double(), lags, rates, STEP)
    assert torch.equal(again.detach(), angles)
    (gradient,) = torch.autograd.grad(again[0, -1, 0], tracked)
    assert float(gradient.sum()) == pytest.approx(1.0 - math.exp(-2.99 / 0.1))


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("yaw_rate", [0.06, -0.2])
def test_at_low_speed_the_radius_is_that_of_the_bicycle_model(tmp_path, backend, yaw_rate):
    robot = written(tmp_path, car())
    forward = 1.0
    command = controls(robot, twists(robot, forward, yaw_rate), STEP)
    result = driven(robot, command, level(), standing(robot, forward), backend=backend, with_forces=False)
    ahead = result.rotation[0, 200:, :, 0]
    rates = result.angular_velocity[0, 200:, 2]
    # At the middle of the rear axle, where the bicycle model has its radius.
    axle = result.velocity[0, 200:] - 1.4 * torch.linalg.cross(result.angular_velocity[0, 200:], ahead)
    curvature = (rates / (axle * ahead).sum(-1)).mean()
    assert float(curvature) == pytest.approx(yaw_rate / forward, rel=0.01)
    sideways = (axle * result.rotation[0, 200:, :, 1]).sum(-1).abs().max()
    assert float(sideways) < 0.01 * forward


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_understeer_follows_from_friction(tmp_path, friction):
    robot = written(tmp_path, car())
    forward, yaw_rate = 10.0, 1.5
    command = controls(robot, twists(robot, forward, yaw_rate, steps=300), STEP)
    result = driven(robot, command, level(friction, 120.0), standing(robot, forward), with_forces=False)
    acceleration = torch.diff(result.velocity[0, :, :2], dim=0)[100:200] / STEP
    across = acceleration.norm(dim=-1).mean()
    # The commanded turn needs 15 m/s²; the ground gives no more than its friction.
    assert 0.75 * friction * 9.81 < float(across) < 1.02 * friction * 9.81
    slow = controls(robot, twists(robot, 1.0, 0.15, steps=300), STEP)
    easy = driven(robot, slow, level(friction), standing(robot, 1.0), with_forces=False)
    assert float(easy.angular_velocity[0, 150:, 2].mean()) == pytest.approx(0.15, rel=0.03)


def test_a_crab_moves_sideways_without_turning(tmp_path):
    robot = written(tmp_path, rover())
    command = controls(robot, twists(robot, 0.3, 0.0, 0.3), STEP)
    result = driven(robot, command, level(size=12.0, resolution=0.1), standing(robot), with_forces=False)
    moved = result.position[0, -1] - result.position[0, 200]
    assert moved[:2].tolist() == pytest.approx([0.6, 0.6], rel=0.03)
    assert abs(math.atan2(*result.rotation[0, -1, [1, 0], 0].tolist())) < 0.01


def test_steering_joints_of_the_robot_move_in_the_result(tmp_path):
    content = car()
    for joint in content["steering"]:
        joint["maximum_rate"] = 0.2
    robot = written(tmp_path, content)
    command = controls(robot, twists(robot, 2.0, 0.3), STEP, joint_start=torch.zeros(1, 2).double())
    result = driven(robot, command, level(), standing(robot, 2.0), with_forces=False)
    assert result.joint_angles.shape == (1, 401, 2)
    assert torch.allclose(result.joint_angles[0, 100], torch.tensor([0.2, 0.2]).double())
    assert result.joint_angles[0, -1].tolist() == pytest.approx(
        robot.command(twists(robot, 2.0, 0.3)[0, 0])[1].tolist()
    )


def test_a_delay_of_commands_delays_the_steering(tmp_path):
    robot = dataclasses.replace(written(tmp_path, car()), effects=(("command_delay", {"delay": 0.5}),))
    command = torch.cat([twists(robot, 2.0, 0.0, steps=100), twists(robot, 2.0, 0.3, steps=200)], 1)
    angles = controls(robot, command, STEP).joint_angles
    assert float(angles[0, 149].abs().max()) == 0.0
    assert float(angles[0, 155].abs().min()) > 0.2


def test_without_joint_angles_the_steering_stays(tmp_path):
    robot = written(tmp_path, car())
    speeds = drive_speeds(robot, twists(robot, 2.0, 0.3), STEP)
    held = rollout(level(), robot, Controls(speeds), standing(robot, 2.0), with_forces=False)
    assert float(held.joint_angles.abs().max()) == 0.0


def test_wrong_shapes_are_named(tmp_path):
    robot = written(tmp_path, car())
    speeds, state = torch.zeros(1, 5, 4).double(), standing(robot)
    with pytest.raises(ValueError, match=r"joint_angles: got shape \(1, 5, 3\), expected \[1, 5, 2\] for the joints"):
        rollout(level(), robot, Controls(speeds, torch.zeros(1, 5, 3)), state)
    with pytest.raises(ValueError, match=r"joint start: got shape \(1, 3\)"):
        controls(robot, twists(robot, 1.0), STEP, joint_start=torch.zeros(1, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c["steering"][0].update(wheel="hind"),
            "steering.0..wheel: got 'hind', expected the name of a wheel",
        ),
        (lambda c: c["steering"][0].update(maximum_angle=2.0), "steering.0..maximum_angle"),
        (lambda c: c["drive"].update(kind="tank"), "drive.kind: got 'tank', expected one of"),
        (lambda c: c.pop("steering"), "steering: got .., expected the steered wheels of the kind 'ackermann'"),
        (
            lambda c: c["drive"].update(kind="skid"),
            "drive.kind: got 'skid', expected ackermann, four_wheel_steering or independent",
        ),
        (lambda c: c["drive"].update(kind="four_wheel_steering"), "one for each of the 4 wheels"),
        (lambda c: c["steering"][1].update(wheel="front_left"), "a wheel that is not on 'front_left_steering'"),
        (lambda c: c["steering"][1].update(name="front_left_steering"), "names that differ"),
    ],
)
def test_errors_of_the_steering_name_the_field(tmp_path, change, message):
    content = car()
    change(content)
    with pytest.raises(RobotFileError, match=message):
        written(tmp_path, content)


def test_robots_without_joints_are_rolled_out_as_before():
    husky = load_robot("husky").to(torch.float64)
    speeds = drive_speeds(husky, torch.tensor([0.6, 0.4]).double().expand(1, 50, 2), STEP)
    state = State.at_rest(0.14, dtype=torch.float64)
    plain, wrapped = (
        rollout(TerrainMap.flat(), husky, given, state)
        for given in (speeds, controls(husky, torch.tensor([0.6, 0.4]).double().expand(1, 50, 2), STEP))
    )
    assert torch.equal(plain.position, wrapped.position) and plain.joint_angles is None


def steered_controls(robot):
    steps = 30
    wanted = torch.cat([twists(robot, 0.7, 0.2, steps=steps), twists(robot, 0.5, -0.1, steps=steps)])
    speeds, angles = robot.command(wanted)
    wiggle = 0.05 * torch.sin(torch.arange(steps).double())[:, None]
    return Controls(speeds.clone(), angles + wiggle, torch.full_like(angles, 0.1))


def test_both_backends_steer_alike_with_the_same_gradients(tmp_path):
    robot = written(tmp_path, car())
    check_backends_agree(robot, steered_controls(robot))


@pytest.mark.parametrize("name", ["joint_angles", "joint_rates", "drive_speeds", "velocity", "height", "mass"])
def test_gradients_of_steered_robots_match_finite_differences(tmp_path, name):
    robot = written(tmp_path, car())
    check_gradient(robot, steered_controls(robot), name)
