"""From measured motion to the state that a prediction starts from."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from conftest import ROOT
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.perception import SOURCES, FlatTerrain, Observation, choose_terrain_source
from monoforce_ros.perception.clearance import clear_of_robot, with_clear_start
from monoforce_ros.perception.encoder_terrain import encoder_threads
from monoforce_ros.perception.fusion import apply_compliance
from monoforce_ros.perception.ground_alignment import align_to_ground
from monoforce_ros.physics import State, rollout
from monoforce_ros.planning.costs import Limits, assess, force_every
from monoforce_ros.prediction import Predictor, start_states
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap


def test_the_start_state_has_the_attitude_and_velocities_of_the_robot():
    rotation = Rotation.from_euler("xyz", [0.1, -0.2, 2.0])
    velocity, rate = np.array([0.8, 0.1, 0.0]), np.array([0, 0, 0.4])
    motion = MotionState(0, np.array([5.0, 6.0, 7.0]), rotation.as_matrix(), velocity, rate)
    state = start_states([motion], torch.float64)
    level = Rotation.from_euler("z", -motion.heading)
    np.testing.assert_allclose(state.position[0], 0.0)
    np.testing.assert_allclose(state.rotation[0], (level * rotation).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(state.velocity[0], (level * rotation).apply([0.8, 0.1, 0.0]), atol=1e-12)
    np.testing.assert_allclose(state.angular_velocity[0], (level * rotation).apply([0, 0, 0.4]), atol=1e-12)


def test_the_motion_of_a_moving_robot_is_predicted_in_the_odometry_frame():
    robot = load_robot("husky")
    predictor = Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()), horizon=1.0)
    west = Rotation.from_euler("z", np.pi).as_matrix()
    motion = MotionState(0, np.array([3.0, -1.0, 0.4]), west, np.array([0.6, 0, 0]), np.zeros(3))
    twists = np.tile([0.6, 0.0], (len(predictor.command_stamps(0)), 1))
    positions = predictor.predict(Observation(0), motion, twists).positions()
    np.testing.assert_allclose(positions[0], [3.0, -1.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(positions[-1], [2.4, -1.0, 0.4], atol=0.02)


def test_ground_exerts_no_force_before_contact():
    robot = load_robot("husky")
    above = State.at_rest(robot.ground_clearance + 0.1)
    result = rollout(TerrainMap.flat(Grid.square(4.0)), robot, torch.zeros(1, 20, 2), above)
    lowest = result.position[0, :-1, 2] - robot.ground_clearance
    assert float(result.forces[0, lowest > 1e-4].abs().max()) == 0.0
    assert float(result.forces[0, lowest < -1e-3].abs().max()) > 0.0


def sweep(wall, beyond=8.0):
    """Lidar returns of level ground outside a ring around the robot, and of a wall across at x = ``wall``."""
    random = np.random.default_rng(0)
    radius, angle = random.uniform(1.4, beyond, 12000), random.uniform(-np.pi, np.pi, 12000)
    ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(12000, -0.131)], axis=1)
    ground = ground[ground[:, 0] < wall]
    front = np.stack([np.full(4000, wall), random.uniform(-1.5, 1.5, 4000), random.uniform(-0.1, 0.8, 4000)], axis=1)
    return np.concatenate([ground, front])


def test_a_wall_just_ahead_does_not_reach_into_the_robot():
    """A lidar sees no ground near the robot; heights interpolated from the wall would push the robot away."""
    robot = load_robot("husky")
    still = MotionState(0, np.zeros(3), Rotation.from_euler("z", 0.7).as_matrix(), np.zeros(3), np.zeros(3))
    predictor = Predictor(robot, choose_terrain_source("lidar_interpolation", robot), horizon=1.0)
    seen = predictor.source.terrain(Observation(0, sweep(0.62)), still)
    terrain = clear_of_robot(seen, robot, still)
    twists = np.zeros((1, len(predictor.command_stamps(0)), 2))

    def pushed(terrain, twists):
        places = predictor.roll_out(terrain, [still], twists).position[0].numpy()
        return np.linalg.norm(places - places[0], axis=1)

    assert pushed(seen, twists).max() < 0.06, "the start is cleared in any case"
    assert pushed(terrain, twists).max() < 0.03
    assert terrain.height.max() > 0.5, "the wall itself stays"
    # Driving forward, the robot is stopped by the wall.
    assert pushed(terrain, twists + np.array([0.5, 0.0]))[-1] < 0.25


@pytest.mark.parametrize("heading", [0.0, 0.3, 0.7, 1.2])
@pytest.mark.parametrize("wall", [0.5, 0.6, 0.7, 0.8, 0.9])
def test_beside_a_wall_the_robot_stands_and_may_drive_away(wall, heading):
    """The wall hides the ground before it: interpolated, its height would begin below the robot."""
    robot = load_robot("husky")
    turn = Rotation.from_euler("z", heading).as_matrix()
    still = MotionState(0, np.zeros(3), turn, np.zeros(3), np.zeros(3))
    predictor = Predictor(robot, choose_terrain_source("lidar_interpolation", robot), horizon=3.0)
    terrain = predictor.source.terrain(Observation(0, (sweep(wall) @ turn).astype(np.float32)), still)
    twists = np.zeros((2, len(predictor.command_stamps(0)), 2))
    twists[1, :, 0] = -0.4
    rolled = predictor.roll_out(
        terrain, [still] * 2, twists, with_contact=True, with_forces=False, force_every=force_every(0.01)
    )
    commanded = torch.as_tensor(twists[:, predictor.history :], dtype=torch.float32)
    judged = assess(rolled, terrain, robot, commanded)
    # Behind it the lidar of this test sees no ground within 1.4 m; and it does stand close to the wall.
    pressed = {name: float(values.max()) for name, values in judged.terms.items()}
    assert max(value for name, value in pressed.items() if name not in {"unobserved", "obstacle_clearance"}) < 1.0, (
        pressed
    )
    assert assess(rolled, terrain, robot, commanded, limits=Limits(unobserved=10.0)).feasible.all()
    assert float(rolled.position[0].norm(dim=-1).max()) < 0.02
    assert terrain.height.max() > 0.5, "the wall itself stays"


def test_before_low_things_heights_are_interpolated():
    """Grass, too, is seen from above only: a robot in it must not stand between walls."""
    robot = load_robot("husky")
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    source = choose_terrain_source("lidar_interpolation", robot)
    grass = sweep(9.0)
    grass[:, 2] += 0.35
    terrain = source.terrain(Observation(0, grass.astype(np.float32)), still)
    row, column, _ = terrain.grid.cells(np.array([[1.0, 0.0]]))
    assert -0.05 < float(terrain.height[row[0], column[0]]) < 0.25, "between the ground that carries it and the grass"


def test_the_map_of_a_prediction_is_the_one_that_it_was_made_on():
    robot = load_robot("husky")
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    grid = Grid.square()
    inside = np.meshgrid(grid.x, grid.y)[0] > 0.35
    seen = TerrainMap.from_height(torch.from_numpy(np.where(inside, 0.8, -0.131).astype(np.float32)), grid)
    source = SimpleNamespace(sensors=(), grid=grid, terrain=lambda observation, motion: seen)
    predictor = Predictor(robot, source, horizon=1.0)
    made = predictor.predict(Observation(0), still, np.zeros((len(predictor.command_stamps(0)), 2)))
    assert not torch.equal(made.terrain.height, seen.height)
    assert torch.equal(made.terrain.height, with_clear_start(seen, robot, start_states([still])).height)


def test_a_predicted_map_meets_the_wheels_and_is_unchanged_elsewhere():
    grid = Grid.square(6.4, 0.1)
    x, _ = np.meshgrid(grid.x, grid.y)
    terrain = TerrainMap.from_height(torch.from_numpy((0.3 + 0.1 * x).astype(np.float32)), grid)
    wheels = np.array([[0.3, 0.3, -0.05], [0.3, -0.3, -0.05], [-0.3, 0.3, -0.1], [-0.3, -0.3, -0.1]])
    aligned = align_to_ground(terrain, wheels)
    rows, columns, _ = grid.cells(wheels[:, :2])
    np.testing.assert_allclose(aligned.height.numpy()[rows, columns], wheels[:, 2], atol=0.02)
    far = np.hypot(x, x.T) > 1.2
    np.testing.assert_array_equal(aligned.height.numpy()[far], terrain.height.numpy()[far])
    # The height of vegetation above the ground, on which its resistance depends, stays.
    torch.testing.assert_close(aligned.geometric_height - aligned.height, terrain.geometric_height - terrain.height)
    # There is no step at the border of the shifted area.
    assert float(np.abs(np.diff(aligned.height.numpy(), axis=1)).max()) < 0.15
    assert align_to_ground(terrain, wheels + np.array([50.0, 0.0, 0.0])) is terrain


def test_lidar_surfaces_are_lowered_by_compliance_and_walls_stay():
    grid = Grid.square(6.4, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    grass, wall = (x > 1) & (x < 2), (x > 2.5) & (y > 0)
    measured = np.where(wall, 1.5, np.where(grass, 0.45, 0.1))

    def of(values):
        return torch.from_numpy(np.asarray(values, np.float32) + np.zeros_like(x, dtype=np.float32))

    lidar = TerrainMap.from_height(of(measured), grid)
    # The encoder misses the wall, has an error of 4 cm on the ground, and predicts slight compliance of rigid ground.
    decrease = np.where(grass, 0.3, 0.015)
    camera = TerrainMap.from_height(of(0.06), grid, geometric_height=of(0.06 + decrease))
    both = apply_compliance(lidar, camera)
    height = both.height.numpy()
    np.testing.assert_allclose(height[grass], 0.06, atol=1e-6)
    np.testing.assert_allclose(height[wall], 1.5, atol=1e-6)
    firm = ~grass & ~wall
    np.testing.assert_allclose(height[firm], 0.1, atol=1e-6)
    np.testing.assert_allclose((both.geometric_height - both.height).numpy()[grass], 0.3, atol=1e-6)
    assert float((both.geometric_height - both.height).numpy()[firm].max()) == 0.0
    # Rigid ground has the configured material of the lidar's map, compliant ground that of the encoder.
    soft = replace(camera, stiffness=of(1e5), damping=of(3e3), friction=of(0.3))
    slick = TerrainMap.from_height(of(measured), grid, material=TerrainDefaults(2e6, 4e4, 0.0))
    mixed = apply_compliance(slick, soft)
    for name, configured, predicted in (("stiffness", 2e6, 1e5), ("damping", 4e4, 3e3), ("friction", 0.0, 0.3)):
        values = getattr(mixed, name).numpy()
        np.testing.assert_allclose(values[firm], configured)
        np.testing.assert_allclose(values[grass], predicted, rtol=1e-5)
    # A wall in the grass exceeds the predicted compliance; so does a surface far above the predicted one.
    inside = apply_compliance(TerrainMap.from_height(of(np.where(grass, 1.2, 0.1)), grid), camera)
    assert float(inside.height.numpy()[grass].min()) > 0.6
    deep = apply_compliance(lidar, TerrainMap.from_height(of(-1.0), grid, geometric_height=of(-1.0 + decrease)))
    np.testing.assert_allclose(deep.height.numpy()[grass], 0.45 - 0.55, atol=1e-6)


def test_an_unknown_terrain_source_is_refused():
    with pytest.raises(ValueError, match="terrain source: got 'sonar', expected one of"):
        choose_terrain_source("sonar", load_robot("husky"))


def test_the_encoder_has_its_own_number_of_threads_and_the_previous_one_is_restored():
    before = torch.get_num_threads()
    with encoder_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
    with pytest.raises(ValueError, match="no image"), encoder_threads(before + 1):
        raise ValueError("no image")
    assert torch.get_num_threads() == before
    with encoder_threads(None):
        assert torch.get_num_threads() == before


def test_terrain_sources_are_those_that_the_node_offers():
    schema = yaml.safe_load((ROOT / "config" / "predictor.schema.yaml").read_text())
    assert sorted(schema["terrain_source"]["choices"]) == sorted(SOURCES)
