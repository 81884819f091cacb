"""Earlier observations of a terrain source fill cells that it does not observe now, while they can be trusted."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CameraModel, MotionState, transform_points
from monoforce_ros.perception import Observation
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

GRID = Grid.square(6.4, 0.1)
X, Y = np.meshgrid(GRID.x, GRID.y)
WHEELS = -0.131
UNOBSERVED = -0.2
"""Height in cells without an observation, somewhat below the robot."""


def ground(x, y):
    """Height of the ground in the odometry frame: a slope, and a block at (2.5, 1)."""
    return 0.1 * x + 0.4 * ((np.abs(x - 2.5) < 0.35) & (np.abs(y - 1.0) < 0.35))


@dataclass
class Ahead:
    """A source that observes, without error, cells more than a metre ahead and within 45 degrees."""

    block: bool = True
    sensors: tuple[str, ...] = ()
    grid: Grid = field(default=GRID)

    def terrain(self, observation, motion):
        places = transform_points(motion.odometry_from_terrain, np.stack([X, Y, 0 * X], axis=-1).reshape(-1, 3))
        height = ground(places[:, 0], places[:, 1]) if self.block else 0.1 * places[:, 0]
        height = (height - motion.position[2]).reshape(X.shape)
        seen = (X > 1.0) & (np.abs(Y) < X)
        height = torch.from_numpy(np.where(seen, height, UNOBSERVED).astype(np.float32))
        return TerrainMap.from_height(height, GRID, observed=torch.from_numpy(seen))


def at(seconds, x, y=0.0, heading=0.0, speed=0.0):
    """A robot on the slope."""
    slope = Rotation.from_euler("y", -np.arctan(0.1))
    rotation = (slope * Rotation.from_euler("z", heading)).as_matrix()
    place = np.array([x, y, ground(x, y) - WHEELS])
    return MotionState(round(seconds * 1e9), place, rotation, np.array([speed, 0.0, 0.0]), np.zeros(3))


def remembering(source=None, **settings):
    settings = {"retention_time": 10.0} | settings
    return TemporalMemory(source or Ahead(), load_robot("husky"), stiffness=2e6, **settings)


def see(memory, motion):
    return memory.terrain(Observation(motion.stamp), motion)


def height_at(terrain, motion, x, y):
    """Height of the map at a position in the odometry frame; None in an unobserved cell."""
    local = transform_points(np.linalg.inv(motion.odometry_from_terrain), np.array([[x, y, 0.0]]))
    rows, columns, inside = terrain.grid.cells(local[:, :2])
    assert inside.all()
    if not bool(terrain.observed[rows[0], columns[0]]):
        return None
    return float(terrain.height[rows[0], columns[0]]) + motion.position[2]


def drive(memory, seconds=0.0):
    """From the origin to x = 1.5, then a turn to the right; the block stays behind to the left."""
    for index in range(7):
        see(memory, motion := at(seconds + 0.5 * index, 0.25 * index, speed=0.5))
    for index in range(1, 7):
        terrain = see(memory, motion := at(seconds + 3.0 + 0.5 * index, 1.5, heading=-0.25 * index))
    return terrain, motion


def test_observations_from_before_a_turn_are_kept_with_their_height():
    terrain, motion = drive(memory := remembering())
    for place in ((2.5, 1.0), (2.5, 0.2), (3.0, 0.4), (2.4, 0.1)):
        assert height_at(terrain, motion, *place) == pytest.approx(ground(*place), abs=0.03)
    # Cells to the side and behind were never observed.
    assert height_at(terrain, motion, 1.0, 2.0) is None
    assert memory.grid == GRID and memory.sensors == ()
    alone = Ahead().terrain(Observation(0), motion)
    assert height_at(alone, motion, 2.5, 1.0) is None, "without memory it is gone"


def test_kept_observations_are_not_smoothed_away():
    """The robot turns back and forth at ten images a second; the block keeps its height and edges."""
    drive(memory := remembering(retention_time=60.0))
    for index in range(200):
        motion = at(7.0 + 0.1 * index, 1.5, heading=-1.5 - 0.3 * np.sin(0.2 * index))
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.03)
    assert height_at(terrain, motion, 2.5, 0.45) == pytest.approx(0.25, abs=0.06)


def test_the_memory_moves_with_the_robot_over_any_distance():
    memory = remembering()
    for index in range(120):
        motion = at(0.5 * index, 0.25 * index, speed=0.5)
        terrain = see(memory, motion)
    x = motion.position[0]
    for place in ((x + 2.0, 0.5), (x + 0.7, 0.3), (x - 1.0, 0.2)):
        assert height_at(terrain, motion, *place) == pytest.approx(ground(*place), abs=0.03)


def test_new_observations_replace_earlier_ones():
    source = Ahead()
    memory = remembering(source)
    motion = at(0.0, 0.0)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.02)
    source.block = False  # it was a person, who has gone
    motion = at(0.5, 0.1, speed=0.2)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.25, abs=0.02)
    assert height_at(*drive(memory, 1.0), 2.5, 1.0) == pytest.approx(0.25, abs=0.02)


def test_an_obstacle_nearby_is_kept_although_it_seems_to_disappear():
    """An encoder that sees only a part of a wall takes it for ground; the robot would drive into it."""
    source = Ahead()
    memory = remembering(source, retention_time=3.0)
    motion = at(1.0, 1.0)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.02)
    source.block = False
    for seconds in (1.5, 2.0, 2.5):
        terrain = see(memory, motion := at(seconds, 0.9 + 0.1 * seconds, speed=0.1))
        assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.03)
        # Cells without an obstacle take the new observation.
        assert height_at(terrain, motion, 2.4, -0.5) == pytest.approx(0.24, abs=0.02)
    # Without a new observation it is forgotten after the retention time.
    terrain = see(memory, motion := at(4.5, 1.15))
    assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.25, abs=0.02)


def test_cells_are_forgotten_after_the_retention_time_and_distance():
    memory = remembering(retention_time=4.0)
    _, motion = drive(memory)
    for _ in range(7):
        motion = at(motion.stamp * 1e-9 + 0.5, 1.5, heading=-1.5)
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 1.0) is None
    memory = remembering(retention_distance=1.2)
    terrain, motion = drive(memory)
    assert height_at(terrain, motion, 2.5, 0.2) is not None
    for index in range(1, 15):
        # Moving back and forth over a few centimetres also lets odometry drift.
        motion = at(motion.stamp * 1e-9 + 0.2, 1.5 + 0.1 * (index % 2), heading=-1.5)
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 0.2) is None


@pytest.mark.parametrize("elsewhere", [{"seconds": 6.5, "x": 1.5, "y": 3.0}, {"seconds": 1.0, "x": 1.5}])
def test_a_jump_of_odometry_or_of_time_clears_the_memory(elsewhere):
    memory = remembering()
    drive(memory)
    motion = at(**elsewhere, heading=-1.5)
    terrain = see(memory, motion)
    assert terrain.observed.sum() == Ahead().terrain(Observation(0), motion).observed.sum()


def test_the_footprint_of_the_robot_stays_clear_where_an_obstacle_was_observed():
    """Grass taken for a wall, or odometry errors, must not put a surface inside the robot."""
    memory = remembering()
    for index in range(13):
        motion = at(0.5 * index, 0.2 * index, y=0.8, speed=0.4)
        terrain = see(memory, motion)
    rows, columns, _ = GRID.cells(np.array([[0.0, 0.0], [0.3, 0.2]]))
    assert (terrain.height[rows, columns] < 0.05).all()


def test_another_calibration_clears_the_memory():
    memory = remembering()
    drive(memory)
    wide = CameraModel(100, 80, np.array([[50.0, 0, 50], [0, 50, 40], [0, 0, 1]]), np.zeros(5))
    long = replace(wide, matrix=wide.matrix * np.array([[3, 1, 1], [1, 3, 1], [1, 1, 1]]))
    alone = Ahead().terrain(Observation(0), at(6.5, 1.5, heading=-1.5)).observed.sum()
    for index, (camera, remembers) in enumerate(((wide, True), (replace(wide), True), (long, False))):
        motion = at(6.5 + 0.1 * index, 1.5, heading=-1.5)
        terrain = memory.terrain(Observation(motion.stamp, cameras={"front": camera}), motion)
        assert (terrain.observed.sum() > alone) == remembers


def test_a_retention_time_of_zero_is_refused():
    with pytest.raises(ValueError, match="temporal memory: got a retention time of 0"):
        remembering(retention_time=0.0)
