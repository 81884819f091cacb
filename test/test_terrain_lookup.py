"""Terrain lookup compared with closed forms; each test covers an easy mistake."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.terrain import Grid, TerrainMap


def plane(grid: Grid, a: float, b: float, c: float) -> TerrainMap:
    x, y = torch.meshgrid(torch.from_numpy(grid.x), torch.from_numpy(grid.y), indexing="xy")
    return TerrainMap.from_height(a * x + b * y + c, grid)


def at(lookup: TerrainLookup, x: float, y: float):
    return lookup(torch.tensor([[[x], [y], [0.0]]], dtype=torch.float64))


@pytest.mark.parametrize("slope", [(1.0, 0.0), (0.0, 1.0), (0.3, -0.7)])
def test_plane_is_reproduced_with_its_normal(slope):
    grid = Grid(9, 14, 0.1, (-0.35, -0.2))  # not square, not centred
    lookup = TerrainLookup(plane(grid, *slope, 0.4), "bilinear", 1)
    for x, y in [(0.03, 0.08), (0.31, -0.11), (-0.27, 0.33)]:
        ground = at(lookup, x, y)
        assert float(ground.height) == pytest.approx(slope[0] * x + slope[1] * y + 0.4, abs=1e-12)
        expected = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
        np.testing.assert_allclose(ground.normal[0, :, 0].numpy(), expected, atol=1e-12)


def test_cells_have_their_values_at_their_centres_in_row_and_column():
    grid = Grid(4, 6, 0.5, (1.0, -2.0))
    height = torch.arange(24, dtype=torch.float64).reshape(4, 6)
    lookup = TerrainLookup(TerrainMap.from_height(height, grid), "bilinear", 1)
    for row in range(4):
        for column in range(6):
            assert float(at(lookup, 1.0 + 0.5 * column, -2.0 + 0.5 * row).height) == height[row, column]


@pytest.mark.parametrize("kind", ["bilinear", "constant"])
@pytest.mark.parametrize("where", [(-9.0, 0.2), (9.0, 0.2), (0.2, -9.0), (0.2, 9.0), (9.0, 9.0)])
def test_beyond_the_edge_the_border_value_is_extended(kind, where):
    grid = Grid(5, 7, 0.1, (0.0, 0.0))
    height = torch.arange(35, dtype=torch.float64).reshape(5, 7)
    lookup = TerrainLookup(TerrainMap.from_height(height, grid), kind, 1)
    border = [min(max(w, 0.0), limit) for w, limit in zip(where, (0.6, 0.4), strict=True)]
    assert float(at(lookup, *where).height) == pytest.approx(float(at(lookup, *border).height))


@given(st.floats(-0.6, 0.6), st.floats(-0.4, 0.4))
@settings(max_examples=60, deadline=None)
def test_interpolation_stays_between_the_four_neighbours(x, y):
    grid = Grid(9, 13, 0.1, (-0.6, -0.4))
    height = torch.from_numpy(np.random.default_rng(3).normal(size=(9, 13)))
    value = float(at(TerrainLookup(TerrainMap.from_height(height, grid), "bilinear", 1), x, y).height)
    column, row = min(int((x + 0.6) / 0.1), 11), min(int((y + 0.4) / 0.1), 7)
    around = height[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    assert float(around.min()) - 1e-9 <= value <= float(around.max()) + 1e-9


def test_each_trajectory_of_a_batch_has_its_own_map_and_material():
    grid = Grid.square(2.0, 0.1)
    maps = [TerrainMap.flat(grid, height=h, dtype=torch.float64) for h in (0.1, 0.2)]
    lookup = TerrainLookup(TerrainMap.stack(maps), "bilinear", 2)
    ground = lookup(torch.zeros(2, 3, 3, dtype=torch.float64))
    np.testing.assert_allclose(ground.height.numpy(), [[0.1] * 3, [0.2] * 3])
    assert float(ground.stiffness[0, 0]) == float(maps[0].stiffness[0, 0])


def test_normals_follow_a_map_that_changes():
    grid = Grid.square(2.0, 0.1)
    first, second = plane(grid, 0.0, 0.0, 0.0), plane(grid, 0.5, 0.0, 0.0)
    assert float(at(TerrainLookup(first, "bilinear", 1), 0.1, 0.1).normal[0, 0, 0]) == 0.0
    assert float(at(TerrainLookup(second, "bilinear", 1), 0.1, 0.1).normal[0, 0, 0]) < -0.4


def test_a_map_with_holes_is_refused_by_name():
    grid = Grid.square(2.0, 0.1)
    height = torch.zeros(20, 20)
    height[3, 4] = torch.nan
    with pytest.raises(ValueError, match="terrain height: 1 of 400 cells are not finite"):
        TerrainMap.from_height(height, grid)
    with pytest.raises(ValueError, match="terrain height: got shape"):
        TerrainMap.from_height(torch.zeros(20, 21), grid)
