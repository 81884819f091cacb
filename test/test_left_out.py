"""Left out: values without a part of a recording follow from one step of the fit, and equal those of a new fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack
from monoforce_ros.discrepancy.evidence import COMPONENTS, EvidenceWindows, subsampled, window_starts
from monoforce_ros.discrepancy.fit import fit_effects, flat, jacobian, robust, scales
from monoforce_ros.discrepancy.hypothesis import Predictions, residuals_by_part
from monoforce_ros.discrepancy.left_out import values_without_parts
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.trial import FOLDS, fold_count, folds_of
from monoforce_ros.effects import CATALOGUE, drive_speeds
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
SCALE = np.tile([0.02, 0.02, 0.01], (4, 1))


def _recording(effects, *, fast_from=0.0, noise=0.004):
    """64 s of a Husky with effects, with noise on its poses; it drives fast only after ``fast_from`` [s]."""
    husky = load_robot("husky")
    random = np.random.default_rng(3)
    steps = 6400
    commanded = np.repeat(random.uniform([0.1, -0.8], [0.9, 0.8], (43, 2)), 150, axis=0)[:steps]
    commanded[: round(fast_from / 0.01), 0] *= 0.15
    robot = replace(husky, effects=effects)
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    level = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(level, robot, speeds, State.at_rest(0.13), with_forces=False)
    motion = recorded(result)
    motion = replace(motion, positions=motion.positions + noise * random.standard_normal(motion.positions.shape))
    commands = CommandTrack(np.arange(steps, dtype=np.int64) * 10_000_000, commanded)
    return EvidenceWindows(motion, commands, window_starts(motion, [slice(0, len(motion))], 2.0, 1.0), 2.0, SAMPLES)


@pytest.mark.parametrize(
    "effects",
    [
        (("drive_gain", {"gain": 0.85}),),
        (("viscous_drag", {"coefficient": 200.0}), ("drive_asymmetry", {"difference": 0.1})),
        (("command_delay", {"delay": 0.2}),),
    ],
)
def test_one_step_equals_a_new_fit_without_the_part(effects):
    data = _recording(effects)
    husky = load_robot("husky")
    folds = folds_of(data.starts, FOLDS)
    ends = folds_of(np.r_[data.starts[0], data.starts + 2_000_000_000], FOLDS)[1:]
    fit = fit_effects(Predictions(husky, data), [effects], SCALE)
    unchanged = np.full(len(flat(effects)), np.nan)
    found = values_without_parts(fit, folds, ends, FOLDS, unchanged, scales(fit.effects, husky))
    moved = []
    for part in range(FOLDS):
        kept = (folds != part) & (ends != part)
        again = fit_effects(Predictions(husky, replace(data, starts=data.starts[kept])), [fit.effects], SCALE)
        half_width = np.sqrt(np.diag(fit.covariance))
        # A new fit ends where a step gains less than a thousandth.
        assert np.abs(flat(found[part]) - flat(again.effects)) == pytest.approx(0.0, abs=1.5 * half_width.max())
        moved.append(np.abs(flat(found[part]) - flat(fit.effects)) / half_width)
    # The parts matter: the values without them differ from each other.
    assert 0.01 < np.max(moved) < 5.0


def test_leaving_out_a_part_does_not_continue_a_fit_that_ended_early():
    data = _recording((("drive_gain", {"gain": 0.7}),))
    husky = load_robot("husky")
    folds = folds_of(data.starts, FOLDS)
    predictions, early = Predictions(husky, data), (("drive_gain", {"gain": 0.75}),)
    residual = predictions.residuals([early])[0] / SCALE
    derivatives = jacobian(predictions, early, residual, SCALE, 0).reshape(1, *residual.shape)
    ended = replace(fit_effects(predictions, [early], SCALE), effects=early, residual=residual, derivatives=derivatives)
    found = values_without_parts(ended, folds, folds, FOLDS, np.full(1, np.nan), scales(ended.effects, husky))
    moves = np.array([float(flat(effects)[0]) for effects in found]) - 0.75
    assert np.abs(moves).max() > 0.0 and np.abs(moves.mean()) < 0.3 * 0.05


def test_what_one_part_alone_shows_is_not_known_without_it():
    data = _recording((("quadratic_drag", {"coefficient": 250.0}),), fast_from=56.0)
    search = Search(load_robot("husky"), data, SCALE)
    trial = search.judge((("quadratic_drag", {"coefficient": 200.0}),))
    values = [effects[0][1]["coefficient"] for effects in trial.parts]
    last = folds_of(data.starts, FOLDS)[-1]
    others = np.delete(values, last)
    # The part that holds the fast drive moves the value by far more than any other.
    assert abs(values[last] - np.median(others)) > 5.0 * np.ptp(others)


def test_each_window_is_judged_with_the_values_without_its_part():
    data = _recording((("drive_gain", {"gain": 0.8}),))
    husky = load_robot("husky")
    parts = folds_of(data.starts, FOLDS)
    effects = tuple((("drive_gain", {"gain": 0.7 + 0.05 * part}),) for part in range(FOLDS))
    found = residuals_by_part(husky, data, parts, effects)
    everywhere = Predictions(husky, data).residuals(list(effects))
    assert found == pytest.approx(everywhere[parts, np.arange(len(parts))], abs=1e-6)
    trial = Search(husky, data, SCALE).judge((("drive_gain", {"gain": 0.8}),))
    assert trial.held_out_loss == pytest.approx(
        robust(residuals_by_part(husky, data, parts, trial.parts) / SCALE), abs=1e-6
    )


def test_formulas_of_parts_may_have_other_terms():
    data, husky = _recording(()), load_robot("husky")
    parts = folds_of(data.starts, FOLDS)
    terms = [
        {"torque_z:vx": 5.0},
        {"torque_z:vx|vx|": 5.0},
        {"force_x:vx": -3.0, "torque_z:1": 1.0},
        {"torque_z:1": 2.0},
    ]
    effects = tuple((("learned_term", terms[part % len(terms)]),) for part in range(FOLDS))
    found = residuals_by_part(husky, data, parts, effects)
    everywhere = np.stack([Predictions(husky, data).residuals([entry])[0] for entry in effects])
    assert found == pytest.approx(everywhere[parts, np.arange(len(parts))], abs=1e-6)


@pytest.mark.parametrize("name", ["drive_gain", "pose_clock_offset"])
def test_the_usual_lean_is_that_of_all_windows_whatever_part_they_are_in(name):
    # A sensor that leans by 2°, on a robot whose pitch differs between the halves of the recording.
    data = _recording(())
    husky, parts = load_robot("husky"), folds_of(data.starts, FOLDS)
    tilts = np.where(np.arange(len(data.motion)) < len(data.motion) // 2, 0.02, 0.05)
    leaning = Rotation.from_quat(data.motion.quaternions) * Rotation.from_euler("y", tilts[:, None])
    motion = replace(data.motion, quaternions=leaning.as_quat())
    data = replace(data, motion=motion, components=COMPONENTS)
    parameter = CATALOGUE[name].parameters[0]
    values = parameter.neutral + 0.01 * np.arange(FOLDS)
    effects = tuple(((name, {parameter.name: float(value)}),) for value in values)
    found = residuals_by_part(husky, data, parts, effects)
    everywhere = Predictions(husky, data).residuals([effects[parts[0]]])[0]
    roll, pitch = COMPONENTS.index("roll"), COMPONENTS.index("pitch")
    assert np.median(found[..., [roll, pitch]], axis=(0, 1)) == pytest.approx([0.0, 0.0], abs=1e-9)
    # The halves differ by what they lean apart.
    first = parts < FOLDS // 2
    assert abs(np.median(found[first, :, pitch]) - np.median(found[~first, :, pitch])) == pytest.approx(0.03, abs=0.005)
    assert found[parts == parts[0], ..., pitch] == pytest.approx(everywhere[parts == parts[0], ..., pitch], abs=0.005)


def test_beside_an_effect_only_candidates_that_may_matter_are_rolled_out_again():
    hidden = (("drive_gain", {"gain": 0.8}), ("command_delay", {"delay": 0.3}))
    data = _recording(hidden)
    search = Search(load_robot("husky"), data, SCALE)
    first = search.screening.candidates((), 0, "1: ")
    base = search.refit(hidden[:1]).effects
    second = search.screening.candidates(base, 0, "2: ")
    known = {direction.name: direction for direction in first.influences}
    kept = [direction.name for direction in second.influences if direction is known[direction.name]]
    assert kept and "command_delay" not in kept
    # Nobody is forgotten, and those that are kept as they were promise nothing.
    assert {entry.name for entry in second.screened} == set(known) - {"drive_gain"}
    assert all(entry.loss == second.before and entry.test.p > 0.3 for entry in second.screened if entry.name in kept)
    best = min(second.screened, key=lambda entry: entry.loss)
    assert best.name in ("command_delay", "pose_clock_offset", "command_clock_offset")
    assert best.test.adjusted < 0.01


@pytest.mark.parametrize("seconds", [60, 420, 700, 900, 1400])
def test_of_long_recordings_too_a_small_part_is_left_out_at_a_time(seconds):
    starts = subsampled(np.arange(seconds, dtype=np.int64) * 10**9, 8.0, 120)
    folds = folds_of(starts, fold_count(starts))
    counts = np.unique(folds, return_counts=True)[1]
    assert len(counts) >= 6 and counts.max() <= 0.25 * len(starts)


def test_a_fit_is_kept_by_the_parameters_that_it_holds_and_improved_from_better_values():
    data = _recording((("drive_gain", {"gain": 0.8}),))
    search = Search(load_robot("husky"), data, SCALE)
    one = search.refit((("learned_term", {"force_x:vx": -10.0}),))
    two = search.refit((("learned_term", {"force_x:vx": -10.0, "torque_z:wz": -5.0}),))
    assert len(flat(one.effects)) == 1 and len(flat(two.effects)) == 2
    poor = search.refit((("sensor_yaw_offset", {"angle": 3.0}),))
    better = search.refit((("sensor_yaw_offset", {"angle": 0.0}),))
    assert better.loss.mean() <= poor.loss.mean()
