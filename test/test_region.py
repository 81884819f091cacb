"""Region: an effect that acts on a part of the ground is found and placed; one that acts everywhere is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.areas import (
    Area,
    Circle,
    circles,
    ground_classes,
    reach_of,
    touching,
    window_places,
    worst_place,
)
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Windows, explain
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.region import Region, _Pull, find_region
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.effects import drive_speeds, identifiable_effects
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
RESIDUAL = np.tile([0.01, 0.012, 0.007], (4, 1))
"""About what a commissioned robot of the benchmark leaves on level ground after 2 s [m, m, rad]."""
CENTRE, RADIUS = np.array([7.2, 3.2]), 2.5
ICE = (("friction_scale", {"factor": 0.15}),)
"""Friction of wet ice."""


def _drive(effects, seconds=90.0, seed=2, centre=CENTRE, radius=RADIUS) -> EvidenceWindows:
    """Speeds and yaw rates at random, several times through a circle in which a Husky has effects.

    Friction is that of each wheel's ground.
    """
    husky = load_robot("husky")
    random, steps = np.random.default_rng(seed), round(seconds / 0.01)
    commanded = np.repeat(random.uniform([-0.2, -0.2], [1.0, 0.9], (round(seconds / 1.5), 2)), 150, axis=0)[:steps]
    speeds = drive_speeds(husky, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    grid = Grid.square(60.0, 0.1)
    x, y = np.meshgrid(grid.x - centre[0], grid.y - centre[1])
    ground = TerrainMap.flat(grid)
    factor = dict(effects).get("friction_scale", {"factor": 1.0})["factor"]
    icy = torch.from_numpy(np.hypot(x, y) <= radius)
    ground = replace(ground, friction=torch.where(icy, factor * ground.friction, ground.friction))
    motion = recorded(rollout(ground, husky, speeds, State.at_rest(0.13), with_forces=False))
    commands = CommandTrack(np.arange(steps, dtype=np.int64) * 10_000_000, commanded)
    return EvidenceWindows(motion, commands, window_starts(motion, [slice(0, len(motion))], 2.0, 1.0), 2.0, SAMPLES)


@pytest.fixture(scope="module")
def icy() -> EvidenceWindows:
    return _drive(ICE)


def _healthy() -> NominalModel:
    """A robot whose healthy residuals are some centimetres."""
    names = [effect.name for effect in identifiable_effects(load_robot("husky"))]
    return NominalModel(RESIDUAL, dict.fromkeys(names, 0.25), segments=5, loss=0.3, loss_spread=0.2)


def test_ice_that_a_whole_drive_does_not_show_is_found_where_it_is(icy):
    smoothed = SmoothedMotion(icy.motion, 0.0, 0.0, (slice(0, len(icy.motion)),))
    evidence = Evidence(smoothed, icy.commands)
    windows = Windows(icy, np.zeros((len(icy.starts), 4, 3)))
    found = explain(evidence, load_robot("husky"), windows, _healthy(), DiagnosisSettings(max_effects=1))
    assert found.decision.verdict == Verdict.EFFECT_FOUND
    assert isinstance(found.part, Region)
    ((name, values),) = found.decision.trial.effects
    assert name == "friction_scale" and values["factor"] == pytest.approx(0.15, abs=0.05)
    truly = touching(Circle(*CENTRE, RADIUS), icy, reach_of(load_robot("husky")))
    assert (found.part.acting == truly).mean() > 0.9
    assert (found.part.acting_in(icy) == found.part.acting).all()
    assert "within" in found.part.remark and "once" not in found.part.remark
    assert len(found.windows.data.starts) == found.part.acting.sum()


def test_the_place_with_the_largest_losses_is_found_whatever_acts_there(icy):
    losses = Search(load_robot("husky"), icy, RESIDUAL, nominal=_healthy()).loss_of(())
    place = worst_place(icy, losses, 0.05)
    truly = np.linalg.norm(window_places(icy) - CENTRE, axis=1) < RADIUS
    assert place is not None and place.visits > 1
    assert (place.inside & truly).sum() > 0.8 * truly.sum()
    # The same losses at another time lie elsewhere, and everywhere.
    assert worst_place(icy, np.roll(losses, len(losses) // 3), 0.02) is None


def test_losses_that_have_nothing_to_do_with_the_ground_show_a_place_as_often_as_stated(icy):
    random, found = np.random.default_rng(0), 0
    for _ in range(200):
        # Manoeuvres of some seconds, of which some are predicted far worse than others.
        manoeuvres = np.exp(random.standard_normal(1 + len(icy.starts) // 5))
        losses = np.repeat(manoeuvres, 5)[: len(icy.starts)] * random.uniform(0.8, 1.2, len(icy.starts))
        found += worst_place(icy, losses, 0.05) is not None
    assert 2 <= found <= 20


def test_an_effect_that_acts_everywhere_has_no_region():
    data = _drive((), seconds=60.0)
    slower = replace(load_robot("husky"), effects=(("drive_gain", {"gain": 0.9}),))
    search = Search(slower, data, RESIDUAL, nominal=_healthy())
    trial = search.judge((("drive_gain", {"gain": 1.0}),))
    assert search.loss_of(()).mean() > 1.0 and trial.loss < 0.1
    assert find_region(search, [trial]) is None
    # With effects that are wrong everywhere, those that pull most are found to do so everywhere, too.
    wrong = search.judge((("sensor_yaw_offset", {"angle": 0.01}),))
    assert find_region(search, [wrong]) is None


def test_classes_of_ground_follow_from_the_map(icy):
    grid = Grid.square(40.0, 0.2)
    level = TerrainMap.flat(grid)
    tall = torch.from_numpy(np.broadcast_to(grid.x[None] > 3.0, level.height.shape).copy())
    grown = replace(level, geometric_height=level.height + 0.4 * tall)
    known = replace(icy, terrain=grown, odometry_from_terrain=np.eye(4))
    taller, except_there = ground_classes(known)
    places = window_places(icy)
    assert (taller.inside == (places[:, 0] > 3.0)).mean() > 0.9
    assert (except_there.inside == ~taller.inside).all()
    assert (except_there.place.contains(known) == except_there.inside).all()
    assert taller.place.words.startswith("where the vegetation is taller than 0.")
    # Ground of one class has none, and level ground without a map has none either.
    assert ground_classes(replace(known, terrain=level)) == [] and ground_classes(icy) == []


def test_circles_hold_enough_windows_on_both_sides(icy):
    listed = circles(icy)
    assert len(listed) > 50
    assert all(12 <= area.inside.sum() <= len(icy.starts) - 12 for area in listed)
    assert all((area.place.contains(icy) == area.inside).all() for area in listed)
    inside = np.array([False, True, True, False, True])
    assert Area(inside, listed[0].place).visits == 2 and Area(~inside, listed[0].place).visits == 2


def test_the_scan_is_adjusted_for_all_areas():
    random, p, strong = np.random.default_rng(0), [], []
    for _ in range(100):
        angle = 0.25 * np.arange(80) + random.uniform(0.0, 6.0)
        places = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle)]) + random.normal(0.0, 0.5, (80, 2))
        distance = np.linalg.norm(places[:, None] - places, axis=2)
        masks = np.concatenate([distance <= np.quantile(distance, share, axis=1)[:, None] for share in (0.2, 0.4)])
        information = random.gamma(2.0, 1.0, 80)
        score = random.standard_t(4, 80) * np.sqrt(information) + 0.5 * information
        pull = _Pull(score, information)
        p.append(pull.scan_p(masks.astype(float), np.arange(80) // 4, 200, 1))
        alone = _Pull(score + 3.0 * masks[20] * information, information)
        strong.append(alone.scan_p(masks.astype(float), np.arange(80) // 4, 200, 1))
    # A scan without an adjustment calls four of five such drives different somewhere.
    assert np.mean(np.array(p) <= 0.05) <= 0.12
    assert np.mean(np.array(strong) <= 0.05) >= 0.7
