"""How lidar points scatter tells walls from leaves, whatever the lidar and the direction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.encoder import EncoderConfig, encoder_input, extended, load_encoder, new_encoder, save_encoder
from monoforce_ros.encoder.config import SWEEP_CHANNELS
from monoforce_ros.encoder.heads import _within, terrain_maps
from monoforce_ros.encoder.sweep import cell_extremes, sweep_features
from monoforce_ros.terrain import LidarSettings, cell_heights, terrain_from_cloud

CONFIG = EncoderConfig(sensor="lidar")


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return points @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def ground_and(points: np.ndarray, random: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Points of level ground around the origin, and others."""
    level = np.c_[random.uniform(-5.0, 5.0, (count, 2)), random.normal(0.0, 0.01, count)]
    return np.r_[level, points]


def scatter_at(points: np.ndarray, place: np.ndarray) -> float:
    """Median scatter [m] in cells within 0.2 m of a place."""
    features = sweep_features(points, 0.0, CONFIG)
    x, y = np.meshgrid(CONFIG.grid.x, CONFIG.grid.y)
    near = np.hypot(x - place[0], y - place[1]) < 0.2
    assert (features[4][near] > math.log(3.0)).any()
    return 0.1 * float(np.median(features[3][near & (features[4] > math.log(3.0))]))


@pytest.mark.parametrize("noise", [0.008, 0.03])
@pytest.mark.parametrize("count", [12, 200])
def test_walls_scatter_less_than_leaves(noise, count):
    random = np.random.default_rng(3)
    found = []
    for angle in np.linspace(0.0, 2 * math.pi, 12):
        sides, heights = random.uniform(-0.25, 0.25, count), random.uniform(0.15, 0.8, count)
        wall = np.c_[3.0 + noise * random.standard_normal(count), sides, heights]
        leaves = np.c_[3.0 + random.uniform(0.0, 0.5, count), sides, heights]
        place = turned(np.array([[3.0, 0.0, 0.0]]), angle)[0]
        found.append([scatter_at(ground_and(turned(p, angle), random), place) for p in (wall, leaves)])
    firm, soft = np.array(found).T
    # As much as the lidar's own noise, and decimetres; few points of leaves may happen to lie on a line.
    assert firm.max() < 1.6 * noise
    assert np.median(soft) > 0.06 and np.median(soft) > 2.0 * np.median(firm)


def test_the_ground_before_a_wall_does_not_scatter():
    random = np.random.default_rng(5)
    points = ground_and(np.zeros((0, 3)), random)
    features = sweep_features(points, 0.0, CONFIG)
    assert not features[3:5].any()
    assert (features[6] == features[2]).all()
    assert (features[5] >= features[0]).all() and (features[5] <= features[1]).all()
    np.testing.assert_array_equal(features[:3], cell_extremes(points, 0.0, CONFIG))
    assert features.shape == (SWEEP_CHANNELS, CONFIG.grid.rows, CONFIG.grid.columns)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 300), st.floats(-1e6, 1e6), st.integers(0, 2**32 - 1))
def test_any_points_give_finite_features(count, offset, seed):
    random = np.random.default_rng(seed)
    points = random.uniform(-8.0, 8.0, (count, 3)) + np.array([0.0, 0.0, offset])
    features = sweep_features(points, offset, CONFIG)
    assert np.isfinite(features).all() and (features[3] >= 0.0).all() and features[3].max() < 6.0


def test_checkpoints_without_scatter_predict_as_before_and_can_be_trained_further(tmp_path):
    torch.manual_seed(1)
    old = new_encoder(EncoderConfig(sensor="camera_lidar", sweep_channels=3, map_features=8))
    with torch.no_grad():
        for parameter in old.heads.parameters():
            parameter.normal_(0.0, 0.1)
    file = tmp_path / "old.safetensors"
    save_encoder(old, file)
    # Files of networks without scatter do not name the channels.
    description = file.with_suffix(".json")
    description.write_text(description.read_text().replace('"sweep_channels": 3,', ""))
    assert load_encoder(file).config.sweep_channels == 3
    wider = extended(load_encoder(file), EncoderConfig(sensor="camera_lidar", map_features=8))
    assert wider.config.sweep_channels == SWEEP_CHANNELS
    random = np.random.default_rng(2)
    support = np.array([[0.3, 0.3, 0.1], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.1], [-0.3, -0.3, 0.0]])
    trace = np.c_[random.uniform(-6.0, 6.0, (500, 2)), random.uniform(0.0, 1.0, 500)]
    before, after = (e.eval().terrain([], support, trace=trace).height for e in (load_encoder(file), wider))
    assert before.std() > 0.0
    torch.testing.assert_close(before, after, rtol=0.0, atol=1e-6)


def test_an_untrained_encoder_predicts_what_the_sweep_measured(tmp_path):
    random = np.random.default_rng(4)
    wall = np.c_[np.full(300, 3.0), random.uniform(-1.0, 1.0, 300), random.uniform(0.0, 0.8, 300)]
    crown = np.c_[random.uniform(-3.5, -3.0, 200), random.uniform(-0.5, 0.5, 200), random.uniform(2.0, 2.5, 200)]
    # Points in all cells: nothing is interpolated.
    points = ground_and(np.r_[wall, crown], random, 100_000)
    encoder = new_encoder(EncoderConfig(sensor="lidar", map_features=8)).eval()
    found = encoder.terrain([], sweep=points)
    height, grid = found.geometric_height.numpy(), found.grid
    at = lambda x, y: height[int(np.argmin(abs(grid.y - y))), int(np.argmin(abs(grid.x - x)))]  # noqa: E731
    # A step of one cell, and no wall below branches.
    assert at(3.04, 0.04) > 0.6 and abs(at(2.84, 0.04)) < 0.05 and abs(at(3.24, 0.04)) < 0.05
    assert abs(at(-3.24, 0.04)) < 0.05
    # What does not carry lowers H_t alone, and what is not believed does not count.
    with torch.no_grad():
        encoder.heads.bias[8] = -20.0
    found = encoder.terrain([], sweep=points)
    assert float(found.geometric_height.max()) > 0.6 and float(found.height.max()) < 0.05
    with torch.no_grad():
        encoder.heads.bias[[7, 9]] = -20.0
    found = encoder.terrain([], sweep=points)
    assert float(found.geometric_height.abs().max()) < 1e-6


def test_an_untrained_encoder_interpolates_between_rings_as_the_lidar_map_does():
    random = np.random.default_rng(6)
    directions, distances = random.uniform(0.0, 2 * math.pi, 3000), random.choice([2.0, 3.0, 4.5, 6.0], 3000)
    points = np.c_[distances * np.cos(directions), distances * np.sin(directions), np.zeros(3000)]
    points[:, 2] = 0.2 + 0.15 * points[:, 0]
    support = np.array([[0.4, 0.3, 0.26], [0.4, -0.3, 0.26], [-0.4, 0.3, 0.14], [-0.4, -0.3, 0.14]])
    encoder = new_encoder(EncoderConfig(sensor="lidar", map_features=8)).eval()
    interpolated = terrain_from_cloud(points, encoder.config.grid, support=support)
    between = ~interpolated.observed

    def mean_error() -> float:
        found = encoder.terrain([], support, sweep=points)
        return float((found.geometric_height - interpolated.height)[between].abs().mean())

    # An output of 95 % is the only difference.
    assert mean_error() < 0.03
    with torch.no_grad():
        encoder.heads.bias[9] = -20.0
    assert mean_error() > 0.1
    # Without a sweep, the output has no effect.
    with torch.no_grad():
        encoder.heads.bias[9] = 20.0
    assert float(encoder.terrain([], support, sweep=np.zeros((0, 3))).geometric_height[0, 0]) == pytest.approx(0.2)


def test_encoders_without_the_interpolation_can_be_trained_further_with_it():
    torch.manual_seed(2)
    old = new_encoder(EncoderConfig(sensor="lidar", sweep_channels=7, map_features=8))
    with torch.no_grad():
        for parameter in old.heads.parameters():
            parameter.normal_(0.0, 0.1)
    wider = extended(old, EncoderConfig(sensor="lidar", map_features=8)).eval()
    points = ground_and(np.zeros((0, 3)), np.random.default_rng(7))
    with torch.no_grad():
        wider.heads.bias[9] = -20.0
    before, after = (
        terrain_maps(e.eval()(encoder_input([], None, e.config, sweep=points)), e.config)[0] for e in (old, wider)
    )
    unseen = ~before.observed
    assert before.height[unseen].std() > 0.0
    torch.testing.assert_close(before.height[unseen], after.height[unseen], rtol=0.0, atol=1e-5)
    # Measured heights are believed rather than corrected.
    assert float(after.geometric_height[before.observed].abs().mean()) < 0.7 * float(
        before.geometric_height[before.observed].abs().mean()
    )


def test_a_measured_hillside_stays_where_it_is_whatever_the_network_says_and_grass_does_not():
    torch.manual_seed(2)
    encoder = new_encoder(EncoderConfig(sensor="lidar", map_features=8)).eval()
    with torch.no_grad():
        encoder.heads.bias[0] = -0.6
        # Neither measured heights nor those between them are believed.
        encoder.heads.bias[7] = encoder.heads.bias[9] = -20.0
    random = np.random.default_rng(3)
    xy = random.uniform(-6.4, 6.4, (60_000, 2))
    support = np.array([[0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0]])

    def error(slope, roughness):
        height = slope * xy[:, 0] + roughness * random.standard_normal(len(xy))
        terrain = encoder.terrain([], support, sweep=np.column_stack([xy, height]))
        return float((terrain.geometric_height.numpy() - slope * encoder.config.grid.x).mean())

    assert abs(error(0.4, 0.01)) < 0.1
    assert error(0.0, 0.2) < -0.3


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2000), st.floats(0.02, 3.0), st.integers(0, 2**32 - 1))
def test_the_height_of_what_stands_is_that_of_the_lidar_map(count, spread, seed):
    random = np.random.default_rng(seed)
    points = np.c_[random.uniform(-2.0, 2.0, (count, 2)), random.normal(0.0, spread, count)]
    features = sweep_features(points, 0.3, CONFIG)
    limits = LidarSettings(lowest=CONFIG.lowest, highest=CONFIG.highest)
    relative = points - np.array([0.0, 0.0, 0.3])
    usual, standing = cell_heights(relative, CONFIG.grid, limits)
    highest, _ = cell_heights(relative, CONFIG.grid, replace(limits, quantile=1.0))
    rises = features[1] - features[0] > 0.1
    np.testing.assert_array_equal(features[6] > 0, standing)
    np.testing.assert_allclose(features[5], np.where(rises, highest, usual), atol=1e-9)


@pytest.mark.parametrize("reach", [1, 10])
def test_cells_near_others_are_those_that_pooling_finds(reach):
    cells = torch.rand((3, 40, 60), generator=torch.Generator().manual_seed(4)) > 0.99
    cells[2] = False
    pooled = torch.nn.functional.max_pool2d(cells.float()[:, None], 2 * reach + 1, 1, reach)[:, 0] > 0
    assert torch.equal(_within(cells, reach), pooled)
