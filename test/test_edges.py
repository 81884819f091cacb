"""Edges blurred by an encoder are restored where heights rise too steeply, and other heights are unchanged."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import avg_pool2d

from monoforce_ros.core import CameraModel, homogeneous
from monoforce_ros.encoder import SMALLEST_DECREASE, CameraView, EncoderConfig, TerrainEncoder, encoder_input
from monoforce_ros.encoder.edges import restore_edges
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

WALL = 2.0


def rise(grid: Grid, height: float, width: float, heading: float = 0.0) -> torch.Tensor:
    """Heights ``[1, rows, columns]`` [m] that rise by ``height`` over ``width``, ``WALL`` ahead along a heading."""
    x, y = np.meshgrid(np.asarray(grid.x), np.asarray(grid.y))
    ahead = torch.from_numpy(np.cos(heading) * x + np.sin(heading) * y)
    return (height * ((ahead - WALL) / width + 0.5).clamp(0.0, 1.0)).float()[None]


def driven(heights: torch.Tensor, grid: Grid) -> float:
    """Distance that a Husky covers when commanded to drive 4 m ahead [m]."""
    robot = load_robot("husky")
    speeds = robot.drive_speeds(torch.tensor([0.8, 0.0]).expand(1, 500, 2))
    with torch.no_grad():
        result = rollout(TerrainMap.from_height(heights[0], grid), robot, speeds, State.at_rest(robot.ground_clearance))
    return float(result.position[0, -1, 0])


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.2])
@pytest.mark.parametrize(("height", "width"), [(0.5, 0.6), (0.4, 0.5), (0.9, 0.6)])
def test_a_blurred_wall_becomes_a_step_at_the_middle_of_its_slope(resolution, height, width):
    grid = Grid.square(8.0, resolution)
    restored = restore_edges(rise(grid, height, width), resolution)[0, 0].double()
    x = torch.from_numpy(np.asarray(grid.x))
    assert float(restored.min()) >= 0.0 and float(restored.max()) <= height + 1e-6
    steep = restored[(x > WALL - 0.11 - resolution) & (x < WALL + 0.11 + resolution)]
    assert float(steep[-1] - steep[0]) > 0.8 * height
    half = float(x[restored > 0.5 * height][0])
    assert half == pytest.approx(WALL, abs=1.01 * resolution)


def test_a_robot_climbs_the_blurred_wall_and_stops_at_the_restored_one():
    grid = Grid.square()
    blurred = rise(grid, 0.5, 0.6)
    assert driven(blurred, grid) > 3.0
    assert 1.0 < driven(restore_edges(blurred, grid.resolution), grid) < WALL


@pytest.mark.parametrize("heading", [0.0, 20.0, 45.0])
@pytest.mark.parametrize(
    ("height", "width"),
    [
        pytest.param(2.0, 2.0 / np.tan(np.radians(20)), id="a ramp of 20 degrees"),
        pytest.param(0.2, 0.1, id="a kerb of 20 cm"),
        pytest.param(0.0, 1.0, id="level ground"),
    ],
)
def test_gentle_ground_is_unchanged_in_any_direction(height, width, heading):
    heights = rise(Grid.square(), height, width, heading=np.radians(heading))
    assert torch.equal(restore_edges(heights, 0.1), heights)


@pytest.mark.parametrize("heading", [0.0, 20.0, 45.0, 90.0])
def test_walls_are_restored_in_any_direction(heading):
    grid = Grid.square()
    blurred, sharp = (rise(grid, 0.5, width, heading=np.radians(heading)) for width in (0.6, 1e-3))
    off = [float((heights - sharp).abs().mean()) for heights in (blurred, restore_edges(blurred, 0.1))]
    assert off[1] < 0.5 * off[0]


def test_the_middle_of_a_long_steep_slope_is_unchanged():
    grid = Grid.square()
    slope = rise(grid, 2.0, 2.0 / np.tan(np.radians(40)))
    middle = np.abs(np.asarray(grid.x) - WALL) < 0.8
    torch.testing.assert_close(restore_edges(slope, 0.1)[0, :, middle], slope[0, :, middle])


def test_a_sharp_wall_is_unchanged():
    step = rise(Grid.square(), 0.6, 1e-3)
    torch.testing.assert_close(restore_edges(step, 0.1), step)


@given(seed=st.integers(0, 2**31), roughness=st.floats(0.0, 2.0), offset=st.floats(-50.0, 50.0))
def test_heights_stay_within_their_neighbourhood_and_results_follow_offsets_and_symmetries(seed, roughness, offset):
    heights = roughness * torch.from_numpy(np.random.default_rng(seed).normal(size=(2, 24, 31)))
    restored = restore_edges(heights, 0.1)
    around, below = (sign * torch.nn.functional.max_pool2d(sign * heights[:, None], 7, 1, 3)[:, 0] for sign in (1, -1))
    assert bool(((restored <= around + 1e-9) & (restored >= below - 1e-9)).all())
    torch.testing.assert_close(restore_edges(heights + offset, 0.1), restored + offset, atol=1e-6, rtol=0.0)
    for turned in (lambda h: h.flip(-1), lambda h: h.flip(-2), lambda h: h.transpose(-1, -2)):
        torch.testing.assert_close(restore_edges(turned(heights), 0.1), turned(restored))


def test_restored_heights_are_stable_under_small_changes():
    blurred = rise(Grid.square(), 0.5, 0.6).double()
    other = blurred + 1e-3 * torch.from_numpy(np.random.default_rng(0).normal(size=blurred.shape))
    assert float((restore_edges(other, 0.1) - restore_edges(blurred, 0.1)).abs().max()) < 0.1


def test_gradients_are_correct_and_the_identity_on_unchanged_ground():
    level = torch.zeros(1, 20, 20, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(restore_edges(level, 0.1).sum(), level)
    torch.testing.assert_close(gradient, torch.ones_like(level))
    blurred = rise(Grid.square(6.0), 0.5, 0.6).double()
    # Noise avoids ties, at which the maximum is not differentiable.
    blurred = (blurred + 1e-3 * torch.from_numpy(np.random.default_rng(1).normal(size=blurred.shape))).requires_grad_()
    weight = torch.from_numpy(np.random.default_rng(2).normal(size=blurred.shape))
    (gradient,) = torch.autograd.grad((weight * restore_edges(blurred, 0.1)).sum(), blurred)
    assert bool(gradient.isfinite().all()) and float((gradient - weight).abs().max()) > 1.0
    for row, column in ((10, 47), (20, 49), (30, 50), (5, 51)):
        moved = [blurred.detach().clone() for _ in range(2)]
        for heights, sign in zip(moved, (1, -1), strict=True):
            heights[0, row, column] += sign * 1e-6
        up, down = (float((weight * restore_edges(heights, 0.1)).sum()) for heights in moved)
        assert float(gradient[0, row, column]) == pytest.approx((up - down) / 2e-6, rel=1e-4, abs=1e-6)


def test_an_encoder_restores_edges_of_h_t_and_keeps_h_d():
    config = EncoderConfig(
        image_width=128, image_height=96, map_size=6.4, resolution=0.1, depth_bins=12, map_features=8
    )
    torch.manual_seed(3)
    encoder = TerrainEncoder(config).eval()
    random = np.random.default_rng(0)
    matrix = np.array([[77.0, 0, 63.5], [0, 77.0, 47.5], [0, 0, 1]])
    forward = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    image = random.integers(0, 255, (96, 128, 3), np.uint8)
    seen = [
        CameraView(image, CameraModel(128, 96, matrix, np.array([])), homogeneous(forward, np.array([0.2, 0, 0.5])))
    ]
    with torch.no_grad():
        # Untrained heads predict level ground.
        encoder.heads.weight.normal_(0.0, 0.1)
        encoder.heads.weight[:2] *= 0.3 / float(encoder(encoder_input(seen, None, config)).height.std())
        encoder.config = replace(config, edges=False)
        raw = encoder(encoder_input(seen, None, config))
    encoder.config = config
    terrain = encoder.terrain(seen)
    mean = avg_pool2d(raw.decrease, 3, 1, 1, count_include_pad=False)[0]
    used = torch.where(mean > SMALLEST_DECREASE, raw.decrease[0], 0.0)
    expected = restore_edges(raw.height, 0.1)[0] + raw.decrease[0] - used
    torch.testing.assert_close(terrain.height, expected)
    assert float((expected - raw.geometric_height[0] + used).abs().max()) > 0.05
    torch.testing.assert_close(terrain.geometric_height - terrain.height, used, atol=1e-5, rtol=0.0)
