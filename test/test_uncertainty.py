"""Spread and refinement: bands that contain the outcomes, and candidates with lower cost."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.planning import CostWeights, Limits, assess, force_every, over_horizon, refine
from monoforce_ros.prediction import EnsembleSettings, Prediction, Predictor, spread
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")
GRID = Grid.square(12.8, 0.1)
X, Y = np.meshgrid(GRID.x, GRID.y)
BUMPS = (
    0.08 * np.exp(-((X - 1.5) ** 2 + (Y - 0.2) ** 2) / 0.1)
    + 0.1 * np.exp(-((X - 2.5) ** 2 + (Y + 0.4) ** 2) / 0.2)
    + 0.03 * np.sin(3 * X) * np.cos(2 * Y)
)
STILL = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
NOTHING = {"friction": 0.0, "speed": 0.0, "yaw_rate": 0.0, "heading": 0.0, "gain": 0.0, "position": 0.0, "drift": 0.0,
           "scale": 1.0}  # fmt: skip


@pytest.fixture(scope="module")
def predictor():
    return Predictor(load_robot("husky"), None, horizon=4.0)


def predicted(predictor: Predictor, height=0.0 * X, command=(0.6, 0.2)) -> tuple[Prediction, np.ndarray]:
    low = float(predictor.robot.points[:, 2].min())
    middle = height[GRID.rows // 2, GRID.columns // 2]
    terrain = TerrainMap.from_height(torch.from_numpy((height - middle + low).astype(np.float32)), GRID)
    twists = over_horizon(np.array([[command]]), np.zeros((predictor.history, 2)), predictor.steps)
    return Prediction(STILL, terrain, predictor.roll_out(terrain, [STILL], twists)), twists[0]


def test_without_variation_there_is_no_spread(predictor):
    prediction, twists = predicted(predictor)
    found = spread(predictor, prediction, twists, EnsembleSettings(members=4, **NOTHING))
    for name in ("along", "across", "up", "heading", "radius"):
        np.testing.assert_allclose(getattr(found, name), 0.0, atol=1e-5, err_msg=name)
    assert found.valid == 4


def test_each_variation_has_the_expected_spread(predictor):
    prediction, twists = predicted(predictor, command=(0.6, 0.0))
    driven = prediction.positions()[-1, 0]
    only = {**NOTHING, "gain": 0.05}
    gain = spread(predictor, prediction, twists, EnsembleSettings(members=64, **only))
    # Drives 5 % faster or slower end 5 % further; uneven sides turn it.
    assert gain.along[-1] == pytest.approx(0.05 * driven, rel=0.3)
    assert gain.heading[-1] > 0.02 and gain.along[0] == 0.0
    turned = spread(predictor, prediction, twists, EnsembleSettings(members=64, **{**NOTHING, "heading": 0.05}))
    assert turned.across[-1] == pytest.approx(0.05 * driven, rel=0.3) and turned.along[-1] < 0.3 * turned.across[-1]
    drift = spread(predictor, prediction, twists, EnsembleSettings(members=4, **{**NOTHING, "drift": 0.1}))
    assert drift.radius[-1] == pytest.approx(0.1 * driven * np.sqrt(2 * np.log(10)), rel=0.02)
    jumping = spread(predictor, prediction, twists, EnsembleSettings(members=4, **{**NOTHING, "position": 0.03}))
    np.testing.assert_allclose(jumping.radius, 0.03 * np.sqrt(2 * np.log(10)), rtol=1e-3)
    assert jumping.up[0] == pytest.approx(0.03) and jumping.heading.max() < 1e-5
    wide = spread(predictor, prediction, twists, EnsembleSettings(members=4, **{**NOTHING, "drift": 0.1, "scale": 2.0}))
    np.testing.assert_allclose(wide.radius, 2 * drift.radius, rtol=1e-6)


def test_the_interval_of_an_effect_adds_spread_and_an_exact_value_does_not(predictor):
    robot = replace(predictor.robot, effects=(("command_delay", {"delay": 0.3}),))
    sure = Predictor(robot, None, horizon=4.0)
    unsure = Predictor(replace(robot, effect_intervals=(("command_delay", {"delay": (0.1, 0.5)}),)), None, horizon=4.0)
    prediction, twists = predicted(sure, command=(0.6, 0.0))
    settings = EnsembleSettings(members=32, **NOTHING)
    assert spread(sure, prediction, twists, settings).along[-1] < 1e-4
    # 0.1 s of delay (a standard deviation of this interval) at 0.6 m/s.
    assert spread(unsure, prediction, twists, settings).along[-1] == pytest.approx(0.06, rel=0.4)


def test_the_spread_of_a_maps_heights_adds_spread(predictor):
    def with_heights(value):
        prediction, twists = predicted(predictor, command=(0.6, 0.0))
        spreads = {"geometric_spread": torch.full(X.shape, value), "decrease_spread": torch.zeros(X.shape)}
        uncertain = replace(prediction, terrain=replace(prediction.terrain, **spreads))
        return spread(predictor, uncertain, twists, EnsembleSettings(members=32, **NOTHING))

    assert with_heights(0.0).up.max() < 1e-4
    # A Laplace distribution with a mean absolute error of 3 cm; the robot averages over the ground under its wheels.
    assert with_heights(0.03).up[-1] == pytest.approx(0.03 * np.sqrt(2.0), rel=0.5)
    assert with_heights(0.06).up[-1] > 1.5 * with_heights(0.03).up[-1]


def test_the_band_contains_members_of_another_seed(predictor):
    """About 90 % of the members drawn with another seed lie within the band."""
    prediction, twists = predicted(predictor, BUMPS)
    settings = EnsembleSettings(members=64, drift=0.0, position=0.0, scale=1.0)
    found = spread(predictor, prediction, twists, settings)
    other = spread(predictor, prediction, twists, replace(settings, seed=5))
    assert other.radius[-1] == pytest.approx(found.radius[-1], rel=0.5)
    # The radius agrees with the deviation of the other members.
    inside = np.hypot(other.along[-1], other.across[-1]) * np.sqrt(np.log(10))
    assert inside == pytest.approx(found.radius[-1], rel=0.5)


def test_ensemble_settings_are_validated():
    for wrong in ({"members": 1}, {"friction": -1.0}, {"scale": 0.0}, {"drift": float("nan")}):
        with pytest.raises(ValueError, match="got"):
            EnsembleSettings(**wrong)


def test_refinement_lowers_the_cost_and_keeps_the_end(predictor):
    prediction, _ = predicted(predictor, BUMPS)
    before, best = np.zeros((predictor.history, 2)), np.array([[0.6, 0.0]])
    found = refine(predictor, prediction, before, best, seconds=30.0)
    assert found.rounds >= 2 and found.cost < 0.9 * found.cost_before
    assert found.sequence.shape == (predictor.steps, 2)
    # The reported cost is that of a rollout of the commands.
    ends = []
    for sequence, cost in ((best, found.cost_before), (found.sequence, found.cost)):
        twists = over_horizon(sequence[None], before, predictor.steps)
        commanded = torch.from_numpy(twists[:, predictor.history :]).float()
        costs = []
        for every in (force_every(predictor.options.time_step), 1):
            rolled = predictor.roll_out(
                prediction.terrain, [STILL], twists, with_forces=False, with_contact=True, force_every=every
            )
            assessed = assess(rolled, prediction.terrain, predictor.robot, commanded)
            assert bool(assessed.feasible[0])
            costs.append(float(assessed.cost[0]))
        # Forces of every fifth step give the same cost as those of all steps.
        assert costs[0] == pytest.approx(cost, rel=1e-3) and costs[1] == pytest.approx(cost, rel=0.1)
        ends.append(rolled.position[0, -1].numpy())
    assert np.linalg.norm(ends[1] - ends[0]) < 0.35 * np.linalg.norm(ends[0])
    assert np.abs(found.sequence[:, 0]).max() <= predictor.robot.maximum_speed


def test_refinement_leaves_commands_before_the_candidate_unchanged(predictor):
    prediction, _ = predicted(predictor, BUMPS)
    held = predictor.steps // 4
    before = np.concatenate([np.zeros((predictor.history, 2)), np.full((held, 2), [0.3, 0.2])])
    found = refine(predictor, prediction, before, np.array([[0.6, 0.0]]), seconds=30.0)
    assert found.rounds >= 1 and found.cost < found.cost_before
    assert found.sequence.shape == (predictor.steps - held, 2)
    twists = over_horizon(found.sequence[None], before, predictor.steps - held)
    assert twists.shape == (1, predictor.history + predictor.steps, 2)
    rolled = predictor.roll_out(prediction.terrain, [STILL], twists, with_forces=False, with_contact=True)
    commanded = torch.from_numpy(twists[:, predictor.history :]).float()
    cost = float(assess(rolled, prediction.terrain, predictor.robot, commanded).cost[0])
    assert cost == pytest.approx(found.cost, rel=0.1)


def test_refinement_keeps_its_budget_and_leaves_infeasible_candidates_unchanged(predictor):
    prediction, _ = predicted(predictor, BUMPS)
    before, best = np.zeros((predictor.history, 2)), np.array([[0.6, 0.0]])
    none = refine(predictor, prediction, before, best, seconds=0.05, round_seconds=0.5)
    assert none.rounds == 0 and none.cost == none.cost_before
    np.testing.assert_allclose(none.sequence, np.broadcast_to(best, none.sequence.shape))
    strict = refine(predictor, prediction, before, best, limits=Limits(roll=0.001), seconds=30.0)
    assert strict.rounds == 0
    free = refine(predictor, prediction, before, best, weights=CostWeights(pitch=0.0), seconds=30.0)
    assert free.cost <= free.cost_before


def test_rollouts_are_joined_in_order(predictor):
    prediction, _ = predicted(predictor)
    other, _ = predicted(predictor, command=(0.3, -0.5))
    both = prediction.rollout.joined(other.rollout)
    assert both.position.shape[0] == 2 and torch.equal(both.position[1], other.rollout.position[0])
    assert both.forces.shape[0] == 2 and torch.equal(both.times, prediction.rollout.times)
