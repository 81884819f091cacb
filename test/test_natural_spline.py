"""Natural smoothing splines: the same curves as SciPy's, at every weight."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from monoforce_ros.bags.natural_spline import NaturalSplines


@pytest.mark.parametrize("count", [8, 50, 400])
@pytest.mark.parametrize("exponent", [-9.0, -4.0, 0.0, 4.0])
def test_the_spline_is_that_of_scipy(count, exponent):
    random = np.random.default_rng(count)
    times = np.cumsum(random.uniform(0.01, 0.05, count))
    values = np.sin(times) + 0.1 * random.standard_normal(count)
    expected = make_smoothing_spline(times, values, lam=10.0**exponent)
    splines = NaturalSplines(times)
    curve, curvatures = splines.fitted(values, 10.0**exponent)
    np.testing.assert_allclose(curve, expected(times), rtol=0, atol=1e-6)
    np.testing.assert_allclose(curvatures, expected.derivative(2)(times), rtol=1e-6, atol=1e-8)
    at = random.uniform(times[0], times[-1], 20)
    np.testing.assert_allclose(splines.between(values, 10.0**exponent, at), expected(at), rtol=0, atol=1e-6)
