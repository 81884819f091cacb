"""Steep surfaces: rays that end on slopes, walls and leaves, with errors along the rays."""

import numpy as np
import pytest

from monoforce_ros.perception.steep_surfaces import SteepSurfaces, steep_surfaces

HEIGHT = 0.7
"""Of the camera above the ground [m]."""
PIXEL, BASELINE, MATCHING_ERROR = 1.0 / 175.0, 1.0, 0.15


def rays() -> np.ndarray:
    """Horizontal unit vectors with the height gained per distance, of a grid of pixels ``[n, 3]``."""
    angle, elevation = np.meshgrid(np.arange(-60, 61) * PIXEL, np.arange(-90, 20) * PIXEL)
    return np.stack([np.cos(angle), np.sin(angle), elevation], axis=-1).reshape(-1, 3)


def measured(inverse: np.ndarray, seed: int, *, scatter: float = 0.0, bend: float = 0.0) -> SteepSurfaces:
    """What is steep of inverse distances ``[n]`` of :func:`rays` [1/m], measured by a camera that drives ahead.

    Args:
        inverse: true ones.
        seed: of the errors.
        scatter: standard deviation of the distances themselves [m].
        bend: error of the camera's rotation in standard deviations.
    """
    random = np.random.default_rng(seed)
    directions = rays()
    off_axis = np.maximum(np.hypot(np.arctan2(directions[:, 1], directions[:, 0]), directions[:, 2]), 10.0 * PIXEL)
    # An angle of parallax is about the baseline times its sine over the distance.
    own, common = MATCHING_ERROR * PIXEL / (BASELINE * off_axis), 0.003 / (BASELINE * off_axis)
    inverse = inverse + own * random.standard_normal(len(own)) + bend * common
    inverse = inverse - scatter * inverse**2 * random.standard_normal(len(own))
    shown = inverse > 0.02
    distance = 1.0 / inverse[shown]
    offsets = directions[shown] * distance[:, None]
    factor = np.linalg.norm(offsets, axis=1) * distance
    return steep_surfaces(
        offsets, np.hypot(own, common)[shown] * factor, common[shown] * factor, np.full(shown.sum(), 1.0 / 25.0), HEIGHT
    )


def slope_from(distance: float, rise: float) -> np.ndarray:
    """Inverse distances ``[n]`` [1/m] of level ground that rises from a distance [m] on."""
    e = rays()[:, 2]
    level = -e / HEIGHT
    hill = (rise - e) / (HEIGHT + rise * distance)
    return np.maximum(np.where(level > 1.0 / distance, level, hill), 1e-3)


@pytest.mark.parametrize("bend", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("rise", [0.0, 0.2, 0.4, 0.6])
@pytest.mark.parametrize("distance", [1.5, 3.0, 5.0])
def test_slopes_are_ground(distance, rise, bend):
    for seed in range(4):
        assert not len(measured(slope_from(distance, rise), seed, bend=bend).distance)


@pytest.mark.parametrize("distance", [1.5, 2.5, 3.5])
def test_walls_are_steep_where_they_stand(distance):
    wall = np.where(-rays()[:, 2] * distance < HEIGHT, 1.0 / distance, -rays()[:, 2] / HEIGHT)
    found = measured(wall, 0)
    assert len(found.distance) > 100
    assert np.abs(np.median(found.distance) / distance - 1.0) < 0.03
    assert found.foot.min() < 0.15 + 0.05 * distance
    assert found.top.max() > HEIGHT


def test_what_is_far_away_makes_no_obstacle_of_its_nearest_points():
    """The background's distances scatter from 4 m to infinity: those that were measured too near are few."""
    background = np.where(rays()[:, 2] < -0.15, -rays()[:, 2] / HEIGHT, 1.0 / 15.0)
    for seed in range(4):
        found = measured(background, seed)
        assert not (found.distance < 8.0).any()


def test_leaves_that_lie_behind_each_other_are_no_surface():
    steep = np.where(-rays()[:, 2] * 1.8 < HEIGHT, 1.0 / 1.8, -rays()[:, 2] / HEIGHT)
    surface, leaves = measured(steep, 0), measured(steep, 0, scatter=0.25)
    assert len(leaves.distance) < 0.1 * len(surface.distance)


def test_nothing_measured_is_nothing_steep():
    empty = np.zeros((0, 3))
    assert not len(steep_surfaces(empty, *np.zeros((3, 0)), HEIGHT).distance)
