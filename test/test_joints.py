"""Flippers, casters, springs, rockers and motors against closed forms, and both backends against each other."""

import dataclasses
import math

import pytest
import torch
import yaml
from robots_in_motion import (
    STIFFNESS,
    car,
    check_backends_agree,
    check_gradient,
    driven,
    level,
    standing,
    written,
)

from monoforce_ros.effects import controls
from monoforce_ros.physics import OdeOptions, PhysicsOptions, State, rest_depth, rollout
from monoforce_ros.robots import Controls, RobotFileError, load_robot, robot_file
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

STEP = 0.01

# The adjoint in double precision takes a minute to compile on an idle core, once.
pytestmark = pytest.mark.timeout(900)
GRAVITY = 9.81
SPRING = {"name": "s", "wheel": "front_left", "stiffness": 1e3, "damping": 1.0}


def husky_like(**changes) -> dict:
    """A skid-steered robot of four wheels, symmetrical about its centre of mass."""
    wheels = [
        {"name": f"{end}_{side}", "drive": side, "centre": [x, y, 0.03], "radius": 0.165, "width": 0.11}
        for end, x in (("front", 0.25), ("rear", -0.25))
        for side, y in (("left", 0.28), ("right", -0.28))
    ]
    content = {
        "name": "cart", "mass": 50.0, "centre_of_mass": [0.0, 0.0, 0.05], "inertia_box": [0.8, 0.58, 0.3],
        "command": {"track_width": 0.56}, "wheels": wheels,
    }  # fmt: skip
    return content | changes


def with_caster(**changes) -> dict:
    """Two driven wheels and a caster that trails behind its pivot."""
    content = husky_like(name="porter", drive={"kind": "differential"}, centre_of_mass=[-0.08, 0.0, 0.05])
    content["wheels"] = [
        {"name": "left", "drive": "left", "centre": [0.0, 0.25, 0.0], "radius": 0.12, "width": 0.05},
        {"name": "right", "drive": "right", "centre": [0.0, -0.25, 0.0], "radius": 0.12, "width": 0.05},
        {"name": "rear", "drive": None, "centre": [-0.42, 0.0, -0.06], "radius": 0.06, "width": 0.02},
    ]
    content["casters"] = [{"name": "rear_caster", "wheel": "rear", "pivot": [-0.35, 0.0, 0.05]}]
    return content | changes


def rover(**changes) -> dict:
    """Everything at once: springs, a rocker, steering on a spring, a motor, a free wheel."""
    corners = [
        ("fl", 0.4, 0.3),
        ("fr", 0.4, -0.3),
        ("ml", 0.0, 0.3),
        ("rl", -0.4, 0.3),
        ("mr", 0.0, -0.3),
        ("rr", -0.4, -0.3),
    ]
    content = husky_like(name="rover", drive={"kind": "ackermann"})
    content["wheels"] = [
        {"name": n, "drive": None if n == "mr" else "all", "centre": [x, y, 0.0], "radius": 0.13, "width": 0.08}
        for n, x, y in corners
    ]
    content["steering"] = [{"name": f"{n}_steering", "wheel": n, "maximum_angle": 0.6} for n in ("fl", "fr")]
    content["suspension"] = [
        {"name": f"{n}_spring", "wheel": n, "stiffness": 3000.0, "damping": 150.0, "travel": [-0.02, 0.02]}
        for n in ("fl", "fr", "mr", "rr")
    ]
    content["rockers"] = [{"name": "left_rocker", "wheels": ["ml", "rl"], "pivot": [-0.2, 0.3, 0.1], "limit": 0.5}]
    content["motors"] = [
        {"drives": ["all"], "stall_torque": 60.0, "no_load_speed": 12.0, "maximum_torque": 50.0, "maximum_power": 200.0}
    ]
    return content | changes


def marv():
    return load_robot("marv").to(torch.float64)


def flipping(robot, rates, steps=30, batch=2, speed=0.3):
    """Flippers that turn at constant rates while the robot drives."""
    rates = torch.tensor(rates).double().expand(batch, steps, 4)
    angles = robot.joint_angles + STEP * rates.cumsum(1) - STEP * rates
    return Controls(torch.full((batch, steps, 2), speed).double(), angles, rates.clone())


def rover_controls(robot, steps=30):
    twists = torch.tensor([[0.7, 0.2], [0.5, -0.1]]).double()[:, None].expand(2, steps, 2)
    speeds, steering = robot.command(twists)
    angles = robot.joint_angles.expand(2, steps, -1).clone()
    angles[..., list(robot.steered.joints)] = steering
    start = angles[:, 0] + torch.linspace(-0.031, 0.033, angles.shape[-1]).double()
    return Controls(speeds.clone(), angles, torch.zeros_like(angles), start, 0.1 * torch.ones_like(start))


def test_both_backends_move_flippers_alike_with_the_same_gradients():
    robot = marv()
    check_backends_agree(robot, flipping(robot, [0.8, -0.5, 0.3, 0.0]))


def test_both_backends_solve_springs_rockers_and_motors_alike(tmp_path):
    robot = written(tmp_path, rover())
    check_backends_agree(robot, rover_controls(robot))


@pytest.mark.parametrize("effects", [(), (("tyre_slip", {"ratio": 0.3}),)])
def test_both_backends_turn_casters_alike(tmp_path, effects):
    robot = dataclasses.replace(written(tmp_path, with_caster()), effects=effects)
    start = torch.tensor([[0.9], [-0.4]]).double()
    speeds = torch.tensor([0.4, 0.3, 0.35]).double().expand(2, 30, 3).clone()
    check_backends_agree(robot, Controls(speeds, start[:, None].expand(2, 30, 1).clone(), None, start))


@pytest.mark.parametrize("name", ["joint_angles", "joint_rates", "drive_speeds", "centre_of_mass"])
def test_gradients_of_flippers_match_finite_differences(name):
    robot = marv()
    check_gradient(robot, flipping(robot, [0.8, -0.5, 0.3, 0.0]), name)


@pytest.mark.parametrize("name", ["joint_angles", "drive_speeds", "start_angles", "start_rates", "height"])
def test_gradients_of_springs_rockers_and_motors_match_finite_differences(tmp_path, name):
    robot = written(tmp_path, rover())
    check_gradient(robot, rover_controls(robot), name)


def test_in_free_fall_the_centre_of_mass_does_not_feel_the_flippers():
    robot = marv()
    state = State.at_rest(3.0, dtype=torch.float64)
    result = rollout(level(), robot, flipping(robot, [1.0, 1.0, -0.5, 0.5], steps=40, batch=1), state)
    at_end = robot.posed(robot.flipper_angles + 0.4 * torch.tensor([1.0, 1.0, -0.5, 0.5]))
    base, turned = result.position[0, -1], result.rotation[0, -1]
    time = 0.4
    # Semi-implicit Euler falls by half a step more.
    fallen = 3.0 - 0.5 * GRAVITY * time * (time + STEP)
    centre = base + turned @ at_end.centre_of_mass
    # The flippers turn from the first step on, while the base stands still.
    lever = 4.0 / 60.0 * 0.18 * math.cos(0.14)
    fallen += time * lever * (1.0 + 1.0 - 0.5 + 0.5)
    assert float(centre[2]) == pytest.approx(fallen + float(robot.centre_of_mass[2]), abs=1e-6)
    # The base moves against the flippers' masses.
    assert abs(float(base[2]) - fallen) > 1e-3


def test_flippers_that_have_moved_are_the_robot_posed_there():
    """The nose is lifted as high as by flippers that were there from the start."""
    robot = marv()
    target = torch.tensor([-0.6, -0.6, -0.14, -0.14]).double()
    steps = 400
    angles = robot.joint_angles + (target - robot.joint_angles) * torch.linspace(0, 2, steps).clamp(max=1.0)[:, None]
    rates = torch.diff(angles, dim=0, append=angles[-1:]) / STEP
    given = Controls(torch.zeros(1, steps, 2).double(), angles[None], rates[None])
    moved = driven(robot, given, level(size=6.0, resolution=0.1), standing(robot))
    posed = robot.posed(target)
    start = State.at_rest(posed.ground_clearance, dtype=torch.float64)
    still = rollout(level(size=6.0, resolution=0.1), posed, torch.zeros(1, steps, 2).double(), start)
    assert float(still.rotation[0, -1, 2, 0]) > 0.05
    assert float(moved.rotation[0, -1, 2, 0]) == pytest.approx(float(still.rotation[0, -1, 2, 0]), abs=2e-3)
    assert float(moved.position[0, -1, 2]) == pytest.approx(float(still.position[0, -1, 2]), abs=2e-3)


def test_the_torque_of_a_flipper_is_its_weight_and_its_load():
    robot = marv()
    target = torch.tensor([0.5, 0.5, -0.14, -0.14]).double()
    angles = target.expand(1, 300, 4).clone()
    given = Controls(torch.zeros(1, 300, 2).double(), angles, torch.zeros_like(angles))
    in_air = driven(robot, given, level(size=6.0, resolution=0.1), State.at_rest(3.0, dtype=torch.float64))
    weights = [4.0 * GRAVITY * 0.18 * math.cos(angle) for angle in (0.5, 0.5, 0.14, 0.14)]
    assert in_air.joint_torques[0, 0].tolist() == pytest.approx(weights, rel=1e-6)
    # Motors of flippers that carry the robot push down: together they balance the load on them.
    standing_up = driven(robot, given, level(size=6.0, resolution=0.1), standing(robot.posed(target)))
    carried = standing_up.normal_forces[0, -1][robot.point_joints >= 2].sum()
    assert float(carried) > 200.0
    assert float(standing_up.joint_torques[0, -1, 2:].max()) < 0.0


def test_a_flipper_without_enough_torque_does_not_lift_the_robot(tmp_path):
    tall = {}
    for torque in (5.0, 200.0):
        content = yaml.safe_load(robot_file("marv").read_text())
        for flipper in content["flippers"]:
            flipper["maximum_torque"] = torque
        robot = written(tmp_path, content | {"name": f"marv{torque:.0f}"})
        steps = 300
        wanted = torch.full((1, steps, 4), -1.2).double()
        wanted[..., 2:] = -0.14
        given = controls(robot, torch.zeros(1, steps, 2).double(), STEP, flippers=wanted)
        result = driven(robot, given, level(size=6.0, resolution=0.1), standing(robot))
        tall[torque] = float(result.rotation[0, -1, 2, 0])
        limit = 1.02 * torque + 0.5
        assert float(result.joint_torques[0, 150:].abs().max()) < limit
    assert tall[5.0] < 0.05 < 0.2 < tall[200.0]


def test_a_caster_trails(tmp_path):
    """Towed straight at speed v, a wheel at trail d turns as tan(φ/2) exp(-v t / d) (the tractrix)."""
    robot = written(tmp_path, with_caster())
    speed, trail, start = 0.5, 0.07, 1.2
    steps = 60
    angles = torch.full((1, steps, 1), start).double()
    given = Controls(torch.full((1, steps, 3), speed).double(), angles, None, angles[:, 0])
    result = driven(robot, given, level(size=8.0, resolution=0.1), standing(robot, speed))
    times = STEP * torch.arange(steps + 1).double()
    expected = 2.0 * torch.atan(math.tan(start / 2) * torch.exp(-speed * times / trail))
    turned = result.joint_angles[0, :, 0]
    assert float((turned - expected)[5:].abs().max()) < 0.12
    assert abs(float(turned[-1])) < 0.05


def test_a_spring_carries_its_share_and_sinks_under_more(tmp_path):
    stiffness = 4000.0
    springs = [
        {"name": f"{wheel['name']}_spring", "wheel": wheel["name"], "stiffness": stiffness, "damping": 400.0}
        for wheel in husky_like()["wheels"]
    ]
    robot = written(tmp_path, husky_like(suspension=springs))
    terrain = level(size=6.0, resolution=0.1)
    loaded = dataclasses.replace(robot, effects=(("payload", {"mass": 20.0, "x": 0.0, "y": 0.0, "z": 0.05}),))
    speeds = torch.zeros(1, 400, 2).double()
    rest = rollout(terrain, robot, speeds, standing(robot))
    assert float(rest.joint_angles[0, -1].abs().max()) < 1e-3
    low = rollout(terrain, loaded, speeds, standing(robot))
    assert low.joint_angles[0, -1].tolist() == pytest.approx([20.0 * GRAVITY / 4 / stiffness] * 4, rel=0.02)
    assert low.joint_torques[0, -1].tolist() == pytest.approx([-70.0 * GRAVITY / 4] * 4, rel=0.02)


def test_a_spring_swings_at_its_frequency(tmp_path):
    """Undamped: ω² = 4 k / M, with ground so stiff that it does not count."""
    stiffness = 1000.0
    springs = [
        {
            "name": f"{w['name']}_spring",
            "wheel": w["name"],
            "stiffness": stiffness,
            "damping": 0.0,
            "unsprung_mass": 0.05,
        }
        for w in husky_like()["wheels"]
    ]
    robot = written(tmp_path, husky_like(suspension=springs))
    grid = Grid.square(4.0, 0.1)
    height = torch.zeros(grid.rows, grid.columns).double()
    terrain = TerrainMap.from_height(height, grid, material=TerrainDefaults(stiffness=2e8, damping=0.0))
    start = State.at_rest(robot.ground_clearance - rest_depth(robot, 2e8) - 0.03, dtype=torch.float64)
    options = PhysicsOptions(time_step=0.001)
    up = torch.full((1, 4), 0.03).double()
    given = Controls(torch.zeros(1, 1500, 2).double(), None, None, up)
    heights = rollout(terrain, robot, given, start, options=options, with_forces=False).position[0, :, 2]
    crossings = torch.nonzero((heights[:-1] < heights.mean()) & (heights[1:] >= heights.mean()))[:, 0]
    period = float(torch.diff(crossings).double().mean()) * 0.001
    assert period == pytest.approx(2 * math.pi * math.sqrt(50.0 / 4 / stiffness), rel=0.02)


def on_a_bump(robot, height=0.06):
    """Loads of the wheels with the front left wheel on a bump, ``[D]`` [N]."""
    grid = Grid.square(4.0, 0.05)
    x, y = torch.meshgrid(*(torch.as_tensor(values).double() for values in (grid.x, grid.y)), indexing="xy")
    bump = height * ((x > 0.05) & (y > 0.05)).double()
    terrain = TerrainMap.from_height(bump, grid, material=TerrainDefaults(stiffness=STIFFNESS))
    start = State.at_rest(robot.ground_clearance + 0.04, dtype=torch.float64)
    result = rollout(terrain, robot, torch.zeros(1, 600, robot.number_of_drives).double(), start)
    loads = result.normal_forces[0, -1]
    return [float(loads[robot.point_drives == drive].sum()) for drive in range(robot.number_of_drives)]


def test_a_rocker_shares_the_load_of_its_wheels(tmp_path):
    content = husky_like()
    for wheel in content["wheels"]:
        wheel["drive"] = wheel["name"]
    stiff = on_a_bump(written(tmp_path, content))
    # Arms of 0.2 and 0.3 m: the front wheel carries 0.6 of the side's load.
    rocker = {"name": "left_rocker", "wheels": ["front_left", "rear_left"], "pivot": [0.05, 0.28, 0.03], "damping": 5.0}
    shared = on_a_bump(written(tmp_path, content | {"name": "rocking", "rockers": [rocker]}))
    names = [wheel["name"] for wheel in content["wheels"]]
    front, rear = (shared[names.index(name)] for name in ("front_left", "rear_left"))
    assert front / (front + rear) == pytest.approx(0.6, abs=0.03)
    # A rigid frame stands on three of its wheels.
    assert min(stiff) < 0.1 * max(stiff)
    assert min(shared) > 0.3 * max(shared)


def incline(angle, friction=1.5):
    grid = Grid.square(30.0, 0.25)
    x = torch.as_tensor(grid.x).double().expand(grid.rows, -1)
    return TerrainMap.from_height(
        x * math.tan(angle), grid, material=TerrainDefaults(stiffness=STIFFNESS, friction=friction)
    )


def climbing(robot, angle, speed, steps=500):
    """Speed uphill along the slope at the end, and the drives' speeds there [m/s]."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]]).double()
    zero = torch.zeros(1, 3).double()
    position = (robot.ground_clearance / cos) * torch.tensor([[0.0, 0.0, 1.0]]).double()
    # A jerk would turn the robot over.
    ramp = torch.linspace(0.0, 4.0, steps).clamp(max=1.0).double()
    given = (speed * ramp)[None, :, None].expand(1, steps, robot.number_of_drives)
    result = rollout(incline(angle), robot, given, State(position, rotation, zero, zero), with_forces=False)
    belts = result.drive_speeds
    return float(result.velocity[0, -1] @ rotation[0, :, 0]), speed if belts is None else float(belts[0, -1].mean())


@pytest.mark.parametrize("angle", [0.2, 0.4])
def test_on_a_slope_the_motors_turn_as_their_curve_allows(tmp_path, angle):
    stall, no_load, radius = 30.0, 8.0, 0.165
    motor = {"drives": ["left", "right"], "stall_torque": stall, "no_load_speed": no_load, "inertia": 0.05}
    robot = written(tmp_path, husky_like(motors=[motor]))
    force = 50.0 * GRAVITY * math.sin(angle) / 2
    uphill, belts = climbing(robot, angle, 2.0)
    assert belts == pytest.approx(no_load * radius * (1.0 - force * radius / stall), rel=0.02)
    assert uphill == pytest.approx(belts, abs=0.05)


def test_power_limits_the_speed_uphill_and_torque_the_slope(tmp_path):
    motor = {"drives": ["left", "right"], "maximum_power": 60.0, "maximum_torque": 25.0, "inertia": 0.05}
    robot = written(tmp_path, husky_like(motors=[motor]))
    angle = 0.4
    _, belts = climbing(robot, angle, 2.0)
    assert belts == pytest.approx(60.0 / (50.0 * GRAVITY * math.sin(angle) / 2), rel=0.03)
    # 45° need 28.6 N m per side; without motor limits the same robot climbs.
    assert climbing(robot, math.pi / 4, 1.0)[0] < 0.0
    assert climbing(written(tmp_path, husky_like(name="strong")), math.pi / 4, 1.0)[0] > 0.9


def test_motors_without_limits_change_nothing(tmp_path):
    plain = written(tmp_path, husky_like())
    named = written(tmp_path, husky_like(name="named", motors=[{"drives": ["left"], "inertia": 0.1}]))
    speeds = torch.tensor([0.5, 0.7]).double().expand(1, 50, 2)
    first, second = (rollout(level(size=6.0), robot, speeds, standing(robot)) for robot in (plain, named))
    assert torch.equal(first.position, second.position) and torch.equal(first.forces, second.forces)


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("torque", [300.0, 1e4, 1e6])
def test_a_torque_that_nothing_can_carry_is_as_good_as_no_limit(tmp_path, torque, backend):
    """A limit far beyond the wheels' grip: all of it at once overshot the speed, more in each step."""
    motor = {"drives": ["left", "right"], "maximum_torque": torque}
    plain = written(tmp_path, husky_like(name="plain"))
    strong = written(tmp_path, husky_like(name="strong", motors=[motor]))
    given = torch.cat([torch.tensor(pair).double().expand(1, 150, 2) for pair in ([0.8, 1.1], [-0.7, -0.3])], 1)
    found = [
        rollout(level(size=8.0), robot, given, standing(robot), backend=backend, with_forces=False)
        for robot in (plain, strong)
    ]
    assert float((found[0].position - found[1].position)[0, -1].norm()) < 0.1
    belts = found[1].drive_speeds
    assert belts is not None
    assert float((belts[0, 20:150] - given[0, 0]).abs().max()) < 0.01
    assert float((belts[0, 170:] - given[0, -1]).abs().max()) < 0.02
    # Grip accelerates the robot in a step by no more than a tenth of the speed that it is asked for.
    assert float(found[1].velocity.norm(dim=-1).max()) < 1.1 * 1.0


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("torque", [300.0, 1e4])
def test_strong_flippers_keep_to_their_rate_and_reach_their_angle(tmp_path, torque, backend):
    content = yaml.safe_load(robot_file("marv").read_text())
    for flipper in content["flippers"]:
        flipper["maximum_torque"] = torque
    robot = written(tmp_path, content)
    program = torch.full((1, 250, 4), -0.14).double()
    program[:, 50:] = -0.9
    given = controls(robot, torch.zeros(1, 250, 2).double(), 0.01, flippers=program)
    result = rollout(level(size=4.0), robot, given, standing(robot), backend=backend, with_forces=False)
    assert result.joint_angles is not None and result.joint_rates is not None
    assert float(result.joint_rates.abs().max()) < 1.02 * content["flippers"][0]["maximum_rate"]
    assert result.joint_angles[0, -1].tolist() == pytest.approx([-0.9] * 4, abs=0.01)
    assert float(result.velocity.norm(dim=-1).max()) < 0.5


def test_a_servo_reaches_its_speed_and_the_robot_with_it(tmp_path):
    motor = {"drives": ["left", "right"], "stall_torque": 60.0, "no_load_speed": 12.0, "inertia": 0.05}
    robot = written(tmp_path, husky_like(motors=[motor]))
    given = torch.full((1, 200, 2), 0.6).double()
    result = driven(robot, given, level(size=6.0, resolution=0.1), standing(robot), with_forces=False)
    assert float(result.drive_speeds[0, 0].abs().max()) == 0.0
    assert result.drive_speeds[0, -1].tolist() == pytest.approx([0.6, 0.6], rel=0.02)
    assert float(result.velocity[0, -1, 0]) == pytest.approx(0.6, rel=0.03)


def test_the_ode_variant_refuses_what_moves(tmp_path):
    robot = written(tmp_path, with_caster())
    with pytest.raises(ValueError, match="a robot with moving joints, free wheels or motor limits"):
        rollout(level(size=6.0), robot, torch.zeros(1, 5, 3).double(), standing(robot), ode=OdeOptions())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(motors=[{"drives": ["mid"]}]), "motors.0..drives: got 'mid', expected some of the drives"),
        (lambda c: c.update(motors=[{"drives": ["left"], "no_load_speed": 3.0}]), "stall_torque with no_load_speed"),
        (
            lambda c: c.update(rockers=[{"name": "r", "wheels": ["front_left"], "pivot": [0, 0, 0]}]),
            "rockers.0..wheels: got .'front_left'., expected two wheels or more",
        ),
        (
            lambda c: c.update(casters=[{"name": "c", "wheel": "front_left", "pivot": [0, 0, 0]}]),
            "casters.0..wheel: got 'front_left', expected a wheel with drive: null",
        ),
        (
            lambda c: c.update(
                suspension=[
                    {"name": "s", "wheel": "front_left", "stiffness": 1e3, "damping": 1.0, "travel": [0.1, 0.2]}
                ]
            ),
            "suspension.0..travel: got .0.1, 0.2., expected a negative and a positive number",
        ),
    ],
)
def test_errors_name_the_field(tmp_path, change, message):
    content = husky_like()
    change(content)
    with pytest.raises(RobotFileError, match=message):
        written(tmp_path, content)


def test_cars_and_casters_carry_no_load_on_the_hull(tmp_path):
    """A wheel that rolls freely is not the hull, whose contact costs."""
    for content in (car(), with_caster()):
        robot = written(tmp_path, content)
        speeds = torch.zeros(1, 50, robot.number_of_drives).double()
        result = rollout(level(), robot, speeds, standing(robot), with_contact=True)
        assert float(result.contact.load[0, -1, -1]) == 0.0
        assert float(result.contact.load[0, -1].sum()) == pytest.approx(float(robot.mass) * GRAVITY, rel=0.05)
