"""Candidates, their costs, occupancy, cost-to-go and selection."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from monoforce_ros.effects import drive_speeds
from monoforce_ros.perception import with_clear_start
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.planning import (
    CandidateSettings,
    CostWeights,
    Limits,
    SelectionWeights,
    assess,
    cost_to_go,
    fan_of_arcs,
    occupancy,
    over_horizon,
    select_candidate,
)
from monoforce_ros.planning.costs import _unobserved
from monoforce_ros.planning.selection import FIELDS
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

GRID = Grid.square(12.8, 0.1)
X, Y = np.meshgrid(GRID.x, GRID.y)
STEPS = 300


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def terrain_of(height: np.ndarray, **changes) -> TerrainMap:
    return replace(TerrainMap.from_height(torch.from_numpy(height.astype(np.float32)), GRID), **changes)


def assessed(husky, terrain, fan, speed=0.0, **how):
    """Costs of commands held for 3 s from a speed (standstill) in the middle of a map."""
    fan = np.array(fan, float)
    fan = fan if fan.ndim == 3 else np.atleast_2d(fan)[:, None]
    twists = torch.from_numpy(over_horizon(fan, np.zeros((0, 2)), STEPS)).float()
    low = float(husky.points[:, 2].min())
    middle = GRID.rows // 2
    height = float(terrain.height[middle, middle]) - low - float(rest_depth(husky, float(terrain.stiffness.mean())))
    state = State.at_rest(height, batch=len(fan))
    state = replace(state, velocity=state.velocity + torch.tensor([speed, 0.0, 0.0]))
    result = rollout(terrain, husky, husky.drive_speeds(twists), state, options=PhysicsOptions(), with_contact=True)
    return assess(result, terrain, husky, twists, **how), result


def test_a_fan_contains_every_speed_from_right_to_left_and_standing():
    fan = fan_of_arcs(CandidateSettings(count=11, speeds=(0.5, 1.0), yaw_rate=0.6))
    assert fan.shape == (11, 4, 2) and not fan[-1].any() and (fan == fan[:, :1]).all()
    for speed in (0.5, 1.0):
        rates = fan[fan[:, 0, 0] == speed, 0, 1]
        assert rates.tolist() == pytest.approx([-0.6, -0.3, 0.0, 0.3, 0.6])
    assert fan_of_arcs(CandidateSettings(count=1, speeds=(0.5,))).tolist() == [[[0.5, 0.0]] * 4]
    # With fewer arcs than speeds, the last speeds are used.
    assert fan_of_arcs(CandidateSettings(count=2, speeds=(0.0, 0.4, 0.8)))[:, 0].tolist() == [[0.8, 0.0], [0.0, 0.0]]
    twists = over_horizon(fan, np.full((20, 2), 0.3), 50)
    assert twists.shape == (11, 70, 2) and (twists[:, :20] == 0.3).all() and (twists[3, 20:] == fan[3, 0]).all()
    for wrong in ({"count": 0}, {"speeds": ()}, {"speeds": (float("nan"),)}, {"yaw_rate": -1.0}):
        with pytest.raises(ValueError, match="got"):
            CandidateSettings(**wrong)


def test_turns_in_place_continue_straight():
    fan = fan_of_arcs(CandidateSettings(count=11, speeds=(0.0, 1.0), yaw_rate=0.6))
    turns = fan[:5]
    assert turns[:, 0] == pytest.approx(np.array([[0.0, rate] for rate in (-0.6, -0.3, 0.0, 0.3, 0.6)]))
    on = [1.0, 0.0]
    assert turns[1, 2:].tolist() == [turns[1, 0].tolist(), on] and turns[2, 2:].tolist() == [on, on]
    assert (turns[[0, 4]] == turns[[0, 4], :1]).all()
    # The fan is symmetric.
    assert turns[::-1, :, 1] == pytest.approx(-turns[..., 1])
    # Without forward speeds there are only turns.
    only = fan_of_arcs(CandidateSettings(count=6, speeds=(0.0,), yaw_rate=0.6))
    assert (only == only[:, :1]).all()


def test_a_car_gets_arcs_that_its_steering_reaches_and_backs_out():
    car = load_robot("rally_car")
    curvature = car.maximum_curvature
    assert 0.3 < curvature < 3.0 and load_robot("husky").maximum_curvature == np.inf
    fan = fan_of_arcs(CandidateSettings(count=22, speeds=(0.0, 0.4, 0.8), yaw_rate=0.8, curvature=curvature))
    moving = fan[:-1].reshape(-1, 2)
    assert (np.abs(moving[:, 1]) <= np.abs(moving[:, 0]) * curvature + 1e-9).all() and (moving[:, 0] != 0).all()
    assert np.abs(moving[:, 1]).max() == pytest.approx(min(0.8, 0.8 * curvature))
    # In place of turns on the spot: back along an arc, then ahead.
    assert fan[1, 0, 0] == -0.4 and fan[1, -1].tolist() in ([0.8, 0.0], fan[1, 0].tolist())
    assert {tuple(entry) for entry in fan[2:5, -1]} == {(0.8, 0.0)}
    # The robot's own kinematics follow every command without a limit.
    speeds, _ = car.command(torch.from_numpy(moving))
    assert torch.isfinite(speeds).all()
    with pytest.raises(ValueError, match="curvature: got nan"):
        CandidateSettings(curvature=float("nan"))


def test_a_robot_right_before_a_wall_has_a_feasible_candidate(husky):
    """Every forward arc hits the wall; only turning first and then driving makes progress."""
    settings = CandidateSettings(count=20, speeds=(0.0, 0.8), yaw_rate=1.5)
    # The husky's nose is 0.5 m ahead of its middle.
    found, result = assessed(husky, terrain_of(np.where(X > 0.75, 1.0, 0.0)), fan_of_arcs(settings))
    arcs = torch.from_numpy(fan_of_arcs(settings)[:, 0, 0] == 0.8)
    assert not bool((found.feasible & arcs).any())
    away = result.position[:, -1, :2].norm(dim=-1)
    assert float(away[found.feasible].max()) > 0.5


def test_level_ground_is_feasible_and_standing_costs_least(husky):
    found, _ = assessed(husky, terrain_of(np.zeros_like(X)), [[0.5, 0.0], [0.5, 0.5], [0.0, 0.0]])
    assert bool(found.feasible.all()) and found.best == 2 and found.violations(0) == ""
    assert all(float(value.max()) < 0.6 for value in found.terms.values())
    assert float(found.terms["collision"].max()) < 0.05


def test_a_side_slope_causes_roll_and_load_loss_and_is_infeasible_if_too_steep(husky):
    gentle, _ = assessed(husky, terrain_of(0.2 * Y), [[0.5, 0.0]])
    # The robot starts level, drops onto the slope and overshoots.
    assert 1.0 < float(gentle.terms["roll"][0]) / (np.arctan(0.2) / Limits().roll) < 1.5
    assert 0.1 < float(gentle.terms["wheel_load"][0]) < 1.0 and bool(gentle.feasible[0])
    steep, _ = assessed(husky, terrain_of(0.8 * Y), [[0.5, 0.0]])
    assert not bool(steep.feasible[0]) and "roll" in steep.violations(0) and "times its limit" in steep.violations(0)
    assert steep.best is None
    uphill, _ = assessed(husky, terrain_of(0.2 * X), [[0.5, 0.0]])
    assert float(uphill.terms["pitch"][0]) > 3 * float(uphill.terms["roll"][0])


def test_a_wall_is_a_collision_and_the_path_past_it_is_not(husky):
    wall = np.where((X > 1.2) & (X < 1.6) & (np.abs(Y) < 0.8), 1.0, 0.0)
    found, result = assessed(husky, terrain_of(wall), [[0.8, 0.0], [0.8, 0.9], [-0.5, 0.0]])
    assert float(result.position[0, -1, 0]) < 1.2
    assert float(found.terms["collision"][0]) > 1.0 and "collision" in found.violations(0)
    assert float(found.terms["slip"][0]) > 2 * float(found.terms["slip"][2])
    assert float(found.terms["collision"][2]) < 0.1 and bool(found.feasible[2]) and found.best == 2
    # The cost agrees with feasibility.
    assert float(found.cost[0]) > float(found.cost[2])


@pytest.mark.parametrize("resolution", [0.05, 0.1])
@pytest.mark.parametrize("name", ["husky", "tradr", "offroad_car"])
def test_a_path_keeps_its_distance_from_an_obstacle_that_it_does_not_touch(name, resolution):
    robot, grid = load_robot(name), Grid.square(12.8, resolution)
    (low, high), side = robot.bounds, float(robot.bounds[1][1])
    tall = float(high[2] - low[2]) + 0.3
    twists = torch.tensor([0.5, 0.0]).expand(1, 200, 2)

    def value(gap, height=tall, sign=1.0):
        wall = np.where(sign * grid.y[:, None] > side + gap, height, 0.0) * np.ones(grid.columns)
        terrain = TerrainMap.from_height(torch.from_numpy(wall).float(), grid)
        start = State.at_rest(robot.ground_clearance)
        result = rollout(terrain, robot, drive_speeds(robot, twists, 0.01), start, with_contact=True, force_every=6)
        found = assess(result, terrain, robot, twists)
        assert float(found.terms["collision"][0]) < 0.05
        return float(found.terms["obstacle_clearance"][0])

    # Where a cell's edge lies is known to half a cell, and it is interpolated over one.
    reach = 1.5 * resolution
    for sign in (1.0, -1.0):
        assert value(0.1 + reach, sign=sign) <= 1.0 and value(0.3 + reach, sign=sign) == 0.0
        assert value(0.2 - resolution / 2, sign=sign) > 0.0
    assert value(0.1 - resolution / 2, height=0.03) == 0.0, "what wheels climb is no obstacle"


def test_a_robot_that_stands_beside_a_wall_may_leave_but_not_come_closer(husky):
    side = float(husky.bounds[1][1])
    wall = np.where(side + 0.02 < Y, 1.0, 0.0)
    found, _ = assessed(husky, terrain_of(wall), [[0.0, 0.0], [0.5, 0.0], [0.5, -0.3], [0.5, 0.6]])
    assert float(found.terms["obstacle_clearance"][:3].min()) > 1.0 and "too close to an obstacle" in found.violations(
        3
    )
    assert found.feasible.tolist() == [True, True, True, False]
    # Away from the wall a path to it is infeasible before it touches.
    away, _ = assessed(husky, terrain_of(np.where(side + 0.6 < Y, 1.0, 0.0)), [[0.5, 0.0], [0.4, 0.12], [0.5, 0.6]])
    assert away.feasible.tolist() == [True, True, False] or away.feasible.tolist() == [True, False, False]


def test_a_robot_that_leaves_an_obstacle_does_not_come_near_another_one(husky):
    side, front = float(husky.bounds[1][1]), float(husky.bounds[1][0])
    beside = side + 0.05 < Y

    def feasible(height, *commands):
        found, _ = assessed(husky, terrain_of(np.where(height, 1.0, 0.0)), commands)
        assert float(found.terms["collision"].max()) < 0.7, "nothing is hit"
        assert float(found.terms["obstacle_clearance"].min()) > 1.0, "all start too close"
        return found.feasible.tolist()

    # A wall beside the robot, and one across its way, before which the path ends.
    assert feasible(beside, [0.3, 0.0], [0.3, -0.1]) == [True, True]
    ahead = [0.314, 0.0], [0.314, -0.05], [0.1, 0.0]
    assert feasible(beside | (front + 1.0 < X), *ahead) == [False, False, True]
    # It leaves the wall, and ends beside another one.
    swerve = [*[[0.4, -0.8]] * 2, *[[0.4, 0.8]] * 2, [0.2, 0.0]]
    assert feasible(beside, swerve) == [True]
    assert feasible(beside | ((X > 1.0) & (-side - 0.28 > Y)), swerve) == [False]


def test_a_diverged_candidate_does_not_hide_the_wall_from_the_others(husky):
    wall = terrain_of(np.where(float(husky.bounds[1][1]) + 0.05 < Y, 1.0, 0.0))
    twists = torch.tensor([[0.5, 0.0], [0.5, 0.0]])[:, None].expand(2, 200, 2)
    start = State.at_rest(husky.ground_clearance, batch=2)
    result = rollout(wall, husky, husky.drive_speeds(twists), start, with_contact=True)
    position = result.position.clone()
    position[1, 50:] = torch.nan
    found = assess(replace(result, position=position), wall, husky, twists)
    assert float(found.terms["obstacle_clearance"][0]) > 1.0


@pytest.mark.parametrize("height", [0.2, 0.25, 0.5])
@pytest.mark.parametrize("name", ["husky", "warthog", "tradr"])
def test_a_robot_whose_wheels_stand_in_what_the_map_takes_for_ground_may_stand_and_leave(name, height):
    robot = load_robot(name)
    front = float(robot.bounds[1][0])
    terrain = terrain_of(np.where(front - 0.15 < X, height, 0.0))
    start = State.at_rest(robot.ground_clearance)
    terrain = with_clear_start(terrain, robot, start)
    twists = torch.tensor([[0.0, 0.0], [-0.4, 0.0], [0.8, 0.0]])[:, None].expand(3, 300, 2)
    state = State.at_rest(robot.ground_clearance, batch=3)
    result = rollout(terrain, robot, robot.drive_speeds(twists), state, with_contact=True, force_every=6)
    still = rollout(terrain, robot, robot.drive_speeds(torch.zeros(1, 300, 2)), start, with_contact=True, force_every=6)
    found = assess(result, terrain, robot, twists, standing=still)
    assert found.feasible[:2].tolist() == [True, True], (found.violations(0), found.violations(1))
    # Whether one candidate is feasible does not depend on the others, such as one that stands.
    leaving = rollout(terrain, robot, robot.drive_speeds(twists[1:2]), start, with_contact=True, force_every=6)
    alone = assess(leaving, terrain, robot, twists[1:2], standing=still)
    assert bool(alone.feasible[0]) and float(alone.cost[0]) == pytest.approx(float(found.cost[1]), rel=1e-4)
    # Driving on costs more than leaving.
    assert float(found.cost[2]) > float(found.cost[1])


def test_the_clearance_is_differentiable_in_the_motion(husky):
    beside = Y - float(husky.bounds[1][1])
    wall = terrain_of(np.where(beside > 0.1, 0.3 + 0.2 * beside, 0.0))
    start = State.at_rest(husky.ground_clearance)

    def value(rate):
        twists = torch.stack([torch.full((1, 200), 0.5), rate.expand(1, 200)], dim=-1)
        result = rollout(wall, husky, drive_speeds(husky, twists, 0.01), start, with_contact=True)
        return assess(result, wall, husky, twists).terms["obstacle_clearance"].sum()

    rate = torch.tensor(0.03, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(rate), rate)
    with torch.no_grad():
        difference = (value(torch.tensor(0.031)) - value(torch.tensor(0.029))) / 0.002
    assert float(gradient) == pytest.approx(float(difference), rel=0.05) and abs(float(gradient)) > 1e-3


def test_rough_ground_varies_the_load_and_slippery_ground_causes_slip(husky):
    smooth, _ = assessed(husky, terrain_of(np.zeros_like(X)), [[0.8, 0.0]])
    rough, _ = assessed(husky, terrain_of(0.05 * np.sin(9 * X) * np.cos(7 * Y)), [[0.8, 0.0]])
    assert float(rough.terms["force_variation"][0]) > 3 * float(smooth.terms["force_variation"][0])
    climb = terrain_of(0.25 * X)
    slippery, _ = assessed(husky, replace(climb, friction=torch.full_like(climb.height, 0.22)), [[0.8, 0.0]])
    firm, _ = assessed(husky, climb, [[0.8, 0.0]])
    assert float(slippery.terms["slip"][0]) > 1.0 > float(firm.terms["slip"][0])
    level, _ = assessed(husky, terrain_of(np.zeros_like(X)), [[0.8, 0.0]])
    assert float(firm.terms["effort"][0]) > 3 * float(level.terms["effort"][0])


def test_unobserved_ground_has_a_cost(husky):
    ahead = torch.from_numpy(X < 1.2)
    found, _ = assessed(husky, terrain_of(np.zeros_like(X), observed=ahead), [[0.9, 0.0], [-0.9, 0.0], [0.0, 0.0]])
    assert float(found.terms["unobserved"][0]) > 0.5 and float(found.terms["unobserved"][1]) == 0.0
    assert float(found.terms["unobserved"][2]) == 0.0


def test_ground_of_uncertain_height_is_unknown_by_degrees(husky):
    def term(spread):
        # Rows of returns, between which an encoder predicts.
        rows = torch.from_numpy(np.round(np.hypot(X, Y), 1) % 1.5 == 0.0)
        terrain = terrain_of(np.zeros_like(X), observed=rows)
        spreads = {name: torch.full_like(terrain.height, spread) for name in ("geometric_spread", "decrease_spread")}
        found, _ = assessed(husky, replace(terrain, **spreads), [[0.9, 0.0]])
        return float(found.terms["unobserved"][0])

    terms = [term(spread) for spread in (0.005, 0.05, 0.1, 1.0)]
    assert terms[0] < 1e-3 and terms[-1] > 0.8
    assert all(first < second for first, second in pairwise(terms))


def test_ground_behind_which_nothing_was_measured_may_be_a_drop_however_sure_an_encoder_is(husky):
    def term(observed):
        terrain = terrain_of(np.zeros_like(X), observed=torch.from_numpy(observed))
        spreads = {name: torch.full_like(terrain.height, 0.005) for name in ("geometric_spread", "decrease_spread")}
        found, _ = assessed(husky, replace(terrain, **spreads), [[0.9, 0.0]])
        return float(found.terms["unobserved"][0])

    # An edge 1.2 m ahead, beyond which no pulse returns; and a gap, behind which there is ground again.
    assert term(X < 1.2) > 0.5
    assert term((X < 1.2) | (X > 4.5)) < 0.01


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_edge_under_the_wheels_of_one_side_counts(husky, side):
    """Nothing is measured beyond 0.1 m beside the middle: the wheels, 0.28 m beside it, may be over a drop."""
    edge = terrain_of(np.zeros_like(X), observed=torch.from_numpy(side * Y < 0.1))
    spreads = {name: torch.full_like(edge.height, 0.005) for name in ("geometric_spread", "decrease_spread")}
    edge = replace(edge, **spreads)
    found, _ = assessed(husky, edge, [[0.9, 0.0], [0.9, -0.6 * side]])
    along, away = found.terms["unobserved"].tolist()
    assert along > 0.5 and away < 0.6 * along


@pytest.mark.parametrize("spread", [None, 0.005])
def test_an_edge_right_before_the_robot_counts(husky, spread):
    """A lidar that looks over the ground within 1.5 m sees none 0.3 m before the robot's nose, and none behind it."""
    edge = 0.3 + float(husky.bounds[1][0])

    def term(observed, *commands):
        terrain = terrain_of(np.zeros_like(X), observed=torch.from_numpy(observed))
        if spread is not None:
            spreads = {
                name: torch.full_like(terrain.height, spread) for name in ("geometric_spread", "decrease_spread")
            }
            terrain = replace(terrain, **spreads)
        found, _ = assessed(husky, terrain, commands)
        return found.terms["unobserved"].tolist()

    seen = np.hypot(X, Y) > 1.5
    ahead, back, turning = term(seen & (edge > X), [0.3, 0.0], [-0.3, 0.0], [0.0, 0.5])
    assert ahead > 1.0 and back == 0.0 and turning < 0.01
    # On level ground the blind zone holds nobody.
    assert term(seen, [0.3, 0.0], [0.2, 0.4]) == [0.0, 0.0]
    # An edge that is seen: the front wheels pass it 0.1 m before the middle of the robot has come to it.
    wheels = float(husky.points[husky.point_drives >= 0][:, 0].max())
    (over,) = term((np.hypot(X, Y) > 0.6) & (wheels + 0.1 > X), [0.3, 0.0])
    assert over > 0.7


def test_sensors_that_look_ahead_only_keep_a_robot_neither_from_driving_nor_from_backing_out(husky):
    ahead = (np.abs(np.arctan2(Y, X)) < np.radians(35.0)) & (X > 0.6)
    terrain = terrain_of(np.zeros_like(X), observed=torch.from_numpy(ahead))
    found, _ = assessed(husky, terrain, [[0.3, 0.0], [0.3, 0.2], [-0.3, 0.0], [0.0, 0.5]])
    assert float(found.terms["unobserved"].max()) < 0.4


def test_ground_remembered_under_and_behind_a_robot_widens_no_field_of_view(husky):
    """Of a lidar that looks ahead, after a drive of 1.8 m straight ahead: beside the robot nobody looked."""
    ahead = (np.abs(np.arctan2(Y, X)) < np.radians(35.0)) & (X > 1.2)
    driven = (np.abs(Y) < 0.4) & (X > -1.8) & (X <= 1.2)
    terrain = terrain_of(np.zeros_like(X), observed=torch.from_numpy(ahead | driven))
    found, _ = assessed(husky, terrain, [[0.3, 1.0], [0.5, 0.5], [-0.4, 0.0]])
    assert float(found.terms["unobserved"].max()) < 0.4


@pytest.mark.parametrize("speed", [1.5, 3.0])
def test_braking_is_no_slip(husky, speed):
    found, _ = assessed(husky, terrain_of(np.zeros_like(X)), [[0.0, 0.0], [0.5, 0.0]], speed=speed)
    assert bool(found.feasible[0]), found.violations(0)


def test_what_counts_as_unobserved_depends_on_the_way_driven_and_on_the_robot_s_length(husky):
    unknown = terrain_of(np.zeros_like(X), observed=torch.from_numpy(np.hypot(X, Y) > 2.0))
    small = replace(husky, points=0.2 * husky.points, wheel_radius=0.2 * husky.wheel_radius)
    length = float((small.bounds[1] - small.bounds[0])[0])
    assert 0.1 < length < 0.3

    def term(robot, moved):
        count = 1 + len(moved)
        still = torch.zeros(1, count, 3)
        place = still.clone()
        place[0, 1:, 0] = torch.tensor(moved)
        rollout = SimpleNamespace(
            position=place, inside=torch.ones(1, count, dtype=torch.bool), rotation=torch.eye(3).expand(1, count, 3, 3)
        )
        return float(_unobserved(rollout, unknown, robot)[0])

    assert term(small, [0.1, 0.3, 0.5]) == 1.0
    assert term(husky, [0.1, 0.3, 0.5]) == 0.0
    # Two fifths of the way with a wheel over unknown ground, though it takes only a third of the steps.
    half = replace(unknown, observed=torch.from_numpy(X < 2.0))
    slow = [1.0 + 0.02 * i for i in range(1, 50)] + [2.5, 3.0]
    still = torch.zeros(1, len(slow) + 1, 3)
    still[0, 1:, 0] = torch.tensor(slow)
    rollout = SimpleNamespace(
        position=still,
        inside=torch.ones(1, len(slow) + 1, dtype=torch.bool),
        rotation=torch.eye(3).expand(1, len(slow) + 1, 3, 3),
    )
    front = float(husky.points[husky.point_drives >= 0][:, 0].max())
    assert float(_unobserved(rollout, half, husky)[0]) == pytest.approx((3.0 - (2.1 - front)) / 3.0, abs=0.03)


def test_weights_and_limits_scale_the_terms(husky):
    terrain = terrain_of(0.2 * Y)
    found, result = assessed(husky, terrain, [[0.5, 0.0]])
    weights = CostWeights(**dict.fromkeys(found.terms, 0.0) | {"roll": 2.0})
    alone, _ = assessed(husky, terrain, [[0.5, 0.0]], weights=weights)
    assert float(alone.cost[0]) == pytest.approx(2 * float(found.terms["roll"][0]), rel=1e-5)
    strict, _ = assessed(husky, terrain, [[0.5, 0.0]], limits=Limits(roll=0.1))
    assert not bool(strict.feasible[0]) and strict.violations(0).startswith("roll")
    with pytest.raises(ValueError, match="has no contact forces"):
        assess(replace(result, contact=None), terrain, husky, torch.zeros(1, STEPS, 2))
    with pytest.raises(ValueError, match="limit of roll: got 0"):
        Limits(roll=0.0)
    with pytest.raises(ValueError, match="cost weight slip: got -1"):
        CostWeights(slip=-1.0)


def test_a_diverged_candidate_is_never_selected(husky):
    terrain = terrain_of(np.zeros_like(X))
    _, result = assessed(husky, terrain, [[0.5, 0.0], [0.4, 0.0]])
    lost = result.position.clone()
    lost[0] = torch.nan
    broken = replace(result, valid=torch.tensor([False, True]), position=lost)
    found = assess(broken, terrain, husky, torch.full((2, STEPS, 2), 0.4))
    assert found.best == 1 and not bool(found.feasible[0]) and found.violations(0) == "the rollout diverged"


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_occupancy_matches_the_terrain_for_any_heading(heading):
    wall = np.where((X > 2.0) & (X < 2.6) & (np.abs(Y - 1.0) < 0.5), 1.0, 0.1 * X)
    terrain = terrain_of(wall, observed=torch.from_numpy(Y > -3.0))
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    pose[:3, 3] = [10.0, -4.0, 0.3]
    found = occupancy(terrain, pose, slope_limit=0.5, step_limit=0.15)

    def at(x: float, y: float) -> int:
        place = pose[:2, :2] @ [x, y] + pose[:2, 3]
        column, row = ((place - np.array(found.origin)) / found.resolution).astype(int)
        return int(found.data[row, column])

    assert at(2.0, 1.0) == at(2.6, 1.0) == 100
    assert at(0.0, -4.0) == -1
    # A slope of 0.1 is a fifth of the limit.
    assert at(-3.0, 2.0) == pytest.approx(100 * np.arctan(0.1) / 0.5, abs=3)
    assert found.data.dtype == np.int8 and found.data.min() == -1 and found.data.max() == 100
    with pytest.raises(ValueError, match="occupancy limits"):
        occupancy(terrain, pose, slope_limit=0.0, step_limit=0.1)


@pytest.mark.parametrize("direction", [0.0, np.pi / 8, np.pi / 4, 3 * np.pi / 4])
def test_the_cost_of_a_slope_and_of_an_edge_does_not_depend_on_their_direction(direction):
    along = np.cos(direction) * X + np.sin(direction) * Y

    def cost(height):
        found = occupancy(terrain_of(height), np.eye(4), slope_limit=0.5, step_limit=0.03)
        return found.data[found.grid.inside]

    slope = cost(np.tan(0.4) * along)
    assert slope.min() >= 79 and slope.max() <= 81
    # A kerb of 10 cm.
    assert cost(np.where(along > 0.0, 0.1, 0.0)).max() == 100


def test_ground_behind_an_edge_is_unknown_in_the_occupancy():
    def at(x, height=0.0):
        observed = torch.from_numpy((X < 2.0) & (np.hypot(X, Y) > 0.5))
        terrain = terrain_of(np.where(X > 1.85, height, 0.0), observed=observed)
        found = occupancy(terrain, np.eye(4), slope_limit=0.5, step_limit=0.1)
        column, row = ((np.array([x, 0.0]) - np.array(found.origin)) / found.resolution).astype(int)
        return int(found.data[row, column])

    assert at(1.5) == 0 and at(2.25) == -1
    # A wall stays one.
    assert at(1.9, height=1.0) == at(1.8, height=1.0) == 100


def test_selection_weighs_cost_against_the_remaining_distance():
    candidates = {
        "x": np.array([3.0, 2.5, 0.0, 3.0]), "y": np.array([0.0, 1.5, 0.0, -1.0]),
        "heading": np.array([0.0, 0.6, 0.0, -0.4]), "speed": np.array([0.8, 0.8, 0.0, 0.8]),
        "yaw_rate": np.array([0.0, 0.5, 0.0, -0.4]), "cost": np.array([0.5, 0.4, 0.1, 0.5]), "feasible": np.ones(4),
    }  # fmt: skip
    for share in (25, 50, 75):
        candidates |= {f"{axis}_{share}": candidates[axis] * share / 100 for axis in "xy"}
    robot = np.zeros(2)
    assert select_candidate(candidates, robot, np.array([8.0, 0.0])) == 0
    assert select_candidate(candidates, robot, np.array([5.0, 6.0])) == 1
    # At the goal, standing is best.
    assert select_candidate(candidates, robot, np.array([0.0, 0.0])) == 2
    # A goal closer than the end of any candidate is passed.
    assert select_candidate(candidates, robot, np.array([1.2, 0.0])) == 0
    # An infeasible candidate is never selected, however close to the goal it ends.
    restricted = candidates | {"feasible": np.array([0.0, 1.0, 1.0, 1.0])}
    assert select_candidate(restricted, robot, np.array([8.0, 0.0])) in (1, 3)
    costly = candidates | {"cost": np.array([5.0, 0.1, 0.1, 5.0])}
    assert select_candidate(costly, robot, np.array([8.0, 0.0]), SelectionWeights(cost=10.0)) == 1
    assert select_candidate(candidates | {"feasible": np.zeros(4)}, robot, np.array([8.0, 0.0])) is None
    assert select_candidate(candidates | {"cost": np.full(4, np.inf)}, robot, np.array([8.0, 0.0])) is None
    # At an astronomical distance all scores are infinite: no infeasible candidate may win.
    with np.errstate(over="ignore", invalid="ignore"):
        assert select_candidate(restricted, robot, np.array([1e200, 0.0])) in (1, 2, 3, None)
    with pytest.raises(ValueError, match="fields \\['cost'\\] are missing"):
        select_candidate({k: v for k, v in candidates.items() if k != "cost"}, robot, np.zeros(2))


def test_the_cost_to_go_leads_around_a_wall():
    data = np.zeros((100, 100), np.int8)
    # Cells of 0.1 m from (-5, -5): a wall at x = 1 from y = -3 to the upper border.
    data[20:, 60:63] = 100
    goal = np.array([3.0, 1.0])
    to_goal = cost_to_go(data, 0.1, np.array([-5.0, -5.0]), goal, radius=0.3)
    behind, before = float(to_goal.at(np.array([2.0, 1.0]))), float(to_goal.at(np.array([0.0, 1.0])))
    assert behind == pytest.approx(1.0, abs=0.2)
    # Around the wall's lower end, not through it.
    around = np.hypot(1.0, 4.3) + np.hypot(2.0, 4.3)
    assert 0.9 * around < before < 1.4 * around
    free = cost_to_go(np.zeros_like(data), 0.1, np.array([-5.0, -5.0]), goal, radius=0.3)
    assert float(free.at(np.array([0.0, 1.0]))) == pytest.approx(3.0, abs=0.2)
    # A goal beyond the map, and a place off it.
    far = cost_to_go(np.zeros_like(data), 0.1, np.array([-5.0, -5.0]), np.array([9.0, 0.0]), radius=0.3)
    assert float(far.at(np.array([0.0, 0.0]))) == pytest.approx(9.0, abs=0.4)
    assert float(far.at(np.array([8.0, 0.0]))) == pytest.approx(1.0)
    # A robot too close to the wall still finds a path away from it.
    assert np.isfinite(to_goal.cost).all()
    assert float(to_goal.at(np.array([0.85, 0.0]))) > float(to_goal.at(np.array([0.5, 0.0])))
    with pytest.raises(ValueError, match="costmap"):
        cost_to_go(np.zeros((0, 4)), 0.1, np.zeros(2), goal, radius=0.3)


def test_the_cost_to_go_prefers_a_wider_gap_a_little_further_away():
    data = np.zeros((100, 100), np.int8)
    # A wall across; straight ahead a gap of 0.9 m, 1.5 m to its side one of 2 m.
    data[:, 60:62] = 100
    data[45:54, 60:62] = 0
    data[60:80, 60:62] = 0
    goal = np.array([3.0, 0.0])
    corner, start = np.array([-5.0, -5.0]), np.array([-2.0, 0.0])
    both = float(cost_to_go(data, 0.1, corner, goal, radius=0.3).at(start))
    data[45:54, 60:62] = 100
    wide = float(cost_to_go(data, 0.1, corner, goal, radius=0.3).at(start))
    assert both == wide
    data[60:80, 60:62] = 100
    data[45:54, 60:62] = 0
    narrow = float(cost_to_go(data, 0.1, corner, goal, radius=0.3).at(start))
    assert np.isfinite(narrow) and narrow > wide


def test_selection_goes_around_an_obstacle():
    """Straight ahead ends closer to the goal, but in front of a wall; the path to the right leads around it."""
    data = np.zeros((100, 100), np.int8)
    data[30:, 70:73] = 100
    goal = np.array([4.0, 0.0])
    to_goal = cost_to_go(data, 0.1, np.array([-5.0, -5.0]), goal, radius=0.3)
    ends = {"x": [1.2, 0.9], "y": [0.0, -0.9], "heading": [0.0, -0.8], "speed": [0.5, 0.5], "yaw_rate": [0.0, -0.5],
            "cost": [0.2, 0.2], "feasible": [1.0, 1.0]}  # fmt: skip
    for share in (25, 50, 75):
        ends |= {f"{axis}_{share}": [share / 100 * v for v in ends[axis]] for axis in "xy"}
    candidates = {name: np.array(values) for name, values in ends.items()}
    weights = SelectionWeights(heading=0.0)
    assert select_candidate(candidates, np.zeros(2), goal, weights) == 0
    assert select_candidate(candidates, np.zeros(2), goal, weights, to_goal) == 1


def test_standing_is_selected_only_if_nothing_makes_progress():
    """However expensive the other candidates are: otherwise a robot in front of an obstacle would never leave it."""
    ends = {"x": [1.0, 0.8, 0.0], "y": [0.5, -0.5, 0.0], "heading": [0.5, -0.5, 0.0], "speed": [0.5, 0.4, 0.0],
            "yaw_rate": [0.4, -0.4, 0.0], "cost": [9.0, 8.0, 0.0], "feasible": [1.0, 1.0, 1.0]}  # fmt: skip
    for share in (25, 50, 75):
        ends |= {f"{axis}_{share}": [share / 100 * v for v in ends[axis]] for axis in "xy"}
    candidates = {name: np.array(values) for name, values in ends.items()}
    assert select_candidate(candidates, np.zeros(2), np.array([5.0, 0.0])) == 1
    assert select_candidate(candidates, np.zeros(2), np.array([-5.0, 0.0])) == 2
    assert (
        select_candidate(candidates | {"feasible": np.array([0.0, 0.0, 1.0])}, np.zeros(2), np.array([5.0, 0.0])) == 2
    )


def test_selection_keeps_clearance_to_a_wall():
    """Two candidates end equally close to the goal; one passes close to a wall."""
    data = np.zeros((100, 100), np.int8)
    data[57:59, 40:80] = 100  # at y = 0.7 to 0.9
    goal = np.array([4.0, 0.0])
    to_goal = cost_to_go(data, 0.1, np.array([-5.0, -5.0]), goal, radius=0.3)
    assert to_goal.proximity_at(np.array([[1.0, 0.5], [1.0, -0.6], [9.0, 0.5]])).tolist() == [1.0, 0.0, 0.0]
    ends = {"x": [1.5, 1.5], "y": [0.4, -0.45], "heading": [0.0, 0.0], "speed": [0.5, 0.5], "yaw_rate": [0.1, -0.1],
            "cost": [0.2, 0.25], "feasible": [1.0, 1.0]}  # fmt: skip
    for share in (25, 50, 75):
        ends |= {f"{axis}_{share}": [share / 100 * v for v in ends[axis]] for axis in "xy"}
    candidates = {name: np.array(values) for name, values in ends.items()}
    # Distance and heading are equal; the wall decides.
    assert (
        select_candidate(
            candidates, np.zeros(2), goal, SelectionWeights(distance=0.0, heading=0.0, clearance=0.0), to_goal
        )
        == 0
    )
    assert select_candidate(candidates, np.zeros(2), goal, SelectionWeights(distance=0.0, heading=0.0), to_goal) == 1


def test_selection_does_not_alternate_between_similar_paths():
    """Otherwise noise would make a robot in front of the middle of a wall turn left and right forever."""
    ends = {"x": [1.0, 1.0], "y": [1.0, -1.0], "heading": [0.8, -0.8], "speed": [0.0, 0.0], "yaw_rate": [0.8, -0.8],
            "cost": [0.5, 0.5], "feasible": [1.0, 1.0]}  # fmt: skip
    for share in (25, 50, 75):
        ends |= {f"{axis}_{share}": [share / 100 * v for v in ends[axis]] for axis in "xy"}
    candidates = {name: np.array(values) for name, values in ends.items()}
    goal = np.array([5.0, 0.0])
    for noise in (0.1, -0.1):
        noisy = candidates | {"cost": candidates["cost"] + [noise, -noise]}
        assert select_candidate(noisy, np.zeros(2), goal) == int(noise > 0.0)
        assert select_candidate(noisy, np.zeros(2), goal, previous_command=(0.0, 0.8)) == 0
        assert select_candidate(noisy, np.zeros(2), goal, previous_command=(0.0, -0.7)) == 1
    # A much better path is taken nevertheless.
    better = candidates | {"cost": np.array([2.0, 0.5])}
    assert select_candidate(better, np.zeros(2), goal, previous_command=(0.0, 0.8)) == 1


def test_robots_that_crab_get_candidates_that_move_sideways():
    settings = {"count": 20, "speeds": (0.0, 0.8), "yaw_rate": 0.8}
    plain, fan = fan_of_arcs(CandidateSettings(**settings)), fan_of_arcs(CandidateSettings(**settings, lateral=0.5))
    assert plain.shape == (20, 4, 2) and fan.shape == (20, 4, 3)
    sideways = np.abs(fan[..., 2]).max(axis=1) > 0
    assert fan[sideways, 0].tolist() == [[0.0, 0.0, 0.5], [0.0, 0.0, -0.5], [0.8, 0.0, 0.5], [0.8, 0.0, -0.5]]
    assert not fan[-1].any()
    assert fan_of_arcs(CandidateSettings(count=5, speeds=(0.8,), lateral=0.5)).shape == (5, 4, 3)
    with pytest.raises(ValueError, match="candidate lateral speed"):
        CandidateSettings(lateral=-1.0)


@pytest.mark.parametrize(("name", "value"), [("x", np.nan), ("heading", np.inf), ("speed", np.nan), ("speed", 1e6)])
def test_a_candidate_that_no_robot_can_drive_is_left_out_and_spoils_no_other(name, value):
    """Diverged rollouts have no positions."""
    fields = {field: np.zeros(3) for field in FIELDS} | {"feasible": np.ones(3), "speed": np.full(3, 0.5)}
    for share, along in ((25, 0.5), (50, 1.0), (75, 1.5), (100, 2.0)):
        x, y = ("x", "y") if share == 100 else (f"x_{share}", f"y_{share}")
        fields |= {x: along * np.array([0.7, 1.0, 0.7]), y: along * np.array([0.7, 0.0, -0.7])}
    fields["heading"] = np.array([0.8, 0.0, -0.8])
    goal, robot = np.array([8.0, 0.0]), np.zeros(2)
    assert select_candidate(fields, robot, goal) == 1
    for bad, expected in ((0, 1), (2, 1), (1, 0)):
        changed = {key: values.copy() for key, values in fields.items()}
        changed[name][bad] = value
        assert select_candidate(changed, robot, goal) == expected
    assert select_candidate({**fields, name: np.full(3, value)}, robot, goal) is None


def test_large_maps_are_coarsened_before_they_are_searched():
    data = np.zeros((3000, 3000), np.int16)
    data[:2900, 1440:1560] = 100
    found = cost_to_go(data, 0.05, np.zeros(2), np.array([100.0, 75.0]), radius=0.3)
    assert found.cost.size <= 1_000_000 and found.resolution >= 0.15
    # Around the wall, through the gap of 5 m at its end.
    assert 150.0 < float(found.at(np.array([[50.0, 75.0]]))[0]) < 180.0


def test_a_robot_that_leans_beyond_a_limit_may_get_away(husky):
    """A slope that turned out steeper than predicted must not hold the robot for ever."""
    angle, limits = 0.35, Limits(pitch=0.3)
    cos, sin = np.cos(angle), np.sin(angle)
    heights = np.where(X < 1.2, np.tan(angle) * X, np.tan(angle) * 1.2 + np.tan(0.65) * (X - 1.2))
    terrain = terrain_of(heights)
    fan = np.array([[0.0, 0.0], [0.0, 0.4], [0.8, 0.0]])[:, None]
    twists = torch.from_numpy(over_horizon(fan, np.zeros((0, 2)), STEPS)).float()
    rotation = torch.tensor([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]).float().expand(3, 3, 3)
    place = torch.tensor([0.0, 0.0, husky.ground_clearance / cos]).float().expand(3, 3)
    state = State(place, rotation, torch.zeros(3, 3), torch.zeros(3, 3))
    result = rollout(terrain, husky, husky.drive_speeds(twists), state, options=PhysicsOptions(), with_contact=True)
    found = assess(result, terrain, husky, twists, limits=limits)
    assert float(found.terms["pitch"].min()) > 1.1, "all of them lean too far at the start"
    assert found.feasible.tolist() == [True, True, False], "standing and turning lean no further, driving uphill does"
