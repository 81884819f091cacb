"""A robot that a map shows inside an obstacle is not thrown out of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionState
from monoforce_ros.perception import FlatTerrain
from monoforce_ros.perception.clearance import with_clear_start
from monoforce_ros.physics import State
from monoforce_ros.prediction import Predictor, start_states
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

NAMES = ("husky", "jackal", "warthog", "tradr", "rally_car", "offroad_car")


def before_a_wall(robot, overlap, height, resolution=0.1, turn=0.0):
    """Level ground under the robot, and a wall that reaches ``overlap`` [m] into its front."""
    grid = Grid.square(12.8, resolution)
    x, y = np.meshgrid(grid.x, grid.y)
    along = x * np.cos(turn) + y * np.sin(turn)
    wall = along > float(robot.points[:, 0].max()) - overlap
    ground = -robot.ground_clearance
    return TerrainMap.from_height(torch.from_numpy(np.where(wall, ground + height, ground).astype(np.float32)), grid)


def still(heading=0.0):
    turned = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1.0]])
    return MotionState(0, np.zeros(3), turned, np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("resolution", [0.05, 0.1])
@pytest.mark.parametrize("height", [0.4, 2.0])
@pytest.mark.parametrize("overlap", [0.03, 0.1, 0.3])
@pytest.mark.parametrize("name", NAMES)
def test_no_robot_is_thrown_out_of_a_wall(name, overlap, height, resolution):
    robot = load_robot(name)
    predictor = Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()), horizon=2.0)
    terrain = before_a_wall(robot, overlap, height, resolution)
    for forward in (0.0, 0.5):
        twists = np.broadcast_to([forward, 0.0], (1, predictor.history + predictor.steps, 2))
        result = predictor.roll_out(terrain, [still()], twists, with_forces=False)
        position = result.position[0]
        speed, rise = float(result.velocity[0].norm(dim=-1).max()), float(position[:, 2].abs().max())
        assert bool(result.valid.all())
        if not forward:
            assert speed < 2.0 and rise < 0.2 and float(position[:, 0].abs().max()) < 0.15
        else:
            # What it stands in is a ramp now: it may climb that, no more.
            assert speed < 2.0 and rise < 0.4 and float(position[-1, 0]) < (0.9 if height < 1.0 else 0.35)


def test_only_what_reaches_into_the_robot_is_lowered():
    robot = load_robot("husky")
    state = State.at_rest(0.0)
    free = before_a_wall(robot, -0.25, 2.0)
    assert with_clear_start(free, robot, state) is free
    rough = TerrainMap.from_height(free.height + 0.05 * torch.rand(free.height.shape), free.grid)
    assert with_clear_start(rough, robot, state) is rough, "an error of the ground under the wheels is none of a wall"
    terrain = before_a_wall(robot, 0.2, 2.0)
    cleared = with_clear_start(terrain, robot, state)
    changed = cleared.height != terrain.height
    x, y = np.meshgrid(terrain.grid.x, terrain.grid.y)
    high = robot.bounds[1]
    reach = terrain.grid.resolution
    outside = (x > float(high[0]) + reach) | (np.abs(y) > float(high[1]) + reach)
    assert bool(changed.any()) and not bool(changed.numpy()[outside].any())
    torch.testing.assert_close(
        cleared.geometric_height - cleared.height, terrain.geometric_height - terrain.height, rtol=0, atol=1e-6
    )


def test_each_map_of_a_batch_is_cleared_for_its_own_robot():
    robot = load_robot("husky")
    walls = [before_a_wall(robot, overlap, 2.0, turn=turn) for overlap, turn in ((0.2, 0.0), (-0.5, 0.0))]
    state = State(torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3), torch.zeros(2, 3))
    cleared = with_clear_start(TerrainMap.stack(walls), robot, state)
    alone = with_clear_start(walls[0], robot, State.at_rest(0.0))
    assert torch.equal(cleared.height[0], alone.height) and torch.equal(cleared.height[1], walls[1].height)


def test_every_cell_under_a_tilted_robot_is_lowered_to_it_and_no_other():
    robot, grid = load_robot("husky"), Grid.square(6.4, 0.1)
    tilt = Rotation.from_euler("yx", [0.2, 0.1]).as_matrix()
    state = start_states([MotionState(0, np.zeros(3), tilt, np.zeros(3), np.zeros(3))])
    x, y = np.meshgrid(grid.x, grid.y)
    high = TerrainMap.from_height(torch.ones(grid.rows, grid.columns), grid)
    cleared = with_clear_start(high, robot, state).height.numpy()
    assert (cleared[(np.abs(x) < 0.4) & (np.abs(y) < 0.25)] < 0.2).all()
    assert (cleared[(np.abs(x) > 0.65) | (np.abs(y) > 0.5)] == 1.0).all()
    low = TerrainMap.from_height(torch.full((grid.rows, grid.columns), -0.5), grid)
    assert with_clear_start(low, robot, state) is low
    # Among rigid things, what was only interpolated beside the robot is lowered, too.
    nothing = torch.zeros_like(high.observed)
    unseen = with_clear_start(replace(high, observed=nothing), robot, state, rigid=True).height.numpy()
    assert (unseen <= cleared).all() and (unseen < 1.0).sum() > (cleared < 1.0).sum()
    assert (unseen[(np.abs(x) > 0.75) | (np.abs(y) > 0.6)] == 1.0).all()
