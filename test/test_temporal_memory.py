"""What a terrain source saw a moment ago fills what it does not see now, as long as that is to be trusted."""

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
UNSEEN = -0.2
"""What it guesses elsewhere: somewhat below the robot."""


def ground(x, y):
    """Height of the ground in the odometry frame: a slope, and a block at (2.5, 1)."""
    return 0.1 * x + 0.4 * ((np.abs(x - 2.5) < 0.35) & (np.abs(y - 1.0) < 0.35))


@dataclass
class Ahead:
    """A source that sees, exactly, what lies more than a metre ahead and within 45 degrees."""

    block: bool = True
    sensors: tuple[str, ...] = ()
    grid: Grid = field(default=GRID)

    def terrain(self, observation, motion):
        places = transform_points(motion.odometry_from_terrain, np.stack([X, Y, 0 * X], axis=-1).reshape(-1, 3))
        height = ground(places[:, 0], places[:, 1]) if self.block else 0.1 * places[:, 0]
        height = (height - motion.position[2]).reshape(X.shape)
        seen = (X > 1.0) & (np.abs(Y) < X)
        height = torch.from_numpy(np.where(seen, height, UNSEEN).astype(np.float32))
        return TerrainMap.from_height(height, GRID, observed=torch.from_numpy(seen))


def at(seconds, x, y=0.0, heading=0.0, speed=0.0):
    """A robot that stands on the slope."""
    slope = Rotation.from_euler("y", -np.arctan(0.1))
    rotation = (slope * Rotation.from_euler("z", heading)).as_matrix()
    place = np.array([x, y, ground(x, y) - WHEELS])
    return MotionState(round(seconds * 1e9), place, rotation, np.array([speed, 0.0, 0.0]), np.zeros(3))


def remembering(source=None, **settings):
    settings = {"seconds": 10.0} | settings
    return TemporalMemory(source or Ahead(), load_robot("husky"), stiffness=2e6, **settings)


def see(memory, motion):
    return memory.terrain(Observation(motion.stamp), motion)


def height_at(terrain, motion, x, y):
    """Of the map in the odometry frame, at a place there; None where nothing was seen."""
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


def test_what_was_seen_before_the_turn_is_still_there_at_its_height():
    terrain, motion = drive(memory := remembering())
    for place in ((2.5, 1.0), (2.5, 0.2), (3.0, 0.4), (2.4, 0.1)):
        assert height_at(terrain, motion, *place) == pytest.approx(ground(*place), abs=0.03)
    # Never seen, beside and behind: nobody claims to know.
    assert height_at(terrain, motion, 1.0, 2.0) is None
    assert memory.grid == GRID and memory.sensors == ()
    alone = Ahead().terrain(Observation(0), motion)
    assert height_at(alone, motion, 2.5, 1.0) is None, "without memory it is gone"


def test_what_is_remembered_for_long_does_not_melt():
    """The robot turns to and fro, ten images a second; the block has lost nothing of its height and edges."""
    drive(memory := remembering(seconds=60.0))
    for index in range(200):
        motion = at(7.0 + 0.1 * index, 1.5, heading=-1.5 - 0.3 * np.sin(0.2 * index))
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.03)
    assert height_at(terrain, motion, 2.5, 0.45) == pytest.approx(0.25, abs=0.06)


def test_it_goes_along_over_any_distance():
    memory = remembering()
    for index in range(120):
        motion = at(0.5 * index, 0.25 * index, speed=0.5)
        terrain = see(memory, motion)
    x = motion.position[0]
    for place in ((x + 2.0, 0.5), (x + 0.7, 0.3), (x - 1.0, 0.2)):
        assert height_at(terrain, motion, *place) == pytest.approx(ground(*place), abs=0.03)


def test_what_is_seen_now_replaces_what_was_seen_before():
    source = Ahead()
    memory = remembering(source)
    motion = at(0.0, 0.0)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.02)
    source.block = False  # it was a person, who has gone
    motion = at(0.5, 0.1, speed=0.2)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.25, abs=0.02)
    assert height_at(*drive(memory, 1.0), 2.5, 1.0) == pytest.approx(0.25, abs=0.02)


def test_what_stood_out_is_not_believed_to_be_gone_from_nearby():
    """An encoder that sees no more than a piece of a wall takes it for ground; the robot would drive into it."""
    source = Ahead()
    memory = remembering(source, seconds=3.0)
    motion = at(1.0, 1.0)
    assert height_at(see(memory, motion), motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.02)
    source.block = False
    for seconds in (1.5, 2.0, 2.5):
        terrain = see(memory, motion := at(seconds, 0.9 + 0.1 * seconds, speed=0.1))
        assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.65, abs=0.03)
        # What does not stand out is taken as it is seen now.
        assert height_at(terrain, motion, 2.4, -0.5) == pytest.approx(0.24, abs=0.02)
    # It is not seen again either, and forgotten after its time.
    terrain = see(memory, motion := at(4.5, 1.15))
    assert height_at(terrain, motion, 2.5, 1.0) == pytest.approx(0.25, abs=0.02)


def test_it_is_forgotten_after_its_time_and_after_a_way():
    memory = remembering(seconds=4.0)
    _, motion = drive(memory)
    for _ in range(7):
        motion = at(motion.stamp * 1e-9 + 0.5, 1.5, heading=-1.5)
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 1.0) is None
    memory = remembering(distance=1.2)
    terrain, motion = drive(memory)
    assert height_at(terrain, motion, 2.5, 0.2) is not None
    for index in range(1, 15):
        # To and fro on the spot where it stands: odometry has had its chances to drift.
        motion = at(motion.stamp * 1e-9 + 0.2, 1.5 + 0.1 * (index % 2), heading=-1.5)
        terrain = see(memory, motion)
    assert height_at(terrain, motion, 2.5, 0.2) is None


@pytest.mark.parametrize("elsewhere", [{"seconds": 6.5, "x": 1.5, "y": 3.0}, {"seconds": 1.0, "x": 1.5}])
def test_a_jump_of_odometry_or_of_time_ends_it(elsewhere):
    memory = remembering()
    drive(memory)
    motion = at(**elsewhere, heading=-1.5)
    terrain = see(memory, motion)
    assert terrain.observed.sum() == Ahead().terrain(Observation(0), motion).observed.sum()


def test_it_stays_clear_of_the_robot_that_drives_where_it_saw_something():
    """An encoder that took grass for a wall, or odometry that slipped: no map may throw the robot."""
    memory = remembering()
    for index in range(13):
        motion = at(0.5 * index, 0.2 * index, y=0.8, speed=0.4)
        terrain = see(memory, motion)
    rows, columns, _ = GRID.cells(np.array([[0.0, 0.0], [0.3, 0.2]]))
    assert (terrain.height[rows, columns] < 0.05).all()


def test_another_calibration_ends_it():
    memory = remembering()
    drive(memory)
    wide = CameraModel(100, 80, np.array([[50.0, 0, 50], [0, 50, 40], [0, 0, 1]]), np.zeros(5))
    long = replace(wide, matrix=wide.matrix * np.array([[3, 1, 1], [1, 3, 1], [1, 1, 1]]))
    alone = Ahead().terrain(Observation(0), at(6.5, 1.5, heading=-1.5)).observed.sum()
    for index, (camera, remembers) in enumerate(((wide, True), (replace(wide), True), (long, False))):
        motion = at(6.5 + 0.1 * index, 1.5, heading=-1.5)
        terrain = memory.terrain(Observation(motion.stamp, cameras={"front": camera}), motion)
        assert (terrain.observed.sum() > alone) == remembers


def test_a_memory_of_no_length_is_refused():
    with pytest.raises(ValueError, match="memory: got 0"):
        remembering(seconds=0.0)
