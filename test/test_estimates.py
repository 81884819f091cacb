"""Estimates: intervals hold what a fit's residuals do not show."""

from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.estimates import effect_sizes
from monoforce_ros.discrepancy.fit import Fit, estimate_effects, neutral_values
from monoforce_ros.discrepancy.wording import finding
from monoforce_ros.effects import CATALOGUE, Product


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


def ridge(moment: float, deviation: float) -> Fit:
    """A load of 8 kg whose moment is known and whose mass is not: heavy and near, or light and far out."""
    mass = 8.0
    place = moment / mass
    along, across = np.array([mass, -place]), np.array([place, mass])
    directions = np.stack([along / np.linalg.norm(along), across / np.linalg.norm(across)], axis=1)
    # The moment's gradient is (place, mass): its deviation follows from that across the ridge.
    variances = np.array([6.0**2, (deviation / np.linalg.norm(across)) ** 2])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = directions @ np.diag(variances) @ directions.T
    covariance[2, 2] = 1e-3**2
    return Fit((("payload", {"mass": mass, "x": place, "y": 0.0}),), np.ones(40), covariance, blocks=1000)


def test_a_load_is_a_finding_where_only_its_moment_is_determined():
    (load,) = estimate_effects(ridge(3.4, 0.2), {})
    assert load.parameters["mass"].low < 0.0 < load.parameters["mass"].high
    moment = load.products["moment_x"]
    assert (moment.value, moment.unit) == (pytest.approx(3.4), "kg m")
    assert (moment.low, moment.high) == pytest.approx((3.4 - 1.96 * 0.2, 3.4 + 1.96 * 0.2), abs=1e-2)
    assert complaint(load) == ""
    assert "Only its moment forward of the base frame's origin is certain: 3.4 kg m." in finding(load)
    assert list(load.shown) == ["mass", "x", "y", "moment_x", "moment_y"]


def test_a_load_whose_moment_may_be_none_is_no_finding():
    (load,) = estimate_effects(ridge(3.4, 2.0), {})
    assert load.products["moment_x"].low < 0.0
    assert "holds 0 kg" in complaint(load)
    assert "certain" not in finding(load)


def test_the_moment_of_a_load_in_the_file_counts_as_none():
    (load,) = estimate_effects(ridge(3.4, 0.2), {})
    assert complaint(replace(load, in_file={"mass": 10.0, "x": 0.34})) != ""
    assert complaint(replace(load, in_file={"mass": 10.0, "x": 0.1})) == ""


@pytest.mark.parametrize(("deviation", "found"), [(0.02, True), (0.5, False)])
def test_two_lags_of_equal_length_are_a_finding_where_their_sum_is_determined(deviation, found):
    """Residuals hardly depend on how 0.43 s are divided: both intervals reach 0."""
    directions = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    covariance = directions @ np.diag([(deviation / np.sqrt(2.0)) ** 2, 0.4**2]) @ directions.T
    lags = {"time_constant": 0.222, "second_time_constant": 0.205}
    (lag,) = estimate_effects(Fit((("actuator_lag", lags),), np.ones(40), covariance, blocks=1000), {})
    assert lag.parameters["time_constant"].low == lag.parameters["second_time_constant"].low == 0.0
    total = lag.products["total_time"]
    assert total.value == pytest.approx(0.427)
    assert total.high - total.value == pytest.approx(1.96 * deviation, rel=0.01)
    assert (complaint(lag) == "") == found
    assert ("sum of both time constants is certain: 0.427 s" in finding(lag)) == found
    # The same lags in the robot's file are no change.
    assert complaint(replace(lag, in_file=lags)) != ""


def test_products_of_unknown_parameters_are_refused():
    class Load(type(CATALOGUE["payload"])):
        products = (Product("moment_w", ("mass", "w"), "kg m", "moment"),)

    assert "moment_w: parameters ['w'] are unknown" in Load().complaint()
