"""Estimates: intervals hold what a fit's residuals do not show."""

import numpy as np
import pytest

from monoforce_ros.discrepancy.estimates import effect_sizes
from monoforce_ros.discrepancy.fit import Fit, estimate_effects, neutral_values


@pytest.mark.parametrize(
    ("name", "values", "sizes"),
    [
        ("drive_gain", {"gain": 0.8}, [0.2]),
        ("constant_force", {"x": 30.0, "y": -40.0}, [50.0, 50.0]),
        ("actuator_saturation", {"limit": 0.7}, [0.7]),
        ("payload", {"mass": 12.0, "x": 0.3, "y": 0.4}, [12.0, 0.5, 0.5]),
    ],
)
def test_an_effect_is_as_large_as_its_distance_from_no_effect(name, values, sizes):
    assert effect_sizes(name, values, neutral_values(((name, values),))) == pytest.approx(sizes)


def test_an_effect_in_the_file_counts_as_none():
    assert effect_sizes("drive_gain", {"gain": 0.8}, np.array([0.9])) == pytest.approx([0.1])


def test_an_interval_holds_the_error_of_the_formula_beside_that_of_the_fit():
    fit = Fit((("drive_gain", {"gain": 0.8}),), np.ones(40), np.array([[0.01**2]]), blocks=1000)
    (alone,) = estimate_effects(fit, {})
    (wider,) = estimate_effects(fit, {}, formula_variances=np.array([0.03**2]))
    assert alone.parameters["gain"].high == pytest.approx(0.8 + 1.96 * 0.01, abs=1e-4)
    assert wider.parameters["gain"].high == pytest.approx(0.8 + 1.96 * np.hypot(0.01, 0.03), abs=1e-4)
