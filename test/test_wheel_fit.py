"""Wheel fits: values planted in wheel speeds are recovered, and a batch computes what single models do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.wheel_blocks import WheelBlocks
from monoforce_ros.discrepancy.wheel_fit import fit, half_widths, starts
from monoforce_ros.discrepancy.wheel_model import bounds_of, by_effect, in_order, modelled, residuals
from monoforce_ros.effects import wheel_effects
from monoforce_ros.robots import load_robot

ROBOT = load_robot("husky")
PLANTED = {"yaw_rate_limit": (0.7,), "command_delay": (0.22,), "actuator_lag": (0.15,), "drive_droop": (0.05, 2.0)}


def drive(names: tuple[str, ...], values: np.ndarray, noise: float, seed: int) -> WheelBlocks:
    """Blocks of a drive of 60 s whose wheels follow a model, with noise [m/s] in what is measured."""
    random = np.random.default_rng(seed)
    stamps = (np.arange(0.0, 64.0, 0.05) * 1e9).astype(np.int64)
    held = np.repeat(random.uniform((-1.0, -1.2), (1.0, 1.2), (32, 2)), 40, axis=0)
    blocks = WheelBlocks.of(CommandTrack(stamps, held), WheelTrack(stamps, np.zeros((len(stamps), 2))), ROBOT, 0.04)
    assert blocks is not None
    shown = blocks.at_samples(modelled(names, values, blocks))[0]
    return replace(blocks, measured=shown + noise * random.standard_normal(shown.shape))


def planted() -> tuple[tuple[str, ...], np.ndarray]:
    names = in_order(tuple(PLANTED))
    return names, np.array([value for name in names for value in PLANTED[name]])


def test_planted_values_are_recovered_within_their_intervals() -> None:
    names, truth = planted()
    inside = []
    for seed in range(8):
        blocks = drive(names, truth, 0.03, seed)
        found = fit(names, blocks, starts(names, blocks.fastest, None))[0]
        widths = half_widths(names, found, blocks)
        np.testing.assert_allclose(found, truth, atol=0.15, rtol=0.4)
        inside += list(np.abs(found - truth) <= widths)
    # Of 40 intervals of 95 % fewer than 32 hold the truth once in ten thousand times.
    assert sum(inside) >= 32


@pytest.mark.parametrize("effect", [effect.name for effect in wheel_effects() if effect.applies_to(ROBOT)])
def test_a_batch_models_what_single_calls_do(effect: str) -> None:
    known, truth = planted()
    names = in_order((*known, effect))
    values = dict(zip(known, (own for _, own in by_effect(known, truth)), strict=True))
    blocks = drive(known, truth, 0.03, 1)
    first = dict(by_effect(names, starts(names, blocks.fastest, None)[0]))
    joined = np.concatenate([values.get(name, first[name]) for name in names])
    random = np.random.default_rng(0)
    low, high = bounds_of(names, blocks.fastest).T
    own = np.clip(joined * random.uniform(0.8, 1.2, (len(blocks), len(joined))), low, high)
    changes = 0.02 * own
    together = modelled(names, own, blocks, changes)
    for row in range(1 + len(joined)):
        for block in (0, 5, len(blocks) - 1):
            single = own[block] + (changes[block] * (np.arange(len(joined)) == row - 1) if row else 0.0)
            alone = modelled(names, single, blocks[np.array([block])])
            np.testing.assert_allclose(together[row, block], alone[0, 0], atol=1e-12)


def test_groups_are_fitted_as_alone() -> None:
    names, truth = planted()
    blocks = drive(names, truth, 0.05, 3)
    groups = np.arange(len(blocks)) % 2
    initial = starts(names, blocks.fastest, None)
    together = fit(names, blocks, initial, groups)
    for group in (0, 1):
        # What is fast is a property of the blocks, and bounds depend on it.
        part = blocks[groups == group]
        part.__dict__["fastest"] = blocks.fastest
        np.testing.assert_allclose(together[group], fit(names, part, initial)[0], atol=1e-9)


def test_a_fit_is_a_minimum_within_bounds() -> None:
    names, truth = planted()
    blocks = drive(names, truth, 0.03, 4)
    found = fit(names, blocks, starts(names, blocks.fastest, None))[0]
    low, high = bounds_of(names, blocks.fastest).T
    assert (found >= low).all() and (found <= high).all()
    scale = 0.05 * blocks.fastest.speed

    def cost(values: np.ndarray) -> float:
        return float((np.sqrt(1.0 + (residuals(names, values, blocks)[0] / scale) ** 2) - 1.0).sum())

    for number in range(len(found)):
        for side in (-0.03, 0.03):
            moved = found + side * found[number] * np.eye(len(found))[number]
            assert cost(moved) > cost(found) * (1.0 - 1e-4)
