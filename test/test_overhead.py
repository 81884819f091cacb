"""What a robot passes under: ceilings, bars and crowns are no ground, and what is too low for it is an obstacle."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from monoforce_ros.core import CameraModel, MotionState
from monoforce_ros.perception import Observation, choose_terrain_source
from monoforce_ros.perception.lidar import usable_returns
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap, without_overhead

GRID = Grid.square(12.8, 0.1)
LIMITS = {"lowest": -4.0, "highest": 3.0}
LIDARS = {"Mid-360": np.linspace(-7, 52, 40), "VLP-16": np.linspace(-15, 15, 16), "OS0": np.linspace(-45, 45, 48)}
STILL = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))


def room(elevations, ground, ceiling, mount=0.6, columns=360):
    """Returns of an empty room of 20 m with a level floor."""
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    turn, rise = (angles.ravel() for angles in np.meshgrid(azimuth, np.radians(elevations)))
    rays = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=-1)
    with np.errstate(divide="ignore"):
        walls = 10.0 / np.abs(rays[:, :2]).max(axis=1)
        floor, above = -mount / rays[:, 2], (ceiling - mount) / rays[:, 2]
    reach = np.min([walls, np.where(floor > 0, floor, np.inf), np.where(above > 0, above, np.inf)], axis=0)
    return rays * reach[:, None] + [0.0, 0.0, ground + mount]


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.mark.parametrize("kind", ["lidar", "lidar_interpolation"])
@pytest.mark.parametrize("lidar", LIDARS)
@pytest.mark.parametrize("ceiling", [2.3, 3.0])
def test_an_empty_room_is_level_under_its_ceiling(husky, kind, lidar, ceiling):
    ground = -husky.ground_clearance
    cloud = room(LIDARS[lidar], ground, ceiling).astype(np.float32)
    terrain = choose_terrain_source(kind, husky, fallback=True).terrain(Observation(0, cloud=cloud), STILL)
    height = terrain.height.numpy() - ground
    assert np.abs(height).max() < 0.1


def test_hillsides_and_banks_are_ground(husky):
    support = np.array([[0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0]])
    xy = np.random.default_rng(0).uniform(-6.4, 6.4, (40_000, 2))
    # A slope of 30°, and a bank of 60° whose top is 2.5 m higher.
    for height in (0.577 * xy[:, 0], np.clip(1.732 * (xy[:, 0] - 2.0), 0.0, 2.5)):
        points = np.column_stack([xy, height])
        inside = points[(points[:, 2] > -4.0) & (points[:, 2] < 3.0)]
        assert len(without_overhead(inside, GRID, support, 0.9, **LIMITS)) == len(inside)


def test_ground_behind_a_gap_is_found_before_the_ceiling_over_it(husky):
    support = np.array([[0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0]])
    xy = np.random.default_rng(0).uniform(-6.4, 6.4, (20_000, 2))
    away = np.hypot(*xy.T)
    floor = np.column_stack([xy, 0.0 * away])[away > 4.5]
    ceiling = np.column_stack([xy, 0.0 * away + 2.4])[away > 1.5]
    kept = without_overhead(np.concatenate([floor, ceiling]), GRID, support, 0.9, **LIMITS)
    assert len(kept) == len(floor) and kept[:, 2].max() == 0.0


def test_without_a_support_on_the_map_nothing_is_left_out():
    points = np.array([[1.0, 0.0, 2.5], [2.0, 0.0, 0.0]])
    assert len(without_overhead(points, GRID, np.zeros((0, 3)), 0.9, **LIMITS)) == 2
    assert len(without_overhead(points, GRID, np.array([[50.0, 0.0, 0.0]]), 0.9, **LIMITS)) == 2


@pytest.mark.parametrize("kind", ["lidar", "lidar_interpolation"])
def test_a_bar_is_an_obstacle_to_a_robot_that_is_taller(husky, kind):
    car = load_robot("offroad_car")
    assert 0.9 <= husky.headroom < 1.2 < 1.8 < car.headroom
    random = np.random.default_rng(0)
    heights = {}
    for robot in (husky, car):
        ground = -robot.ground_clearance
        floor = np.column_stack([random.uniform(-6.4, 6.4, (60_000, 2)), np.full(60_000, ground)])
        bar = np.column_stack([
            random.uniform(3.0, 3.1, 3000), random.uniform(-2.0, 2.0, 3000), ground + random.uniform(1.3, 1.4, 3000),
        ])  # fmt: skip
        cloud = np.concatenate([floor, bar]).astype(np.float32)
        terrain = choose_terrain_source(kind, robot, fallback=True).terrain(Observation(0, cloud=cloud), STILL)
        under = (np.abs(GRID.x - 3.05) < 0.06)[None, :] & (np.abs(GRID.y) < 1.5)[:, None]
        heights[robot.name] = float(np.median(terrain.height.numpy()[under])) - ground
    assert heights["husky"] < 0.1 and heights["offroad_car"] > 0.8


def test_obstacles_close_to_the_bumper_are_no_part_of_the_robot(husky):
    front = float(husky.bounds[1][0])
    support = np.array([[0.3, 0.3, -0.13], [-0.3, 0.3, -0.13], [-0.3, -0.3, -0.13]])
    near, on = np.array([[front + 0.07, 0.0, 0.2]]), np.array([[front + 0.02, 0.0, 0.2]])
    assert len(usable_returns(near, husky, STILL, support, GRID)) == 1
    assert not len(usable_returns(on, husky, STILL, support, GRID))


def wall_in_the_blind_zone(husky, distance, height, width=4.0, mount=0.7):
    """Returns of a VLP-16, whose lowest ring meets the ground 2.6 m away, of level ground and a wall across the way."""
    cloud = room(LIDARS["VLP-16"], -husky.ground_clearance, 50.0, mount, columns=1440)
    origin = np.array([0.0, 0.0, -husky.ground_clearance + mount])
    rays = cloud - origin
    share = np.where(rays[:, 0] > 0, distance / np.maximum(rays[:, 0], 1e-9), np.inf)
    hit = origin + rays * share[:, None]
    blocked = (share < 1.0) & (np.abs(hit[:, 1]) < 0.5 * width) & (hit[:, 2] < -husky.ground_clearance + height)
    return np.where(blocked[:, None], hit, cloud)


@pytest.mark.parametrize("distance", [1.5, 2.1, 2.6, 3.4])
def test_a_wall_whose_foot_the_lidar_does_not_see_is_no_ramp(husky, distance):
    cloud = wall_in_the_blind_zone(husky, distance, 1.5).astype(np.float32)
    source = choose_terrain_source("lidar_interpolation", husky)
    height = source.terrain(Observation(0, cloud=cloud), STILL).height.numpy() + husky.ground_clearance
    row = height[np.abs(GRID.y) < 1.0]
    before = row[:, (GRID.x > 0.6) & (GRID.x < distance - 0.15)]
    at = row[:, np.abs(GRID.x - distance) < 0.15].max(axis=1)
    # The lowest ring meets a wall at 1.5 m 0.3 m above its foot.
    assert before.max() < 0.3 and np.median(at) > 0.6


CAMERA = CameraModel(320, 240, np.array([[200.0, 0, 160], [0, 200.0, 120], [0, 0, 1]]), np.zeros(5))
FORWARD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])


def grey(stamp, cloud):
    """A sweep, or none, and a picture that says nothing."""
    picture = np.full((240, 320, 3), 90, np.uint8)
    return Observation(stamp, cloud, {"front": picture}, {"front": CAMERA}, {"front": FORWARD})


@pytest.mark.parametrize("kind", ["lidar", "lidar_interpolation", "lidar_camera"])
def test_what_the_lidar_looks_over_when_near_is_remembered(husky, kind):
    """Also where a camera sees the place, of which its image tells nothing."""
    ground = -husky.ground_clearance

    def heights(retention):
        source = choose_terrain_source(kind, husky, fallback=True, lidar_retention_time=retention)
        for step in range(16):
            x = 0.2 * step
            cloud = wall_in_the_blind_zone(husky, 4.0 - x, 0.3, width=0.8).astype(np.float32)
            motion = replace(STILL, stamp=step * 400_000_000, position=np.array([x, 0.0, 0.0]),
                             linear_velocity=np.array([0.5, 0.0, 0.0]))  # fmt: skip
            terrain = source.terrain(grey(motion.stamp, cloud), motion)
        near = (np.abs(GRID.x - 1.05) < 0.3)[None, :] & (np.abs(GRID.y) < 0.4)[:, None]
        return float(terrain.height.numpy()[near].max()) - ground

    assert heights(0.0) < 0.1 < heights(10.0)


def ray_cast(elevations, ground, mount, boxes, columns=1024):
    """Returns of level ground and of boxes, each (x, y, z from, x, y, z to) [m], z above the ground; 1 cm noise."""
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    turn, rise = (angles.ravel() for angles in np.meshgrid(azimuth, np.radians(elevations)))
    rays = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=-1)
    origin = np.array([0.0, 0.0, mount])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(rays[:, 2] < 0, -mount / rays[:, 2], np.inf)
        for low, high in boxes:
            to_low, to_high = ((np.array(corner) - origin) / rays for corner in (low, high))
            enters, leaves = np.minimum(to_low, to_high).max(axis=1), np.maximum(to_low, to_high).min(axis=1)
            reach = np.where((enters < leaves) & (enters > 0), np.minimum(reach, enters), reach)
    kept = reach < 30.0
    reach = reach + 0.01 * np.random.default_rng(0).standard_normal(len(reach))
    return ((rays * reach[:, None])[kept] + [0.0, 0.0, ground + mount]).astype(np.float32)


@pytest.mark.parametrize(
    ("low", "high", "least"),
    [((2.1, -2.1, 0.2), (3.9, 2.1, 1.45), 1.0), ((2.45, -3.0, 0.35), (2.6, 3.0, 0.75), 0.45)],
    ids=["car", "rail"],
)
def test_what_stands_there_with_a_gap_below_is_not_lowered_to_the_floor_seen_through_it(husky, low, high, least):
    ground = -husky.ground_clearance
    cloud = ray_cast(LIDARS["OS0"], ground, 0.75, [(low, high)])
    terrain = choose_terrain_source("lidar", husky, fallback=True).terrain(Observation(0, cloud=cloud), STILL)
    height = terrain.height.numpy() - ground
    front = (GRID.x > low[0] - 0.06) & (GRID.x < low[0] + 0.45)
    assert np.median(height[np.abs(GRID.y) < 1.5][:, front].max(axis=1)) > least
    assert height.min() > -0.4


@pytest.mark.parametrize("lidar", ["OS0", "VLP-16"])
def test_behind_the_edge_of_a_step_the_plateau_goes_on(husky, lidar):
    ground = -husky.ground_clearance
    cloud = ray_cast(LIDARS[lidar], ground, 0.75, [((2.0, -8.0, 0.0), (9.0, 8.0, 0.4))])
    source = choose_terrain_source("lidar_interpolation", husky)
    height = source.terrain(Observation(0, cloud=cloud), STILL).height.numpy() - ground
    row = height[np.abs(GRID.y) < 1.0]
    before, behind = row[:, (GRID.x > 0.8) & (GRID.x < 1.8)], row[:, (GRID.x > 2.1) & (GRID.x < 3.0)]
    # Three rings of the VLP-16 hit the face within 15 cm, which may be a ramp.
    assert np.median(before) < {"OS0": 0.1, "VLP-16": 0.3}[lidar] and np.median(behind) > 0.25


@pytest.mark.parametrize("camera_retention_time", [0.0, 10.0])
@pytest.mark.parametrize("covered", [False, True], ids=["silent", "covered"])
@pytest.mark.parametrize("fallback", [True, False])
def test_a_wall_stays_for_a_while_when_the_lidar_dies(husky, fallback, covered, camera_retention_time):
    ground = -husky.ground_clearance
    source = choose_terrain_source(
        "lidar_camera", husky, fallback=fallback, lidar_retention_time=10.0, retention_time=camera_retention_time
    )
    cloud = ray_cast(LIDARS["VLP-16"], ground, 0.65, [((3.0, -2.0, 0.0), (3.4, 2.0, 1.0))], columns=720)
    front, across = np.abs(GRID.x - 3.0) < 0.25, np.abs(GRID.y) < 1.5

    def wall(seconds, sweep):
        motion = replace(STILL, stamp=round(seconds * 1e9))
        height = source.terrain(grey(motion.stamp, sweep), motion).height.numpy() - ground
        return float(np.median(height[across][:, front].max(axis=1)))

    for step in range(5):
        assert wall(0.3 * step, cloud) > 0.7
    dead = cloud[:5] if covered else None
    assert all(wall(seconds, dead) > 0.7 for seconds in (1.5, 4.0, 7.0, 10.5))
    assert wall(12.0, dead) < 0.1
    # It is back, and somebody has taken the wall away.
    assert wall(12.3, ray_cast(LIDARS["VLP-16"], ground, 0.65, [], columns=720)) < 0.1


@dataclass
class Walled:
    """A source of both sensors whose images show a wall 3 m ahead, until they show none."""

    wall: bool = True
    sensors: tuple[str, ...] = ("lidar", "camera")
    grid: Grid = field(default=GRID)

    def terrain(self, observation, motion):
        height = torch.full((GRID.rows, GRID.columns), float(observation.cloud[:, 2].min()))
        height[:, np.abs(GRID.x - 3.0) < 0.3] += 1.0 if self.wall else 0.0
        return TerrainMap.from_height(height, GRID)


def test_only_what_the_lidar_measured_is_kept_when_it_dies(husky):
    """What images said then would outlive its time, although nothing confirmed it."""
    source = Walled()
    memory = TemporalMemory(source, husky, stiffness=2e6, retention_time=10.0, blind_zone_only=True)
    ground = -husky.ground_clearance
    behind = ray_cast(LIDARS["VLP-16"], ground, 0.65, [], columns=720)
    behind = behind[behind[:, 0] < 0.0]
    for step in range(5):
        motion = replace(STILL, stamp=round(0.3e9 * step))
        memory.recalled(source.terrain(grey(motion.stamp, behind), motion), grey(motion.stamp, behind), motion)
    source.wall = False
    now = source.terrain(grey(motion.stamp, behind), motion)
    later = replace(STILL, stamp=2_000_000_000)
    found = memory.recalled(now, grey(later.stamp, None), later, swept=False)
    assert float(found.height[:, np.abs(GRID.x - 3.0) < 0.3].max()) - ground < 0.1


@pytest.mark.parametrize("kind", ["lidar", "lidar_interpolation"])
def test_who_walked_by_is_forgotten_when_the_lidar_looks_over_the_place(husky, kind):
    ground = -husky.ground_clearance
    source = choose_terrain_source(kind, husky, fallback=True, lidar_retention_time=10.0)
    for step in range(15):
        y = -2.4 + 0.4 * step
        person = [((1.4, y - 0.2, 0.0), (1.8, y + 0.2, 1.7))] if abs(y) < 2.3 else []
        cloud = ray_cast(LIDARS["VLP-16"], ground, 0.65, person, columns=720)
        motion = replace(STILL, stamp=step * 400_000_000)
        terrain = source.terrain(Observation(motion.stamp, cloud=cloud), motion)
    height = terrain.height.numpy() - ground
    trail = (np.abs(GRID.x - 1.6) < 0.5)[None, :] & (np.abs(GRID.y) < 1.5)[:, None]
    assert height[trail].max() < 0.45 and (height[trail] > 0.3).sum() < 15


@pytest.mark.parametrize("depth", [0.5, 4.0])
def test_the_top_of_a_wall_is_no_ceiling(husky, depth):
    ground = -husky.ground_clearance
    random = np.random.default_rng(0)
    floor = random.uniform(-6.4, 6.4, (40_000, 2))
    floor = floor[(floor[:, 0] < 2.0) | (np.abs(floor[:, 1]) > 2.0) | (floor[:, 0] > 2.1 + depth)]
    front = np.column_stack([np.full(4000, 2.0), random.uniform([-2.0, ground], [2.0, ground + 1.4], (4000, 2))])
    top = random.uniform([2.0, -2.0], [2.0 + depth, 2.0], (8000, 2))
    level, raised = np.full(len(floor), ground), np.full(len(top), ground + 1.4)
    cloud = np.concatenate([np.column_stack([floor, level]), front, np.column_stack([top, raised])]).astype(np.float32)
    source = choose_terrain_source("lidar_interpolation", husky)
    height = source.terrain(Observation(0, cloud=cloud), STILL).height.numpy() - ground
    on_top = (GRID.x > 2.1) & (GRID.x < 1.9 + depth)
    assert height[np.abs(GRID.y) < 1.8][:, on_top].min() > 1.2
