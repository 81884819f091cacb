"""Patch: effects on a part of the ground, predicted where the wheels meet it, and found where it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_region import CENTRE, ICE, RADIUS, RESIDUAL, _drive, _healthy

from monoforce_ros.discrepancy.areas import Circle, GroundClass, reach_of, touching
from monoforce_ros.discrepancy.evidence import COMPONENTS
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.patch import find_patch
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

EVERYWHERE, NOWHERE = Circle(0.0, 0.0, 20.0), Circle(500.0, 500.0, 1.0)
FRICTION = (("friction_scale", {"factor": 0.3}),)
SOFT = (("terrain_softness", {"factor": 20.0}),)
DRAG = (("rolling_resistance", {"coefficient": 0.08}),)
SLOW = (("drive_gain", {"gain": 0.8}),)


@pytest.fixture(scope="module")
def icy():
    return _drive(ICE)


@pytest.fixture(scope="module")
def over_waves(icy):
    """The same drive on a map of waves: a healthy robot would drive otherwise, but its predictions are well defined."""
    grid = Grid.square(60.0, 0.2)
    waves = 0.04 * torch.sin(torch.from_numpy(grid.x)).float().expand(grid.rows, -1).contiguous()
    tall = torch.from_numpy(grid.x > 5.0).expand(grid.rows, -1)
    terrain = replace(TerrainMap.from_height(waves, grid), geometric_height=waves + 0.4 * tall)
    return replace(icy, terrain=terrain, odometry_from_terrain=np.eye(4))


def _residuals(data, place, *hypotheses):
    return Predictions(load_robot("husky"), replace(data, place=place)).residuals(hypotheses)


def test_a_robot_that_never_touches_a_part_moves_as_its_file_says(icy):
    robot = replace(load_robot("husky"), effects=(("terrain_softness", {"factor": 5.0}),))
    data = replace(icy, starts=icy.starts[:12], components=COMPONENTS)
    (plain,) = Predictions(robot, data).residuals([()])
    for effects in ((), DRAG):
        (local,) = Predictions(robot, replace(data, place=NOWHERE)).residuals([effects])
        np.testing.assert_allclose(local, plain, atol=2e-3)


def test_what_the_robot_always_leans_is_that_of_the_whole_recording_on_a_part_of_it_too(icy):
    # It pitches by 1° in a part of the drive, where nothing acts.
    motion, data = icy.motion, replace(icy, components=COMPONENTS)
    times = (motion.stamps - motion.stamps[0]) * 1e-9
    tilt = np.where(times % 20.0 < 8.0, np.radians(1.0), 0.0)
    leaning = Rotation.from_quat(motion.quaternions) * Rotation.from_euler("y", tilt[:, None])
    data = replace(data, motion=replace(motion, quaternions=leaning.as_quat()))
    predictions = Predictions(load_robot("husky"), data)
    there = (data.starts - motion.stamps[0]) * 1e-9 % 20.0 < 6.0
    (whole,), (part,) = predictions.residuals([()]), predictions.on(None, there).residuals([()])
    np.testing.assert_allclose(part, whole[there], atol=1e-6)


@pytest.mark.parametrize("effects", [FRICTION, SOFT, DRAG, SLOW, (*FRICTION, *DRAG, *SLOW)])
@pytest.mark.parametrize("ground", ["icy", "over_waves"])
def test_effects_on_a_part_that_is_everything_are_those_without_a_part(effects, ground, request):
    data = request.getfixturevalue(ground)
    data = replace(data, starts=data.starts[:20], components=COMPONENTS)
    (whole,), (local,) = _residuals(data, None, effects), _residuals(data, EVERYWHERE, effects)
    np.testing.assert_allclose(local, whole, atol=2e-3)
    assert np.abs(whole - _residuals(data, None, ())[0]).max() > 0.01


@pytest.mark.parametrize("effects", [FRICTION, SOFT, DRAG])
def test_effects_on_a_part_that_the_robot_never_sees_change_nothing(effects, icy):
    (plain,), (local,) = _residuals(icy, None, ()), _residuals(icy, NOWHERE, effects)
    np.testing.assert_allclose(local, plain, atol=2e-3)


def test_what_happens_to_commands_has_nothing_to_do_with_the_ground(icy):
    (whole,), (local,) = _residuals(icy, None, SLOW), _residuals(icy, NOWHERE, SLOW)
    np.testing.assert_allclose(local, whole, atol=2e-3)


def test_hypotheses_that_change_the_ground_differently_are_predicted_each_on_its_own(icy):
    part = Circle(*CENTRE, RADIUS)
    listed = [FRICTION, (*FRICTION, *DRAG), ICE, DRAG, ()]
    together = _residuals(icy, part, *listed)
    for hypothesis, found in zip(listed, together, strict=True):
        np.testing.assert_allclose(found, _residuals(icy, part, hypothesis)[0], atol=1e-4)


def test_windows_off_the_part_are_predicted_as_before_and_those_on_it_exactly(icy):
    part = Circle(*CENTRE, RADIUS)
    touched = touching(part, icy, reach_of(load_robot("husky")))
    (plain,), (local,) = _residuals(icy, None, ()), _residuals(icy, part, ICE)
    np.testing.assert_allclose(local[~touched], plain[~touched], atol=2e-3)
    assert np.abs(plain[touched][..., :2]).max() > 0.2
    # The grid of the part is not that of the ground: an edge lies half a cell elsewhere.
    assert np.quantile(np.abs(local[touched]), 0.95) < 0.02


def test_a_class_of_ground_is_a_part_cell_by_cell(over_waves):
    grown = GroundClass("vegetation", 0.2, above=True)
    (plain,), (local,) = _residuals(over_waves, None, ()), _residuals(over_waves, grown, DRAG)
    changed = np.abs(local - plain).max(axis=(1, 2)) > 1e-3
    touched = touching(grown, over_waves, reach_of(load_robot("husky")))
    assert changed.any() and not changed[~touched].any()


def test_ice_is_placed_by_the_paths_of_single_wheels(icy):
    search = Search(load_robot("husky"), icy, RESIDUAL, nominal=_healthy())
    patch = find_patch(search)
    assert patch is not None and patch.area.visits > 1
    ((name, values),) = patch.effects
    assert name == "friction_scale" and values["factor"] == pytest.approx(0.15, abs=0.05)
    circle = patch.area.place
    assert np.hypot(circle.x - CENTRE[0], circle.y - CENTRE[1]) < 0.2
    assert circle.radius == pytest.approx(RADIUS, abs=0.2)
    assert patch.losses.mean() < 0.2 * search.loss_of(()).mean()


def test_a_drive_whose_errors_have_no_place_has_no_patch():
    data = _drive((), seconds=60.0)
    slower = replace(load_robot("husky"), effects=(("drive_gain", {"gain": 0.9}),))
    assert find_patch(Search(slower, data, RESIDUAL, nominal=_healthy())) is None
    # Nor has one that is predicted well.
    assert find_patch(Search(load_robot("husky"), data, RESIDUAL, nominal=_healthy())) is None
