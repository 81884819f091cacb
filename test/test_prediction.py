"""From measured motion to the state that a prediction starts from."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.perception import FlatTerrain, Observation
from monoforce_ros.perception.ground_alignment import aligned_to_ground, clear_of
from monoforce_ros.perception.terrain_sources import choose_terrain_source, lowered
from monoforce_ros.physics import State, rollout
from monoforce_ros.prediction import Predictor
from monoforce_ros.prediction.predictor import start_states
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap


def test_the_start_has_the_robots_own_attitude_and_velocities():
    rotation = Rotation.from_euler("xyz", [0.1, -0.2, 2.0])
    velocity, rate = np.array([0.8, 0.1, 0.0]), np.array([0, 0, 0.4])
    motion = MotionState(0, np.array([5.0, 6.0, 7.0]), rotation.as_matrix(), velocity, rate)
    state = start_states([motion], torch.float64)
    level = Rotation.from_euler("z", -motion.heading)
    np.testing.assert_allclose(state.position[0], 0.0)
    np.testing.assert_allclose(state.rotation[0], (level * rotation).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(state.velocity[0], (level * rotation).apply([0.8, 0.1, 0.0]), atol=1e-12)
    np.testing.assert_allclose(state.angular_velocity[0], (level * rotation).apply([0, 0, 0.4]), atol=1e-12)


def test_a_moving_robot_is_predicted_onwards_in_the_odometry_frame():
    robot = load_robot("husky")
    predictor = Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()), horizon=1.0)
    west = Rotation.from_euler("z", np.pi).as_matrix()
    motion = MotionState(0, np.array([3.0, -1.0, 0.4]), west, np.array([0.6, 0, 0]), np.zeros(3))
    twists = np.tile([0.6, 0.0], (len(predictor.command_stamps(0)), 1))
    positions = predictor.predict(Observation(0), motion, twists).positions()
    np.testing.assert_allclose(positions[0], [3.0, -1.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(positions[-1], [2.4, -1.0, 0.4], atol=0.02)


def test_ground_does_not_act_before_it_is_touched():
    robot = load_robot("husky")
    above = State.at_rest(robot.ground_clearance + 0.1)
    result = rollout(TerrainMap.flat(Grid.square(4.0)), robot, torch.zeros(1, 20, 2), above)
    lowest = result.position[0, :-1, 2] - robot.ground_clearance
    assert float(result.forces[0, lowest > 1e-4].abs().max()) == 0.0
    assert float(result.forces[0, lowest < -1e-3].abs().max()) > 0.0


def swept(wall, beyond=8.0):
    """Lidar returns of level ground outside a ring around the robot, and of a wall across at x = ``wall``."""
    random = np.random.default_rng(0)
    radius, angle = random.uniform(1.4, beyond, 12000), random.uniform(-np.pi, np.pi, 12000)
    ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(12000, -0.131)], axis=1)
    ground = ground[ground[:, 0] < wall]
    front = np.stack([np.full(4000, wall), random.uniform(-1.5, 1.5, 4000), random.uniform(-0.1, 0.8, 4000)], axis=1)
    return np.concatenate([ground, front])


def test_a_wall_just_ahead_does_not_reach_into_the_robot_that_stands_before_it():
    """A lidar sees no ground near the robot; filled in from the wall's height, it would push the robot away."""
    robot = load_robot("husky")
    still = MotionState(0, np.zeros(3), Rotation.from_euler("z", 0.7).as_matrix(), np.zeros(3), np.zeros(3))
    predictor = Predictor(robot, choose_terrain_source("lidar", robot), horizon=1.0)
    seen = predictor.source.terrain(Observation(0, swept(0.62)), still)
    terrain = clear_of(seen, robot, still)
    twists = np.zeros((1, len(predictor.command_stamps(0)), 2))

    def pushed(terrain, twists):
        places = predictor.roll_out(terrain, [still], twists).position[0].numpy()
        return np.linalg.norm(places - places[0], axis=1)

    assert pushed(seen, twists).max() > 0.2, "as it is filled in"
    assert pushed(terrain, twists).max() < 0.03
    assert terrain.height.max() > 0.5, "the wall itself stays"
    # Driving on, it runs into it.
    assert pushed(terrain, twists + np.array([0.5, 0.0]))[-1] < 0.25


def test_only_what_reaches_into_the_hull_is_lowered():
    robot, grid = load_robot("husky"), Grid.square(6.4, 0.1)
    tilted = MotionState(0, np.zeros(3), Rotation.from_euler("yx", [0.2, 0.1]).as_matrix(), np.zeros(3), np.zeros(3))
    x, y = np.meshgrid(grid.x, grid.y)
    high = TerrainMap.from_height(torch.ones(grid.rows, grid.columns), grid)
    cleared = clear_of(high, robot, tilted).height.numpy()
    hull = tilted.rotation @ [0.3, 0.1, 0.0]
    row, column, _ = grid.cells(hull[None, :2])
    assert cleared[row[0], column[0]] == pytest.approx(hull[2], abs=0.03)
    assert (cleared[(np.abs(x) > 0.65) | (np.abs(y) > 0.5)] == 1.0).all()
    low = TerrainMap.from_height(torch.full((grid.rows, grid.columns), -0.5), grid)
    assert clear_of(low, robot, tilted) is low
    on_its_side = MotionState(0, np.zeros(3), Rotation.from_euler("x", np.pi / 2).as_matrix(), *np.zeros((2, 3)))
    assert clear_of(high, robot, on_its_side) is high


def test_a_predicted_map_is_laid_under_the_wheels_and_left_alone_elsewhere():
    grid = Grid.square(6.4, 0.1)
    x, _ = np.meshgrid(grid.x, grid.y)
    terrain = TerrainMap.from_height(torch.from_numpy((0.3 + 0.1 * x).astype(np.float32)), grid)
    wheels = np.array([[0.3, 0.3, -0.05], [0.3, -0.3, -0.05], [-0.3, 0.3, -0.1], [-0.3, -0.3, -0.1]])
    laid = aligned_to_ground(terrain, wheels)
    rows, columns, _ = grid.cells(wheels[:, :2])
    np.testing.assert_allclose(laid.height.numpy()[rows, columns], wheels[:, 2], atol=0.02)
    far = np.hypot(x, x.T) > 1.2
    np.testing.assert_array_equal(laid.height.numpy()[far], terrain.height.numpy()[far])
    # What stands above the ground is as high as before: vegetation holds by its height.
    torch.testing.assert_close(laid.geometric_height - laid.height, terrain.geometric_height - terrain.height)
    # No step at the border of what was moved.
    assert float(np.abs(np.diff(laid.height.numpy(), axis=1)).max()) < 0.15
    assert aligned_to_ground(terrain, wheels + np.array([50.0, 0.0, 0.0])) is terrain


def test_a_lidars_surfaces_are_lowered_by_what_gives_way_and_walls_stand():
    grid = Grid.square(6.4, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    grass, wall = (x > 1) & (x < 2), (x > 2.5) & (y > 0)
    measured = np.where(wall, 1.5, np.where(grass, 0.45, 0.1))

    def of(values):
        return torch.from_numpy(np.asarray(values, np.float32) + np.zeros_like(x, dtype=np.float32))

    swept = TerrainMap.from_height(of(measured), grid)
    # The encoder has missed the wall, is 4 cm off on the ground and not quite sure that it is firm.
    decrease = np.where(grass, 0.3, 0.015)
    seen = TerrainMap.from_height(of(0.06), grid, geometric_height=of(0.06 + decrease))
    both = lowered(swept, seen)
    height = both.height.numpy()
    np.testing.assert_allclose(height[grass], 0.06, atol=1e-6)
    np.testing.assert_allclose(height[wall], 1.5, atol=1e-6)
    firm = ~grass & ~wall
    np.testing.assert_allclose(height[firm], 0.1, atol=1e-6)
    np.testing.assert_allclose((both.geometric_height - both.height).numpy()[grass], 0.3, atol=1e-6)
    assert float((both.geometric_height - both.height).numpy()[firm].max()) == 0.0
    # Firm ground is of the material that the lidar's source was given, what gives way of the encoder's.
    soft = replace(seen, stiffness=of(1e5), damping=of(3e3), friction=of(0.3))
    slick = TerrainMap.from_height(of(measured), grid, material=TerrainDefaults(2e6, 4e4, 0.0))
    mixed = lowered(slick, soft)
    for name, given, learnt in (("stiffness", 2e6, 1e5), ("damping", 4e4, 3e3), ("friction", 0.0, 0.3)):
        values = getattr(mixed, name).numpy()
        np.testing.assert_allclose(values[firm], given)
        np.testing.assert_allclose(values[grass], learnt, rtol=1e-5)
    # A wall in the grass is more than the grass explains; so is ground that the encoder sees far below.
    inside = lowered(TerrainMap.from_height(of(np.where(grass, 1.2, 0.1)), grid), seen)
    assert float(inside.height.numpy()[grass].min()) > 0.6
    deep = lowered(swept, TerrainMap.from_height(of(-1.0), grid, geometric_height=of(-1.0 + decrease)))
    np.testing.assert_allclose(deep.height.numpy()[grass], 0.45 - 0.55, atol=1e-6)


def test_an_unknown_terrain_source_is_refused():
    with pytest.raises(ValueError, match="terrain source: got 'sonar', expected one of"):
        choose_terrain_source("sonar", load_robot("husky"))
