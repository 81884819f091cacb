"""The score test: its size is as stated whatever the residuals, it has power, and it says when it cannot know."""

import numpy as np
import pytest

from monoforce_ros.discrepancy.moderation import VariancePrior
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.score_test import Direction, score_tests, variation

PER_BLOCK, TIMES = 4, 4


def _directions(random, blocks, count, informed=1.0):
    """Changes of residuals ``[count, W, K, 3]`` that grow over the windows; some blocks show nothing."""
    size = random.standard_normal((count, blocks * PER_BLOCK, 1, 3))
    shown = random.random((count, blocks)) < informed
    return size * np.repeat(shown, PER_BLOCK, axis=1)[:, :, None, None] * np.linspace(0.25, 1.0, TIMES)[:, None]


def _residuals(random, blocks, scale=1.0):
    """Residuals whose blocks share most of their error, as a simulator's do: heavy tails, growing over the windows."""
    shared = np.repeat(random.standard_t(4, (blocks, 1, 3)), PER_BLOCK, axis=0) * np.linspace(0.25, 1.0, TIMES)[:, None]
    return scale * (shared + 0.5 * random.standard_normal((blocks * PER_BLOCK, TIMES, 3)))


def _tested(residuals, directions, seed, **options):
    blocks = np.repeat(np.arange(len(residuals) // PER_BLOCK), PER_BLOCK)
    named = [Direction(str(number), row[None], **options) for number, row in enumerate(directions)]
    return score_tests(residuals, np.ones_like(residuals), blocks, named, draws=200, seed=seed)


@pytest.mark.parametrize("scale", [0.01, 100.0])
@pytest.mark.parametrize(("blocks", "informed"), [(12, 1.0), (30, 1.0), (30, 0.4)])
def test_of_recordings_without_an_effect_the_stated_share_alarms(blocks, informed, scale):
    random = np.random.default_rng(7)
    alarms = sum(
        min(result.adjusted for result in _tested(
            _residuals(random, blocks, scale), _directions(random, blocks, 20, informed), seed
        )) <= 0.05
        for seed in range(80)
    )  # fmt: skip
    # Binomial: 5 % of 80 are 4; more than 10 happen in one of 300 such tests.
    assert alarms <= 10


def test_an_effect_is_found_among_many_directions_and_its_size_with_it():
    random = np.random.default_rng(3)
    found, errors = 0, []
    for seed in range(20):
        directions = _directions(random, 20, 20)
        results = _tested(_residuals(random, 20, 0.5) - 1.5 * directions[4], directions, seed)
        best = min(results, key=lambda result: result.p)
        found += best.name == "4" and best.adjusted <= 0.05
        errors.append(float((results[4].coefficients[0] - 1.5) / np.sqrt(results[4].covariance[0, 0])))
    assert found >= 18
    assert np.abs(errors).max() < 5.0


def test_what_the_healthy_robot_does_by_itself_is_no_effect():
    random = np.random.default_rng(4)
    directions = _directions(random, 20, 5)
    residuals = _residuals(random, 20, 0.05) - 0.5 * directions[0]
    assert _tested(residuals, directions, 0)[0].adjusted <= 0.05
    own = float(np.sqrt((directions[0] ** 2).mean()))
    assert _tested(residuals, directions, 0, variation=0.5 * own, degrees=5.0)[0].adjusted > 0.05


def test_a_direction_that_fitted_parameters_do_already_is_not_tested():
    random = np.random.default_rng(5)
    directions = _directions(random, 20, 2)
    residuals = _residuals(random, 20) - directions[0]
    blocks = np.repeat(np.arange(20), PER_BLOCK)
    same = Direction("same", 2.0 * directions[:1])
    (result,) = score_tests(residuals, np.ones_like(residuals), blocks, [same], fitted=directions[:1])
    assert result.p == 1.0


def test_a_direction_that_only_one_block_shows_is_not_tested():
    random = np.random.default_rng(6)
    directions = np.zeros((1, 80, TIMES, 3))
    directions[0, :4] = 1.0
    residuals = _residuals(random, 20) - 10.0 * directions[0]
    (result,) = _tested(residuals, directions, 0)
    assert result.p == 1.0


def test_variation_is_the_change_between_segments():
    random = np.random.default_rng(8)
    directions = _directions(random, 30, 1)
    segments = np.repeat(np.arange(6), 20)
    # The coefficient differs by segment: ±0.3 about 0.
    coefficient = np.repeat(np.array([0.3, -0.3, 0.3, -0.3, 0.3, -0.3]), 20)
    residuals = 0.01 * _residuals(random, 30) - coefficient[:, None, None] * directions[0]
    own = float(np.sqrt((directions[0] ** 2).mean()))
    found = variation(residuals, np.ones_like(residuals), segments, directions)
    # A little less: each segment is drawn towards the whole.
    assert 0.25 * own < found < 0.31 * own
    assert variation(residuals, np.ones_like(residuals), np.zeros(120, int), directions) is None


def test_the_variance_prior_is_recovered_and_outliers_do_not_move_it():
    random = np.random.default_rng(9)
    true = 0.04 * 8.0 / random.chisquare(8.0, 4000)
    estimated = true * random.chisquare(4.0, 4000) / 4.0
    prior = VariancePrior.of(estimated, 4.0)
    assert prior.variance == pytest.approx(0.04, rel=0.15)
    assert prior.degrees == pytest.approx(8.0, rel=0.3)
    spoilt = VariancePrior.of([*estimated[:40], 50.0, 80.0], 4.0)
    assert spoilt.variance == pytest.approx(VariancePrior.of(estimated[:40], 4.0).variance, rel=0.3)
    # Equal variances share all degrees of freedom that three independent residuals have.
    assert VariancePrior.of(0.04 * random.chisquare(4.0, 4000) / 4.0, 4.0).degrees == pytest.approx(12.0)
    # Moderated estimates are nearer to the truth than the estimates themselves.
    moderated = np.array([prior.moderated(value, 4.0)[0] for value in estimated])
    assert np.abs(np.log(moderated / true)).mean() < 0.7 * np.abs(np.log(estimated / true)).mean()
    assert prior.moderated(None, 4.0) == (prior.variance, prior.degrees)
    assert VariancePrior.of([], 4.0).moderated(None, 4.0) == (0.0, 0.0)


def _healthy_drives(random, segments, count=12):
    """Residuals of a commissioning and of a later recording of a robot with its own, heavy-tailed model error.

    The error is a sum of directions whose coefficients change between segments of 16 s, by unequal amounts.
    """
    sizes = np.sqrt(0.02 * 6.0 / random.chisquare(6.0, count))
    drawn = []
    for number in (segments, 4):
        directions = _directions(random, 4 * number, count)
        coefficients = sizes * random.standard_t(5, (number, count)) * np.sqrt(3 / 5)
        of_windows = np.repeat(coefficients, 4 * PER_BLOCK, axis=0)
        error = np.einsum("wc,cwkx->wkx", of_windows, directions)
        drawn.append((directions, error + 0.3 * _residuals(random, 4 * number)))
    return drawn


def test_p_values_of_healthy_drives_are_uniform_with_few_segments_and_unequal_variances():
    random = np.random.default_rng(10)
    segments, single, smallest = 5, [], []
    for seed in range(60):
        (before, commissioning), (directions, residuals) = _healthy_drives(random, segments)
        numbers = np.repeat(np.arange(segments), 4 * PER_BLOCK)
        weights = np.ones_like(commissioning)
        learned = {str(i): variation(commissioning, weights, numbers, row[None]) or 0.0 for i, row in enumerate(before)}
        nominal = NominalModel(np.ones((TIMES, 3)), learned, segments)
        # Coefficients of these recordings deviate within a recording only: no share between recordings.
        tested = [Direction(str(i), row[None], *nominal.variation_of(str(i), 0.0)) for i, row in enumerate(directions)]
        blocks = np.repeat(np.arange(len(residuals) // PER_BLOCK), PER_BLOCK)
        results = score_tests(residuals, np.ones_like(residuals), blocks, tested, draws=200, seed=seed)
        single += [result.p for result in results]
        smallest.append(min(result.adjusted for result in results))
    # 720 p-values, those of one recording correlated; conservative rather than not.
    for level in (0.01, 0.05, 0.2):
        assert 0.2 * level <= np.mean(np.array(single) <= level) <= 1.3 * level + 0.005
    assert np.mean(np.array(smallest) <= 0.05) <= 0.1
