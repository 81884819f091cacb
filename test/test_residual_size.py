"""Residual size: how often healthy drives are called too large, whatever their losses look like."""

from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.residual_size import loss_error, residual_size
from monoforce_ros.discrepancy.thresholds import Thresholds

THRESHOLDS = Thresholds()
STARTS = np.arange(58) * 1_000_000_000
SEGMENTS = 5


def drawn_losses(random, seconds, tail):
    """Losses of windows that begin every second: the same within a manoeuvre of 4 s, more uneven with ``tail``."""
    manoeuvres = np.exp(tail * random.standard_normal(-(-seconds // 4)))
    return 0.3 * np.repeat(manoeuvres, 4)[:seconds]


def commissioned(random, tail):
    """The healthy robot after a drive of five segments of 16 s."""
    losses = drawn_losses(random, 16 * SEGMENTS, tail).reshape(SEGMENTS, 16).mean(axis=1)
    spread = float(np.std(np.log(losses), ddof=1))
    return NominalModel(np.ones((4, 3)), segments=SEGMENTS, loss=float(losses.mean()), loss_spread=spread)


def sizes(tail, *, fault=1.0, drives=400):
    random = np.random.default_rng(0)
    found = []
    for _ in range(drives):
        healthy = commissioned(random, tail)
        between = np.exp(THRESHOLDS.drive_spread * random.standard_normal())
        losses = fault * between * drawn_losses(random, len(STARTS), tail)
        found.append(residual_size(losses, STARTS, healthy.loss, healthy, THRESHOLDS))
    return found


@pytest.mark.parametrize("tail", [0.2, 0.6, 1.2])
def test_healthy_drives_are_too_large_as_often_as_stated(tail):
    """A fixed spread of 0.3 calls 16 % of the most uneven ones too large at 5 %."""
    rate = np.mean([size.p <= 0.05 for size in sizes(tail)])
    assert 0.02 <= rate <= 0.09
    assert 0.08 <= np.mean([size.above > size.spread for size in sizes(tail)]) <= 0.24


def test_a_fault_that_doubles_all_losses_is_found_the_sooner_the_more_even_they_are():
    even, uneven = (np.mean([size.p <= 0.0125 for size in sizes(tail, fault=2.0)]) for tail in (0.2, 1.2))
    assert even > 0.8 > uneven


def test_one_manoeuvre_does_not_make_a_drive_too_large():
    healthy = NominalModel(np.ones((4, 3)), segments=SEGMENTS, loss=0.3, loss_spread=0.2)
    losses = np.full(len(STARTS), 0.3)
    losses[20:23] = 12.0
    single = residual_size(losses, STARTS, healthy.loss, healthy, THRESHOLDS)
    everywhere = residual_size(np.full_like(losses, losses.mean()), STARTS, healthy.loss, healthy, THRESHOLDS)
    assert single.above == pytest.approx(everywhere.above) and everywhere.p < 1e-3 < 0.05 < single.p


def test_the_error_of_a_loss_does_not_depend_on_its_size_nor_on_how_often_it_is_sampled():
    losses = drawn_losses(np.random.default_rng(3), len(STARTS), 0.6)
    error = loss_error(losses, STARTS)
    assert loss_error(7.0 * losses, STARTS) == pytest.approx(error)
    twice = np.repeat(STARTS, 2) + np.tile([0, 500_000_000], len(STARTS))
    assert loss_error(np.repeat(losses, 2), twice) == pytest.approx(error, rel=0.02)
    assert loss_error(np.full_like(losses, 0.3), STARTS) == pytest.approx(0.0, abs=1e-9)


def test_more_commissioning_makes_the_size_more_certain():
    losses = np.full(len(STARTS), 0.45)
    few = NominalModel(np.ones((4, 3)), segments=4, loss=0.3, loss_spread=0.4)
    many = replace(few, segments=40)
    found = [residual_size(losses, STARTS, 0.3, healthy, THRESHOLDS) for healthy in (few, many)]
    assert found[1].p < found[0].p and found[1].spread == pytest.approx(THRESHOLDS.drive_spread, abs=0.02)
