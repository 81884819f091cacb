"""Height maps from lidar clouds."""

import numpy as np
import pytest

from monoforce_ros.terrain import Grid, LidarSettings, TerrainError, fill_holes, terrain_from_cloud
from monoforce_ros.terrain.lidar import cell_heights

GRID = Grid.square(6.4, 0.1)


def surface(count: int, height, seed: int = 0) -> np.ndarray:
    xy = np.random.default_rng(seed).uniform(-3.2, 3.2, (count, 2))
    return np.column_stack([xy, height(*xy.T)])


def test_a_smooth_surface_is_recovered_in_observed_cells_and_between():
    def height(x, y):
        return 0.3 * np.sin(x) + 0.2 * y

    terrain = terrain_from_cloud(surface(1500, height), GRID)
    x, y = np.meshgrid(GRID.x, GRID.y)
    error = np.abs(terrain.height.numpy() - height(x, y))
    observed = terrain.observed.numpy()
    assert 0.2 < observed.mean() < 0.5
    assert np.median(error[observed]) < 0.02
    inner = np.hypot(x, y) < 2.8
    assert np.median(error[~observed & inner]) < 0.03 and error[inner].max() < 0.2


def test_map_rows_are_y_and_columns_are_x():
    points = surface(20_000, lambda x, y: np.where((x > 1.0) & (y < -2.0), 1.0, 0.0))
    height = terrain_from_cloud(points, GRID).height.numpy()
    row, column = np.argmin(np.abs(GRID.y + 2.5)), np.argmin(np.abs(GRID.x - 2.0))
    assert height[row, column] == pytest.approx(1.0) and height[column, row] == pytest.approx(0.0)


def test_overhanging_branches_are_ignored():
    ground = surface(20_000, lambda x, y: 0.0 * x)
    branch = np.column_stack([np.random.default_rng(1).uniform(-1, 1, (2000, 2)), np.full(2000, 1.8)])
    terrain = terrain_from_cloud(np.concatenate([ground, branch]), GRID)
    assert float(terrain.height.abs().max()) < 0.01


def test_a_crown_above_unobserved_ground_is_ignored():
    ground = surface(20_000, lambda x, y: 0.0 * x)
    hidden = ground[np.abs(ground[:, :2]).max(axis=1) > 0.3]
    crown = np.column_stack([np.random.default_rng(1).uniform(-0.3, 0.3, (500, 2)), np.full(500, 2.2)])
    terrain = terrain_from_cloud(np.concatenate([hidden, crown]), GRID)
    assert float(terrain.height.abs().max()) < 0.01


def test_walls_and_rocks_stay():
    ground = surface(20_000, lambda x, y: np.where(x > 1.5, 0.0, 0.0))
    wall = np.column_stack(
        [
            np.full(3000, 1.55),
            np.random.default_rng(2).uniform(-1, 1, 3000),
            np.random.default_rng(3).uniform(0, 1.5, 3000),
        ]
    )
    height = terrain_from_cloud(np.concatenate([ground, wall]), GRID).height.numpy()
    column = np.argmin(np.abs(GRID.x - 1.55))
    assert np.median(height[np.abs(GRID.y) < 0.9][:, column]) > 1.0


def test_support_points_determine_the_ground_under_the_robot_only():
    points = surface(20_000, lambda x, y: 0.0 * x)
    points = points[np.hypot(*points[:, :2].T) > 0.6]
    support = np.array([[0.2, 0.2, -0.1], [0.2, -0.2, -0.1], [-0.2, 0.2, -0.1], [-0.2, -0.2, -0.1]])
    terrain = terrain_from_cloud(points, GRID, support=support)
    rows, columns, _ = GRID.cells(support[:, :2])
    np.testing.assert_allclose(terrain.height.numpy()[rows, columns], -0.1, atol=1e-6)
    assert not terrain.observed.numpy()[rows, columns].any()
    assert np.abs(terrain.geometric_height.numpy()[rows, columns]).max() < 0.01


def test_known_cells_keep_their_value_when_holes_are_filled():
    generator = np.random.default_rng(0)
    heights, known = generator.normal(size=(33, 47)), generator.random((33, 47)) < 0.1
    filled = fill_holes(heights, known)
    np.testing.assert_array_equal(filled[known], heights[known])
    assert np.isfinite(filled).all()
    assert filled.min() >= heights[known].min() - 1e-5 and filled.max() <= heights[known].max() + 1e-5


def test_too_few_returns_are_an_error():
    with pytest.raises(TerrainError, match="hit 1 cells"):
        terrain_from_cloud(np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]), GRID)
    heights, observed = cell_heights(np.zeros((0, 3)), GRID, LidarSettings())
    assert not observed.any() and not heights.any()
