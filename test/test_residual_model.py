"""The healthy robot's residuals depend on how it is commanded to move, and are judged on what was not fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_diagnose import simulated_recording

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy import Evidence, commissioning
from monoforce_ros.discrepancy.commissioning import commission
from monoforce_ros.discrepancy.gap import residual_scale
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.residual_model import TERMS, fit_terms, motion_terms
from monoforce_ros.robots import load_robot

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
FLOOR = np.array([0.005, 0.005, 0.002])


def drawn_windows(random: np.random.Generator, count: int, windows_of):
    """Windows of a recording with steps of speed and yaw rate every two seconds."""
    stamps = np.arange(0, count + 4, 0.05)
    steps = random.uniform((0.0, -1.2), (1.0, 1.2), (len(stamps) // 40 + 1, 2))
    steps[random.random(len(steps)) < 0.3, 1] = 0.0
    twists = steps[np.arange(len(stamps)) // 40]
    commands = CommandTrack(np.rint(stamps * 1e9).astype(np.int64), twists)
    return windows_of(commands, np.arange(1, count + 1) * 1_000_000_000)


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.fixture(scope="module")
def windows_of(husky):
    motion, commands = simulated_recording(husky, (), seconds=21.0)
    evidence = Evidence(SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),)), commands)
    return lambda commands, starts: replace(evidence, commands=commands).cut(starts, SAMPLES)


def test_terms_are_what_was_commanded_since_the_start(windows_of):
    stamps = np.arange(0, 10, 0.01)
    twists = np.stack([np.full(len(stamps), -0.5), np.where(stamps < 5.0, 0.0, 0.8)], axis=1)
    data = windows_of(CommandTrack(np.rint(stamps * 1e9).astype(np.int64), twists), np.array([1, 4, 6]) * 1_000_000_000)
    terms = dict(zip(TERMS, np.sqrt(np.moveaxis(motion_terms(data), -1, 0)), strict=True))
    np.testing.assert_allclose(terms["time"], np.broadcast_to(SAMPLES, (3, 4)))
    np.testing.assert_allclose(terms["distance"], np.broadcast_to(0.5 * SAMPLES, (3, 4)), atol=1e-9)
    np.testing.assert_allclose(terms["turn"][:, -1], (0.0, 0.8, 1.6), atol=0.05)
    np.testing.assert_allclose(terms["sideways"][:, -1], (0.0, 0.4, 0.8), atol=0.05)
    np.testing.assert_allclose(terms["yaw_rate_change"][:, -1], (0.0, 0.8, 0.0), atol=1e-9)
    assert not terms["speed_change"].any()


def test_a_learned_variance_holds_on_other_windows(windows_of):
    random = np.random.default_rng(4)
    true = np.zeros((3, len(TERMS)))
    true[:2, TERMS.index("distance")] = 0.05**2
    true[1, TERMS.index("sideways")] = 0.15**2
    true[2, TERMS.index("turn")] = 0.1**2

    def drawn(count):
        data = drawn_windows(random, count, windows_of)
        terms = motion_terms(data)
        deviation = np.sqrt(np.einsum("wkj,cj->wkc", terms, true) + FLOOR**2)
        # One draw for all times of a window: they are no independent samples.
        return data, terms, random.standard_normal((count, 1, 3)) * deviation

    ratios = []
    for _ in range(6):
        data, terms, residuals = drawn(90)
        nominal = NominalModel(
            np.ones((4, 3)), terms=fit_terms([residuals], [np.broadcast_to(FLOOR, residuals.shape)], [terms])
        )
        assert (nominal.terms >= 0.0).all()
        data, terms, residuals = drawn(90)
        scaled = residuals / np.hypot(FLOOR, nominal.residual_in(data))
        turning = terms[:, -1, TERMS.index("turn")] > 0.5**2
        ratios.append([np.mean(scaled[mask, -1] ** 2, axis=0) for mask in (turning, ~turning)])
    # Turning or not, residuals are as large as they are expected to be. With one size for all windows the heading of
    # those that go straight on would be expected ten times too large.
    assert np.all(np.abs(np.log(np.mean(ratios, axis=0))) < np.log(1.8))


def test_files_without_terms_mean_the_same_residual_everywhere(windows_of):
    data = drawn_windows(np.random.default_rng(1), 10, windows_of)
    nominal = NominalModel(np.arange(12.0).reshape(4, 3))
    assert (nominal.residual_in(data) == nominal.residual).all()
    assert residual_scale(np.zeros((4, 3)), data, nominal).shape == (10, 4, 3)


def test_commissioning_judges_each_part_by_values_fitted_without_it(husky, monkeypatch):
    motion, commands = simulated_recording(husky, (("drive_gain", {"gain": 0.9}),), seconds=48.0)
    evidence = Evidence(SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),)), commands)
    seen = []
    original = commissioning._fitted

    def fitted(entry, effects, iterations=12):
        seen.append(entry.data.starts)
        return original(entry, effects, iterations)

    monkeypatch.setattr(commissioning, "_fitted", fitted)
    # The search for further effects takes most of the time, and is not what is tested.
    monkeypatch.setattr(commissioning, "_further", lambda *arguments: ())
    _, nominal = commission([evidence], husky)
    whole, parts = seen[0], seen[-3:]
    assert all(len(part) < 0.8 * len(whole) for part in parts)
    assert set(whole) == set(np.concatenate(parts))
    # No window is in all of them: each is predicted by a fit that did not see it.
    assert not set.intersection(*(set(part) for part in parts))
    assert nominal.terms.shape == (3, len(TERMS))
