"""The body is closed: narrow obstacles stop the hull where they stop it in MuJoCo, however it is sampled."""

from dataclasses import replace

import numpy as np
import obstacles
import pytest
import torch
import yaml

from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot, robot_file
from monoforce_ros.robots.hull import box_samples, wheel_samples
from monoforce_ros.terrain import Grid, TerrainMap

NAMES = (
    "post 5 cm", "post 10 cm", "stump 10 cm, as high as half the hull", "stump 5 cm, as high as half the hull",
    "trunk 20 cm", "kerb, a third of the clearance", "kerb, two thirds of the hull", "bar at half the hull",
)  # fmt: skip


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.mark.parametrize("name", NAMES)
def test_an_obstacle_stops_the_robot_where_it_does_in_mujoco(husky, name):
    block = next(b for b in obstacles.blocks(husky) if b.name == name)
    expected = obstacles.in_mujoco("husky", block, 1.0)
    stopped = expected[0] < 3.0
    assert stopped == (name != "kerb, a third of the clearance")
    for resolution in (0.05, 0.1):
        found = obstacles.in_rollout(husky, block, 1.0, resolution)
        # A cell at the edge of a footprint may fill half a cell too much on each side, and a contact yields 1 to 2 cm.
        assert found[0] == pytest.approx(expected[0], abs=resolution + 0.03 if stopped else 0.15)


@pytest.mark.parametrize("lateral", [-0.1, 0.0, 0.07, 0.12])
@pytest.mark.parametrize("speed", [-1.0, 0.4])
def test_no_post_of_one_cell_passes_through_the_hull(husky, lateral, speed):
    grid = Grid.square(12.8, 0.05)
    height = torch.zeros(grid.rows, grid.columns)
    ahead = 1.5 if speed > 0 else -1.5
    place = [int(np.argmin(np.abs(np.asarray(axis) - v))) for axis, v in ((grid.y, lateral), (grid.x, ahead))]
    height[place[0], place[1]] = 0.6
    twists = torch.tensor([speed, 0.0]).expand(1, 400, 2)
    state = State.at_rest(husky.ground_clearance)
    result = rollout(TerrainMap.from_height(height, grid), husky, drive_speeds(husky, twists, 0.01), state)
    # Neither in the middle of the body at any time, nor past it without having gone around it.
    offset = torch.tensor([ahead, lateral, 0.0]) - result.position[0]
    local = (result.rotation[0].transpose(1, 2) @ offset[..., None])[..., 0]
    inside = (local[:, 0].abs() < 0.49 - 0.08) & (local[:, 1].abs() < 0.21 - 0.08)
    assert bool(result.valid.all()) and not bool(inside.any())
    assert abs(float(result.position[0, -1, 0])) < 1.35


@pytest.mark.parametrize("mass", [None, 8000.0])
@pytest.mark.parametrize(("name", "speed"), [("warthog", 0.5), ("warthog", 2.0), ("offroad_car", 1.0)])
def test_a_thin_post_stops_a_heavy_robot(name, speed, mass):
    """What holds a Husky yields to the traction of a car; a post gives way to none of them."""
    robot, content = load_robot(name), yaml.safe_load(robot_file(name).read_text())
    if mass is not None:
        robot = replace(robot, mass=torch.tensor(mass), inertia=robot.inertia * (mass / robot.mass))
    box = content["hull"][0]
    front, across = float(robot.points[:, 0].max()), float(box["size"][1])
    seconds = 1.0 + 1.5 / speed
    grid = Grid.square(16.0, 0.05)
    for share in (-0.35, 0.0, 0.2):
        row, column = (
            int(np.argmin(np.abs(np.asarray(axis) - v)))
            for axis, v in ((grid.y, share * across), (grid.x, front + 0.5))
        )
        height = torch.zeros(grid.rows, grid.columns)
        height[row, column] = 1.0
        twists = torch.tensor([speed, 0.0]).expand(1, round(100 * seconds), 2)
        state = State.at_rest(robot.ground_clearance)
        result = rollout(TerrainMap.from_height(height, grid), robot, drive_speeds(robot, twists, 0.01), state)
        post = torch.tensor([float(grid.x[column]), float(grid.y[row]), 0.0]) - result.position[0]
        local = (result.rotation[0].transpose(1, 2) @ post[..., None])[..., 0].numpy() - np.array(box["centre"])
        inside = (np.array(box["size"]) / 2 - np.abs(local))[:, :2].min(axis=1)
        assert bool(result.valid.all()) and inside.max() < 0.03


@pytest.mark.parametrize("resolution", [0.05, 0.1])
@pytest.mark.parametrize("share", [-0.8, 0.0, 0.3, 0.8])
@pytest.mark.parametrize("name", ["husky", "jackal", "warthog"])
def test_no_post_of_one_cell_passes_through_a_wheel(name, share, resolution):
    robot, content = load_robot(name), yaml.safe_load(robot_file(name).read_text())
    wheels = [(np.array(wheel["centre"]), wheel["radius"], wheel["width"]) for wheel in content["wheels"]]
    front, radius, width = max(wheels, key=lambda wheel: wheel[0][0] + wheel[0][1])
    post = front + np.array([1.0 + radius, share * width / 2, 0.0])
    grid = Grid.square(12.8, resolution)
    row, column = (int(np.argmin(np.abs(np.asarray(axis) - v))) for axis, v in ((grid.y, post[1]), (grid.x, post[0])))
    height = torch.zeros(grid.rows, grid.columns)
    height[row, column] = 1.0
    twists = torch.tensor([0.8, 0.0]).expand(1, 400, 2)
    state = State.at_rest(robot.ground_clearance)
    result = rollout(TerrainMap.from_height(height, grid), robot, drive_speeds(robot, twists, 0.01), state)
    assert bool(result.valid.all())
    offset = torch.tensor([float(grid.x[column]), float(grid.y[row]), 0.0]) - result.position[0]
    local = (result.rotation[0].transpose(1, 2) @ offset[..., None])[..., 0].numpy()
    for centre, radius, width in wheels:
        away = np.abs(local[:, :2] - centre[:2])
        # A post at the rim may scrape along the side of the wheel.
        assert not np.any((away[:, 0] < 0.5 * radius) & (away[:, 1] < width / 2 - resolution / 2))


@pytest.mark.parametrize("height", [0.5, 1.0, 1.3])
@pytest.mark.parametrize("name", ["husky", "jackal", "warthog"])
def test_what_a_wheel_may_climb_is_left_to_its_tread(name, height):
    robot = load_robot(name)
    radius = robot.wheel_radius
    block = obstacles.Block("kerb", 0.0, (0.3, 6.0, height * radius))
    tread = robot.with_points(
        (robot.point_outward[:, 0].abs() < 0.5) | (robot.points[:, 2] < robot.points[:, 2].min() + radius)
    )
    ahead = obstacles.distance(robot)
    first, second = (obstacles.in_rollout(body, block, 1.0, 0.05, ahead) for body in (robot, tread))
    np.testing.assert_allclose(first, second, atol=1e-3)


@pytest.mark.parametrize("size", [[0.98, 0.42, 0.24], [0.05, 0.03, 0.01], [2.0, 0.5, 0.7]])
@pytest.mark.parametrize("spacing", [0.1, 0.05, 0.02])
def test_a_box_keeps_its_area_and_has_no_gaps(size, spacing):
    size = np.array(size)
    points, areas, normals, _ = box_samples(size, spacing)
    assert np.all(areas > 0) and np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    for axis in range(3):
        for side in (-1.0, 1.0):
            on_face = normals[:, axis] == side
            assert areas[on_face].sum() == pytest.approx(np.delete(size, axis).prod())
            assert np.allclose(points[on_face, axis], side * size[axis] / 2)
    assert np.all(np.abs(points) <= size / 2 + 1e-12)
    # Any place of the sides and the underside has a sample within half the diagonal of a 5 cm cell.
    random = np.random.default_rng(1)
    for axis, side in ((0, 1.0), (1, -1.0), (2, -1.0)):
        places = random.uniform(-0.5, 0.5, (200, 3)) * size
        places[:, axis] = side * size[axis] / 2
        away = np.linalg.norm(places[:, None] - points[normals[:, axis] == side][None], axis=2).min(axis=1)
        assert away.max() < 0.05 * 0.75


@pytest.mark.parametrize("spacing", [0.1, 0.02])
def test_a_wheel_has_a_front_and_a_rear_without_gaps(spacing):
    points, areas, normals = wheel_samples(0.2, 0.1, spacing)
    for side in (-1.0, 1.0):
        row = points[normals[:, 0] == side]
        assert np.all(row[:, 0] == side * 0.2) and np.allclose(row[:, 2], 0.15)
        assert row[0, 1] == -0.05 and row[-1, 1] == 0.05 and np.diff(row[:, 1]).max() <= 0.025 + 1e-12
        assert areas[normals[:, 0] == side].sum() == pytest.approx(0.2 * 0.1)


def test_forces_do_not_depend_on_the_sampling():
    grid = Grid.square(6.4, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    terrain = TerrainMap.from_height(torch.from_numpy(0.05 * np.sin(3.0 * x) + 0.03 * y), grid)
    ends = []
    for spacing in (0.05, 0.02):
        robot = load_robot("husky", spacing=spacing).to(torch.float64)
        # Without its wheels the robot lies on its belly.
        belly = robot.with_points(robot.point_drives < 0)
        still = torch.zeros(1, 300, 2, dtype=torch.float64)
        ends.append(rollout(terrain, belly, still, State.at_rest(0.1, dtype=torch.float64), with_contact=True))
    first, second = ends
    assert float(first.contact.load[0, -1, -1]) == pytest.approx(50.0 * 9.81, rel=0.02)
    torch.testing.assert_close(first.position[0, -1], second.position[0, -1], rtol=0, atol=2e-3)
    torch.testing.assert_close(first.rotation[0, -1], second.rotation[0, -1], rtol=0, atol=5e-3)
