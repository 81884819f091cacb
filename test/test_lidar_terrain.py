"""Height maps from lidar clouds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.terrain import Grid, LidarSettings, TerrainError, fill_holes, terrain_from_cloud
from monoforce_ros.terrain.lidar import cell_heights
from monoforce_ros.terrain.overhead import by_cell_and_height

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


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 300), st.sampled_from([40, 2**24]), st.floats(1e-3, 1e3), st.integers(0, 2**32 - 1))
def test_points_are_ordered_by_cell_and_by_height_within_each(count, cells, spread, seed):
    random = np.random.default_rng(seed)
    flat, z = random.integers(0, cells, count), random.normal(-100.0, spread, count)
    z[: count // 4] = np.round(z[: count // 4])
    order = by_cell_and_height(flat, z)
    exact = np.lexsort((z, flat))
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    np.testing.assert_array_equal(flat[order], flat[exact])
    # The key's last digit, for the largest grid and heights of a kilometre.
    np.testing.assert_allclose(z[order], z[exact], rtol=0, atol=2.0**-52 * cells * 16.0 * max(spread, 1.0))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 200), st.sampled_from([np.float32, np.float64]), st.integers(0, 2**32 - 1))
def test_a_point_lies_in_the_cell_whose_centre_is_nearest(count, kind, seed):
    grid = Grid(rows=30, columns=50, resolution=0.2, origin=(-3.1, 7.3))
    random = np.random.default_rng(seed)
    points = random.uniform([-6.0, 4.0], [10.0, 16.0], (count, 2)).astype(kind)
    points[::7, random.integers(2)] = random.choice([np.nan, np.inf, -np.inf, 1e30])
    rows, columns, inside = grid.cells(points)
    assert rows.dtype == columns.dtype == np.int64
    across, up = np.abs(points[:, :1] - grid.x), np.abs(points[:, 1:] - grid.y)
    nearest = (across.min(axis=1) < 0.1 - 1e-6) & (up.min(axis=1) < 0.1 - 1e-6)
    outside = ~((across.min(axis=1) < 0.1 + 1e-6) & (up.min(axis=1) < 0.1 + 1e-6))
    assert inside[nearest].all() and not inside[outside].any()
    np.testing.assert_array_equal(columns[nearest], across.argmin(axis=1)[nearest])
    np.testing.assert_array_equal(rows[nearest], up.argmin(axis=1)[nearest])
    assert not rows[outside].any() and not columns[outside].any()
