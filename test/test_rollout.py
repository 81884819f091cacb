"""The rollout against closed-form answers and invariants of mechanics."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from monoforce_ros import physics
from monoforce_ros.physics import PhysicsOptions, State
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.physics.rotation import exponential_map, rotation_angle
from monoforce_ros.robots import load_robot, shipped_robots
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

GRID = Grid.square(40.0, 0.2)
FAR_BELOW = -1000.0


@pytest.fixture(params=["torch", "warp"], autouse=True)
def backend(request, monkeypatch):
    """Every test of this file runs with either backend."""
    monkeypatch.setitem(globals(), "rollout", functools.partial(physics.rollout, backend=request.param))
    return request.param


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky").to(torch.float64)


def flat(height: float = 0.0, friction: float = 0.8) -> TerrainMap:
    return TerrainMap.flat(GRID, height=height, material=TerrainDefaults(friction=friction), dtype=torch.float64)


def slope(angle: float, friction: float) -> TerrainMap:
    height = -math.tan(angle) * torch.from_numpy(GRID.x).expand(GRID.rows, -1)
    return TerrainMap.from_height(height.contiguous(), GRID, material=TerrainDefaults(friction=friction))


rollout = physics.rollout  # replaced by the fixture above for each backend


def drive(robot, twist, seconds, *, terrain=None, state=None, options=PhysicsOptions(), batch=1, **more):
    steps = round(seconds / options.time_step)
    twists = torch.tensor(twist, dtype=torch.float64).expand(batch, steps, 2)
    if state is None:
        state = State.at_rest(robot.ground_clearance, batch=batch, dtype=torch.float64)
    with torch.no_grad():
        return rollout(terrain or flat(), robot, robot.drive_speeds(twists), state, options=options, **more)


def energy(robot, result) -> torch.Tensor:
    offset = (result.rotation @ robot.centre_of_mass[:, None])[..., 0]
    centre = result.position + offset
    velocity = result.velocity + torch.linalg.cross(result.angular_velocity, offset)
    inertia = result.rotation @ robot.inertia @ result.rotation.transpose(-1, -2)
    spin = (result.angular_velocity[..., None, :] @ inertia @ result.angular_velocity[..., None])[..., 0, 0]
    return robot.mass * (9.81 * centre[..., 2] + 0.5 * (velocity**2).sum(-1)) + 0.5 * spin


def test_free_fall(husky):
    result = drive(husky, (0.0, 0.0), 1.0, terrain=flat(FAR_BELOW))
    # Semi-implicit Euler falls by ½ g t (t + Δt).
    fallen = husky.ground_clearance - float(result.position[0, -1, 2])
    assert fallen == pytest.approx(0.5 * 9.81 * 1.0 * 1.01, rel=1e-9)
    assert float(result.velocity[0, -1, 2]) == pytest.approx(-9.81, rel=1e-9)
    assert float(result.forces.abs().max()) == 0.0


@pytest.mark.parametrize("name", ["husky", "tradr"])
def test_rests_at_the_depth_that_carries_its_weight(name):
    robot = load_robot(name).to(torch.float64)
    robot = dataclasses.replace(robot, centre_of_mass=torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64))
    result = drive(robot, (0.0, 0.0), 2.0)
    depth = rest_depth(robot, TerrainDefaults.stiffness)
    assert robot.ground_clearance - float(result.position[0, -1, 2]) == pytest.approx(depth, abs=1e-5)
    assert float(result.normal_forces[0, -1].sum()) == pytest.approx(float(robot.mass) * 9.81, rel=1e-6)
    assert float(result.velocity[0, -1].abs().max()) < 1e-6


def test_load_is_shared_by_the_lever_rule(husky):
    shifted = dataclasses.replace(husky, centre_of_mass=torch.tensor([0.064, 0.0, 0.0], dtype=torch.float64))
    result = drive(shifted, (0.0, 0.0), 3.0)
    force = result.normal_forces[0, -1]
    front = float(force[husky.points[:, 0] > 0].sum() / force.sum())
    # A quarter of half the wheelbase ahead: 62.5 % on the front axle, a little less for the pitch it causes.
    assert front == pytest.approx(0.5 + 0.064 / 0.512, abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_sticks_on_a_slope_below_the_friction_angle(husky, factor):
    angle = math.atan(factor * 0.8)
    state = dataclasses.replace(
        State.at_rest(husky.ground_clearance / math.cos(angle), dtype=torch.float64),
        rotation=exponential_map(torch.tensor([[0.0, angle, 0.0]], dtype=torch.float64)),
    )
    result = drive(husky, (0.0, 0.0), 3.0, terrain=slope(angle, 0.8), state=state)
    # Regularised friction creeps, at a speed below its regularisation.
    speed = float(result.velocity[0, -1].norm())
    assert speed < 1.2 * PhysicsOptions().slip_regularisation * factor / math.sqrt(1 - factor**2)


def test_slides_on_a_slope_beyond_the_friction_angle(husky):
    angle, friction = math.atan(0.6), 0.4
    state = dataclasses.replace(
        State.at_rest(husky.ground_clearance / math.cos(angle), dtype=torch.float64),
        rotation=exponential_map(torch.tensor([[0.0, angle, 0.0]], dtype=torch.float64)),
    )
    result = drive(husky, (0.0, 0.0), 2.0, terrain=slope(angle, friction), state=state)
    gained = float((result.velocity[0, 200] - result.velocity[0, 100]).norm())
    expected = 9.81 * (math.sin(angle) - friction * math.cos(angle))
    assert gained == pytest.approx(expected, rel=0.03)


def test_drives_straight_at_the_commanded_speed(husky):
    result = drive(husky, (0.8, 0.0), 4.0)
    assert float(result.velocity[0, -1, 0]) == pytest.approx(0.8, rel=0.02)
    assert float(result.position[0, -1, 1].abs()) < 1e-6


def test_drives_backwards(husky):
    result = drive(husky, (-0.5, 0.0), 3.0)
    assert float(result.velocity[0, -1, 0]) == pytest.approx(-0.5, rel=0.02)


def coulomb_yaw_ratio(robot) -> float:
    """Share of the ideal yaw rate that a skid-steer turn on the spot reaches with friction at four points."""
    half_track, half_base = 0.2854, 0.256
    return half_track**2 / (half_track**2 + half_base**2)


@pytest.mark.parametrize("mass", [25.0, 50.0, 100.0])
def test_skid_steer_turn_has_the_coulomb_yaw_rate_whatever_the_mass(husky, mass):
    robot = dataclasses.replace(
        husky, mass=torch.tensor(mass, dtype=torch.float64), inertia=husky.inertia * mass / 50.0
    )
    result = drive(robot, (0.0, 1.0), 3.0)
    assert coulomb_yaw_ratio(robot) == pytest.approx(0.554, abs=0.001)
    assert float(result.angular_velocity[0, -1, 2]) == pytest.approx(coulomb_yaw_ratio(robot), rel=0.04)


def test_turns_left_for_a_positive_yaw_rate(husky):
    result = drive(husky, (0.5, 0.5), 2.0)
    assert float(result.position[0, -1, 1]) > 0.1


def test_lateral_friction_below_longitudinal_turns_faster(husky):
    robot = dataclasses.replace(husky, friction_lateral=torch.tensor(0.5, dtype=torch.float64))
    fast = float(drive(robot, (0.0, 1.0), 2.0).angular_velocity[0, -1, 2])
    assert fast > 1.15 * float(drive(husky, (0.0, 1.0), 2.0).angular_velocity[0, -1, 2])


def test_torque_free_rotation_follows_eulers_equations(husky):
    spin = torch.tensor([[0.3, 3.0, 0.2]], dtype=torch.float64)
    state = dataclasses.replace(State.at_rest(0.0, dtype=torch.float64), angular_velocity=spin)
    fine = PhysicsOptions(time_step=0.001)
    result = drive(husky, (0.0, 0.0), 3.0, terrain=flat(FAR_BELOW), state=state, options=fine, with_forces=False)
    moments = np.diag(husky.inertia.numpy())

    def euler(_, rate):
        return np.cross(moments * rate, rate) / moments

    reference = solve_ivp(euler, (0.0, 3.0), spin[0].numpy(), rtol=1e-10, atol=1e-12).y[:, -1]
    in_body = (result.rotation[0, -1].T @ result.angular_velocity[0, -1]).numpy()
    np.testing.assert_allclose(in_body, reference, atol=0.03)
    # The reference itself tumbles: about the middle axis of inertia a free body does not spin steadily.
    assert np.linalg.norm(reference - spin[0].numpy()) > 0.3
    inertia = result.rotation[0] @ husky.inertia @ result.rotation[0].transpose(-1, -2)
    momentum = (inertia @ result.angular_velocity[0, :, :, None])[..., 0]
    assert float((momentum - momentum[0]).norm(dim=-1).max() / momentum[0].norm()) < 0.01


def test_no_energy_is_gained_at_rest_or_on_landing(husky):
    state = State.at_rest(husky.ground_clearance + 0.3, dtype=torch.float64)
    result = drive(husky, (0.0, 0.0), 3.0, state=state)
    total = energy(husky, result)[0]
    assert float((total - total[0]).max()) < 0.01 * float(total[0].abs())
    assert float((total[150:] - total[150]).max()) < 1e-3
    assert float(result.velocity[0, -1].abs().max()) < 1e-4


@pytest.mark.parametrize("name", shipped_robots())
@pytest.mark.parametrize("stiffness", [2e6, 2e8])
def test_survives_a_drop_on_any_ground(name, stiffness):
    robot = load_robot(name).to(torch.float64)
    material = TerrainDefaults(stiffness=stiffness, damping=0.02 * stiffness)
    terrain = TerrainMap.flat(GRID, material=material, dtype=torch.float64)
    tilt = exponential_map(torch.tensor([[0.2, 0.3, 0.0]], dtype=torch.float64))
    state = dataclasses.replace(State.at_rest(robot.ground_clearance + 0.3, dtype=torch.float64), rotation=tilt)
    result = drive(robot, (0.5, 0.0), 3.0, terrain=terrain, state=state)
    assert bool(result.valid.all())
    assert float(result.velocity.abs().max()) < 4.0
    # A heavy car sinks into soft ground by more than two centimetres.
    resting = robot.ground_clearance - rest_depth(robot, stiffness)
    assert abs(float(result.position[0, -1, 2]) - resting) < 0.02


def test_ground_never_pulls(husky):
    state = dataclasses.replace(
        State.at_rest(husky.ground_clearance - 0.02, dtype=torch.float64),
        velocity=torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
    )
    result = drive(husky, (0.0, 0.0), 0.15, state=state)
    assert float(result.normal_forces.min()) >= 0.0
    # Thrown up, it leaves no slower than gravity alone would let it.
    velocity = result.velocity[0, :, 2]
    assert float((velocity[1:] - velocity[:-1]).min()) >= -9.81 * 0.01 - 1e-9


def test_forces_split_into_normal_and_tangential_parts_within_the_friction_cone(husky):
    result = drive(husky, (0.8, 0.6), 2.0, terrain=bumpy())
    normal = result.forces - result.tangential_forces
    np.testing.assert_allclose(normal.norm(dim=-1).numpy(), result.normal_forces.numpy(), atol=1e-9)
    loaded = result.normal_forces > 1.0
    across = (normal * result.tangential_forces).sum(-1)[loaded].abs()
    assert float(across.max()) < 1e-6
    assert float((result.tangential_forces.norm(dim=-1)[loaded]).max()) > 5.0
    # The whole of it is held by the friction that the load allows (within a step, the load that was).
    share = result.tangential_forces[0, 50:].norm(dim=-1).sum(-1) / result.normal_forces[0, 50:].sum(-1)
    assert float(share.median()) < 0.8


def test_a_turned_world_gives_the_turned_trajectory(husky):
    angle = 0.7
    turn = exponential_map(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    rough = Grid.square(16.0, 0.05)
    x, y = np.meshgrid(rough.x, rough.y)

    def height(u, v):
        return 0.12 * np.sin(0.9 * u + 0.3) * np.cos(0.7 * v)

    c, s = math.cos(angle), math.sin(angle)
    maps = [
        TerrainMap.from_height(torch.from_numpy(h), rough)
        for h in (height(x, y), height(c * x + s * y, -s * x + c * y))
    ]
    state = State.at_rest(husky.ground_clearance + 0.05, dtype=torch.float64)
    turned = dataclasses.replace(state, rotation=turn @ state.rotation)
    first = drive(husky, (0.8, 0.3), 4.0, terrain=maps[0], state=state)
    second = drive(husky, (0.8, 0.3), 4.0, terrain=maps[1], state=turned)
    # The two maps sample the same surface at different places, hence millimetres and not zero.
    assert float((first.position[0] @ turn.T - second.position[0]).norm(dim=-1).max()) < 0.01
    assert float(rotation_angle(turn @ first.rotation[0], second.rotation[0]).max()) < math.radians(0.7)


def bumpy() -> TerrainMap:
    grid = Grid.square(16.0, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    return TerrainMap.from_height(torch.from_numpy(0.10 * np.sin(1.3 * x) * np.cos(0.9 * y)), grid)


def test_four_times_as_many_body_points_change_a_trajectory_by_two_centimetres_at_most(husky):
    dense = load_robot("husky", spacing=0.025).to(torch.float64)
    assert len(dense.points) > 2.5 * len(husky.points)
    runs = [drive(robot, (0.8, 0.3), 5.0, terrain=bumpy()).position[0] for robot in (husky, dense)]
    assert float((runs[0] - runs[1]).norm(dim=-1).max()) < 0.02


def test_half_the_time_step_changes_a_trajectory_by_two_centimetres_at_most(husky):
    coarse = drive(husky, (0.8, 0.3), 5.0, terrain=bumpy())
    fine = drive(husky, (0.8, 0.3), 5.0, terrain=bumpy(), options=PhysicsOptions(time_step=0.005))
    assert float((coarse.position[0] - fine.position[0, ::2]).norm(dim=-1).max()) < 0.02


def test_rolls_over_a_low_step_and_is_stopped_by_a_wall(husky):
    grid = Grid.square(16.0, 0.05)
    x = np.meshgrid(grid.x, grid.y)[0]
    ends = {}
    for name, rise in (("step", 0.08), ("wall", 0.8)):
        terrain = TerrainMap.from_height(torch.from_numpy(np.where(x > 1.5, rise, 0.0)), grid)
        ends[name] = drive(husky, (0.8, 0.0), 5.0, terrain=terrain).position[0, -1]
    assert float(ends["step"][0]) > 3.0
    assert float(ends["step"][2]) == pytest.approx(0.08 + husky.ground_clearance, abs=0.02)
    assert float(ends["wall"][0]) < 1.5


def test_one_bad_trajectory_leaves_the_others_and_their_gradient_intact(husky):
    state = State.at_rest(husky.ground_clearance, batch=3, dtype=torch.float64)
    state.position[1, 0] = torch.nan
    twists = torch.tensor([0.5, 0.2], dtype=torch.float64).expand(3, 30, 2)
    height = torch.zeros(GRID.rows, GRID.columns, dtype=torch.float64, requires_grad=True)
    result = rollout(TerrainMap.from_height(height, GRID), husky, husky.drive_speeds(twists), state)
    assert result.valid.tolist() == [True, False, True]
    assert bool(torch.isnan(result.position[1]).all())
    assert bool(torch.isfinite(result.position[[0, 2]]).all())
    result.position[result.valid].sum().backward()
    assert bool(torch.isfinite(height.grad).all()) and float(height.grad.abs().max()) > 0


def test_a_robot_that_leaves_the_map_says_so(husky):
    terrain = TerrainMap.flat(Grid.square(4.0, 0.1), dtype=torch.float64)
    result = drive(husky, (1.0, 0.0), 4.0, terrain=terrain)
    assert bool(result.inside[0, 0]) and not bool(result.inside[0, -1])
    assert bool(result.valid.all()) and abs(float(result.position[0, -1, 2]) - 0.125) < 0.01


def test_nothing_given_is_written_to(husky):
    terrain, state = flat(), State.at_rest(husky.ground_clearance, dtype=torch.float64)
    speeds = husky.drive_speeds(torch.tensor([0.5, 0.2], dtype=torch.float64).expand(1, 20, 2)).clone()
    before = [t.clone() for t in (terrain.height, state.position, state.rotation, state.velocity, speeds, husky.points)]
    rollout(terrain, husky, speeds, state)
    after = [terrain.height, state.position, state.rotation, state.velocity, speeds, husky.points]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_shapes_that_do_not_fit_are_named(husky):
    state = State.at_rest(0.1, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"drive speeds: got shape \(1, 5, 3\), expected \[1, T, 2\]"):
        rollout(flat(), husky, torch.zeros(1, 5, 3), state)
    with pytest.raises(ValueError, match="tangential_force: got 'glue'"):
        PhysicsOptions(tangential_force="glue")


@pytest.mark.parametrize("lookup", ["bilinear", "constant"])
@pytest.mark.parametrize("normal", ["normal", "vertical"])
@pytest.mark.parametrize("tangential", ["coulomb", "sigmoid", "none"])
def test_every_combination_of_models_stands_still_on_flat_ground(husky, lookup, normal, tangential):
    options = PhysicsOptions(lookup=lookup, normal_force=normal, tangential_force=tangential)
    result = drive(husky, (0.0, 0.0), 1.0, options=options)
    depth = rest_depth(husky, TerrainDefaults.stiffness)
    assert float(result.position[0, -1, 2]) == pytest.approx(husky.ground_clearance - depth, abs=1e-3)
    assert float(result.position[0, -1, :2].abs().max()) < 1e-6


def test_vertical_forces_leave_the_horizontal_motion_alone(husky):
    state = dataclasses.replace(
        State.at_rest(husky.ground_clearance, dtype=torch.float64),
        velocity=torch.tensor([[0.7, 0.2, 0.0]], dtype=torch.float64),
    )
    options = PhysicsOptions(normal_force="vertical", tangential_force="none")
    result = drive(husky, (1.0, 1.0), 2.0, terrain=bumpy(), state=state, options=options)
    centre = result.velocity + torch.linalg.cross(
        result.angular_velocity, (result.rotation @ husky.centre_of_mass[:, None])[..., 0]
    )
    np.testing.assert_allclose(centre[0, -1, :2].numpy(), [0.7, 0.2], atol=1e-9)
